"""Loads and stores vectors: consecutive elements, columns of consecutive rows, sums over lanes.

Arrays are contiguous and one-dimensional; bounds are not checked.
"""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from reffusion.kernels.vectors import FLOATS, INT, INTS, LANES, copies, lane_mask, lanes

_LONG = ir.IntType(64)


def _pointer(context, builder, array, place, kind=None):
    """Address of an element of a contiguous one-dimensional array; arguments are (type, value) pairs."""
    data = context.make_array(array[0])(context, builder, array[1]).data
    pointer = builder.gep(data, [context.cast(builder, place[1], place[0], types.intp)])
    return pointer if kind is None else builder.bitcast(pointer, kind.as_pointer())


@intrinsic
def splat_at(typing, array, place):
    """One element of a float32 array in every lane."""

    def emit(context, builder, sig, args):
        return copies(builder, FLOATS, builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True))))

    return lanes(array, place), emit


@intrinsic
def load(typing, array, place):
    """LANES consecutive elements of a float32 array."""

    def emit(context, builder, sig, args):
        return builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True), FLOATS), align=4)

    return lanes(array, place), emit


@intrinsic
def store(typing, array, place, value):
    """Write LANES consecutive elements."""

    def emit(context, builder, sig, args):
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]), FLOATS)
        builder.store(args[2], at, align=4)
        return context.get_dummy_value()

    return types.void(array, place, value), emit


def _element(context, builder, kinds, values, lane: int):
    """Address of [row + lane, column] of a flat array [R, width], given as array, width, column, row (and last row)."""
    data = context.make_array(kinds[0])(context, builder, values[0]).data
    pairs = zip(values[1:], kinds[1:], strict=True)
    width, column, row, *last = (context.cast(builder, value, kind, types.intp) for value, kind in pairs)
    here = builder.add(row, row.type(lane))
    if last:
        here = builder.select(builder.icmp_signed("<", here, last[0]), here, last[0])
    return builder.gep(data, [builder.add(builder.mul(here, width), column)])


@intrinsic
def load_column(typing, array, width, column, row, last):
    """One column of LANES consecutive rows of a float32 array [R, width] (flat); rows after `last` repeat it."""

    def emit(context, builder, sig, args):
        value = ir.Constant(FLOATS, ir.Undefined)
        for lane in range(LANES):
            number = builder.load(_element(context, builder, sig.args, args, lane))
            value = builder.insert_element(value, number, INT(lane))
        return value

    return lanes(array, width, column, row, last), emit


@intrinsic
def store_column(typing, array, width, column, row, value):
    """Write one column of LANES consecutive rows of a float32 array [R, width] (flat)."""

    def emit(context, builder, sig, args):
        for lane in range(LANES):
            at = _element(context, builder, sig.args[:4], args[:4], lane)
            builder.store(builder.extract_element(args[4], INT(lane)), at)
        return context.get_dummy_value()

    return types.void(array, width, column, row, value), emit


@intrinsic
def load_mask(typing, array, place):
    """A mask of the nonzero ones among LANES consecutive elements of an int32 array."""

    def emit(context, builder, sig, args):
        value = builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True), INTS), align=4)
        return builder.icmp_signed("!=", value, ir.Constant(INTS, [0] * LANES))

    return lane_mask(array, place), emit


@intrinsic
def store_whole(typing, array, place, value):
    """Write LANES consecutive elements of an int32 array; values are truncated."""

    def emit(context, builder, sig, args):
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]), INTS)
        builder.store(builder.fptosi(args[2], INTS), at, align=4)
        return context.get_dummy_value()

    return types.void(array, place, value), emit


@intrinsic
def prefetch(typing, array, place):
    """Prefetch the cache line of an element that is needed soon; only a hint, so any index is allowed."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, *zip(sig.args, args, strict=True), ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [pointer, INT(0), INT(3), INT(1)])
        return context.get_dummy_value()

    return types.void(array, place), emit


def _indices(places) -> ir.Constant:
    return ir.Constant(INTS, list(places))


def _fold(builder, x, y, unit: int, span: int):
    """For each span of lanes: the sums of neighbouring units of x, then those of y."""
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
    """One vector: lane k is the sum over the lanes of vector k."""
    rows = vectors + [ir.Constant(FLOATS, [0.0] * LANES)] * (LANES - len(vectors))
    steps = [(1, 4), (1, 4)] + [(4, LANES)] * (LANES.bit_length() - 3)
    for unit, span in steps:
        rows = [_fold(builder, *rows[k : k + 2], unit, span) for k in range(0, len(rows), 2)]
    return rows[0]


@intrinsic
def store_totals(typing, array, place, vectors):
    """Write the sums over lanes of each vector of a tuple; zeros up to the next multiple of LANES."""

    def emit(context, builder, sig, args):
        rows = [builder.extract_value(args[2], i) for i in range(len(sig.args[2]))]
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]))
        for k in range(0, len(rows), LANES):
            here = builder.bitcast(builder.gep(at, [_LONG(k)]), FLOATS.as_pointer())
            builder.store(_totals(builder, rows[k : k + LANES]), here, align=4)
        return context.get_dummy_value()

    return types.void(array, place, vectors), emit


def _transposed(builder, rows: list) -> list:
    """Transpose LANES vectors: lane k of vector i becomes lane i of vector k."""
    fours = range(0, LANES, 4)
    take = lambda x, y, places: builder.shuffle_vector(x, y, _indices(places))
    pick = lambda x, y, a, b, c, d: take(x, y, [g + i for g in fours for i in (a, b, c, d)])
    blocks = []  # for each four rows, vectors with columns 0, 4, ... of them; then 1, 5, ...; and so on
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
    """Copy LANES columns of LANES rows of a float32 array [R, width] (flat), one after the other, into `columns`.

    Rows after `last` repeat it.
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
    """The inverse of `load_columns`: write LANES columns of LANES rows from `columns`."""

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
    """Sum over the lanes."""

    def emit(context, builder, sig, args):
        return builder.extract_element(_totals(builder, [args[0]]), INT(0))

    return types.float32(x), emit
