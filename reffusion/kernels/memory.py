"""Loads and stores of vectors in numba kernels: consecutive elements, columns of consecutive rows, sums over lanes.

A vector holds LANES numbers (see `vectors`). Arrays are contiguous and one-dimensional. An array with the remark
"flat" holds the rows of a two-dimensional array [R, width], one after the other. `place` is the index of the (first)
element in the one-dimensional array. Bounds are not checked.

Each `@intrinsic` describes a function of kernels, whose arguments follow `typing`; it returns the signature of this
function, and the code generator `emit` that writes its LLVM instructions.
"""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from reffusion.kernels.vectors import FLOATS, INT, INTS, LANES, copies, lane_mask, lanes

_LONG = ir.IntType(64)


def _pointer(context, builder, array, place, kind=None):
    """Return the address, as LLVM type `kind` if given, of an element of a contiguous one-dimensional array."""
    # `array` and `place` are (numba type, LLVM value) pairs of the array and of the index.
    data = context.make_array(array[0])(context, builder, array[1]).data
    pointer = builder.gep(data, [context.cast(builder, place[1], place[0], types.intp)])
    return pointer if kind is None else builder.bitcast(pointer, kind.as_pointer())


@intrinsic
def splat_at(typing, array, place):
    """Load one element of a float32 array, and return a vector with a copy of it in every lane."""

    def emit(context, builder, sig, args):
        return copies(builder, FLOATS, builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True))))

    return lanes(array, place), emit


@intrinsic
def load(typing, array, place):
    """Load LANES consecutive elements of a float32 array, from `place` on."""

    def emit(context, builder, sig, args):
        return builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True), FLOATS), align=4)

    return lanes(array, place), emit


@intrinsic
def store(typing, array, place, value):
    """Write a vector to LANES consecutive elements of a float32 array, from `place` on."""

    def emit(context, builder, sig, args):
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]), FLOATS)
        builder.store(args[2], at, align=4)
        return context.get_dummy_value()

    return types.void(array, place, value), emit


def _element(context, builder, kinds, values, lane: int):
    """Return the address of the element [row + lane, column] of a flat array [R, width]."""
    # `kinds` and `values` are the numba types and LLVM values of the array, width, column, row and, optionally, the
    # last row. Rows after the last row are replaced by the last row.
    data = context.make_array(kinds[0])(context, builder, values[0]).data
    pairs = zip(values[1:], kinds[1:], strict=True)
    width, column, row, *last = (context.cast(builder, value, kind, types.intp) for value, kind in pairs)
    here = builder.add(row, row.type(lane))
    if last:
        here = builder.select(builder.icmp_signed("<", here, last[0]), here, last[0])
    return builder.gep(data, [builder.add(builder.mul(here, width), column)])


@intrinsic
def load_column(typing, array, width, column, row, last):
    """Return a vector of LANES numbers: the elements of one column, in consecutive rows, of a float32 array.

    The array is [R, width], stored flat.

    Args:
        row: the first of these rows.
        last: the last row of the array. Rows after it are replaced by it, so that nothing outside the array is read.
    """

    def emit(context, builder, sig, args):
        value = ir.Constant(FLOATS, ir.Undefined)
        for lane in range(LANES):
            number = builder.load(_element(context, builder, sig.args, args, lane))
            value = builder.insert_element(value, number, INT(lane))
        return value

    return lanes(array, width, column, row, last), emit


@intrinsic
def store_column(typing, array, width, column, row, value):
    """Write a vector to one column of LANES consecutive rows, from `row` on, of a float32 array [R, width] (flat)."""

    def emit(context, builder, sig, args):
        for lane in range(LANES):
            at = _element(context, builder, sig.args[:4], args[:4], lane)
            builder.store(builder.extract_element(args[4], INT(lane)), at)
        return context.get_dummy_value()

    return types.void(array, width, column, row, value), emit


@intrinsic
def load_mask(typing, array, place):
    """Load LANES consecutive elements of an int32 array, and return a mask that is set where they are not 0."""

    def emit(context, builder, sig, args):
        value = builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True), INTS), align=4)
        return builder.icmp_signed("!=", value, ir.Constant(INTS, [0] * LANES))

    return lane_mask(array, place), emit


@intrinsic
def store_whole(typing, array, place, value):
    """Write a float32 vector to LANES consecutive elements of an int32 array from `place` on; fractions are cut off."""

    def emit(context, builder, sig, args):
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]), INTS)
        builder.store(builder.fptosi(args[2], INTS), at, align=4)
        return context.get_dummy_value()

    return types.void(array, place, value), emit


@intrinsic
def prefetch(typing, array, place):
    """Load the cache line of an element that is needed soon into the cache.

    This is only a hint to the processor, so `place` may also lie outside the array.
    """

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, *zip(sig.args, args, strict=True), ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [pointer, INT(0), INT(3), INT(1)])
        return context.get_dummy_value()

    return types.void(array, place), emit


def _indices(places) -> ir.Constant:
    """Return the lanes that a shuffle picks, as an LLVM constant; lanes from LANES on belong to its second vector."""
    return ir.Constant(INTS, list(places))


def _fold(builder, x, y, unit: int, span: int):
    """Add neighboring groups of lanes of two vectors, so that one vector holds the sums of both."""
    # Within each `span` of lanes, every two neighboring groups of `unit` lanes are added element by element. In the
    # result the sums of x come first in each span, and the sums of y follow.
    even = [
        source + start + at
        for start in range(0, LANES, span)
        for source in (0, LANES)
        for at in range(span)
        if at // unit % 2 == 0
    ]
    parts = [builder.shuffle_vector(x, y, _indices(at + offset for at in even)) for offset in (0, unit)]
    return builder.fadd(*parts)


def _totals(builder, vectors: list):
    """Return one vector, whose lane k is the sum over the lanes of vector k; 0 in lanes without a vector."""
    rows = vectors + [ir.Constant(FLOATS, [0.0] * LANES)] * (LANES - len(vectors))
    steps = [(1, 4), (1, 4)] + [(4, LANES)] * (LANES.bit_length() - 3)
    for unit, span in steps:
        rows = [_fold(builder, *rows[k : k + 2], unit, span) for k in range(0, len(rows), 2)]
    return rows[0]


@intrinsic
def store_totals(typing, array, place, vectors):
    """Write the sum over the lanes of each vector of a tuple to consecutive elements of a float32 array.

    Zeros follow up to the next multiple of LANES elements.
    """

    def emit(context, builder, sig, args):
        rows = [builder.extract_value(args[2], i) for i in range(len(sig.args[2]))]
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]))
        for k in range(0, len(rows), LANES):
            here = builder.bitcast(builder.gep(at, [_LONG(k)]), FLOATS.as_pointer())
            builder.store(_totals(builder, rows[k : k + LANES]), here, align=4)
        return context.get_dummy_value()

    return types.void(array, place, vectors), emit


def _transposed(builder, rows: list) -> list:
    """Return LANES vectors transposed: lane k of vector i becomes lane i of vector k."""
    fours = range(0, LANES, 4)
    take = lambda x, y, places: builder.shuffle_vector(x, y, _indices(places))
    pick = lambda x, y, a, b, c, d: take(x, y, [g + i for g in fours for i in (a, b, c, d)])
    # Four vectors for each four rows: the first holds the rows' columns 0, 4, ..., the second the columns 1, 5, ...
    blocks = []
    for k in fours:
        low = [pick(rows[i], rows[i + 1], 0, LANES, 1, LANES + 1) for i in (k, k + 2)]
        high = [pick(rows[i], rows[i + 1], 2, LANES + 2, 3, LANES + 3) for i in (k, k + 2)]
        halves = (0, 1, LANES, LANES + 1), (2, 3, LANES + 2, LANES + 3)
        blocks.append([pick(*pair, *half) for pair in (low, high) for half in halves])
    columns = []
    for column in range(LANES):
        start, done = column // 4 * 4, 4
        parts = [take(b[column % 4], b[column % 4], [start + i % 4 for i in range(LANES)]) for b in blocks]
        while len(parts) > 1:
            joined = [source + i for source in (0, LANES) for i in range(done)] * (LANES // (2 * done))
            parts, done = [take(*parts[i : i + 2], joined) for i in range(0, len(parts), 2)], 2 * done
        columns.append(parts[0])
    return columns


@intrinsic
def load_columns(typing, array, width, column, row, last, columns, place):
    """Copy a block of LANES rows and LANES columns of a float32 array [R, width] (flat) into `columns`, transposed.

    Args:
        column, row: first column and first row of the block.
        last: the last row of the array. Rows after it are replaced by it, so that nothing outside the array is read.
        columns: float32 array, output: from `place` on it holds the columns one after the other, LANES numbers each.
    """

    def emit(context, builder, sig, args):
        rows = []
        for lane in range(LANES):
            at = _element(context, builder, sig.args[:5], args[:5], lane)
            rows.append(builder.load(builder.bitcast(at, FLOATS.as_pointer()), align=4))
        to = _pointer(context, builder, (sig.args[5], args[5]), (sig.args[6], args[6]))
        for k, value in enumerate(_transposed(builder, rows)):
            here = builder.gep(to, [_LONG(k * LANES)])
            builder.store(value, builder.bitcast(here, FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, width, column, row, last, columns, place), emit


@intrinsic
def store_columns(typing, array, width, column, row, columns, place):
    """Write LANES columns, stored one after the other in `columns` from `place` on, to a block of an array [R, width].

    This is the inverse of `load_columns` without the limit `last`: the array, stored flat, must have all rows from
    `row` to `row` + LANES - 1, and all columns from `column` to `column` + LANES - 1.
    """

    def emit(context, builder, sig, args):
        source = _pointer(context, builder, (sig.args[4], args[4]), (sig.args[5], args[5]))
        values = []
        for k in range(LANES):
            here = builder.gep(source, [_LONG(k * LANES)])
            values.append(builder.load(builder.bitcast(here, FLOATS.as_pointer()), align=4))
        for lane, value in enumerate(_transposed(builder, values)):
            at = _element(context, builder, sig.args[:4], args[:4], lane)
            builder.store(value, builder.bitcast(at, FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, width, column, row, columns, place), emit


@intrinsic
def total(typing, x):
    """Return the sum over the lanes of a float32 vector, as a number."""

    def emit(context, builder, sig, args):
        return builder.extract_element(_totals(builder, [args[0]]), INT(0))

    return types.float32(x), emit
