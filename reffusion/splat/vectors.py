"""A few float32 or float64 lanes as one numba value, a thin layer over LLVM vectors.

numba's loops are vectorised only when LLVM finds it safe and worthwhile, which it does not for blending. These few
operations say it outright; the compiler turns them into AVX-512, AVX2 or SSE instructions. There are LANES to a value:
sixteen where the processor has AVX-512, else eight.

Operators work lane by lane, a number on one side standing for as many copies; comparisons give masks.
"""

from __future__ import annotations

import math
import operator

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import config
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model


def _has_avx512() -> bool:
    """Whether numba will compile for AVX-512 (NUMBA_CPU_FEATURES overrules the processor)."""
    if config.CPU_FEATURES is not None:
        return "+avx512f" in config.CPU_FEATURES.split(",")
    return llvmlite.binding.get_host_cpu_features().get("avx512f", False)


LANES = 16 if _has_avx512() else 8

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_LONGS = ir.VectorType(ir.IntType(64), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_INT = ir.IntType(32)

# Minimax polynomial of degree 5 for 2^f on [-0.5, 0.5]: relative error 7.5e-8, 2.1e-7 with float32 rounding.
_EXP2 = (1.0000000717, 0.6931469671, 0.2402211972, 0.0555071327, 0.0096755413, 0.0013276472)
_EXP2_DOUBLE = tuple(math.log(2) ** k / math.factorial(k) for k in range(13))  # series: 2e-16 on [-0.5, 0.5]


class _Vector(types.Type):
    """`lanes`, `wide` or `lane_mask`."""


lanes, wide, lane_mask = _Vector(f"float32x{LANES}"), _Vector(f"float64x{LANES}"), _Vector(f"boolx{LANES}")
_IR = {lanes: _FLOATS, wide: _DOUBLES, lane_mask: _BITS}


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _IR[kind])


def _constant(kind: ir.VectorType, value: float) -> ir.Constant:
    if kind.element == ir.FloatType():
        value = float(np.float32(value))
    return ir.Constant(kind, [value] * LANES)


def _call(builder, name: str, *arguments):
    """An LLVM intrinsic on whole vectors, all of one type."""
    kind = arguments[0].type
    name = f"llvm.{name}.v{LANES}f{32 if kind == _FLOATS else 64}"
    function_type = ir.FunctionType(kind, [kind] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), arguments)


def _fma(builder, x, y, z):
    """Fused where the processor can."""
    return _call(builder, "fmuladd", x, y, z)


def _copies(builder, kind: ir.VectorType, number):
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), number, _INT(0))
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), ir.Constant(_INTS, [0] * LANES))


def _as_vector(context, builder, value, have, want):
    """A vector as it is, a number copied to all lanes."""
    if have == want:
        return value
    number = types.float32 if want == lanes else types.float64
    return _copies(builder, _IR[want], context.cast(builder, value, have, number))


def _teach(symbol, emit, kind, result):
    """Teach numba `left symbol right` on vectors of a kind, either of them a number perhaps."""
    pairs = [(kind, kind)]
    if kind != lane_mask:
        pairs += [pair for number in (types.float32, types.float64) for pair in ((kind, number), (number, kind))]

    @infer_global(symbol)
    class _Typing(ConcreteTemplate):
        cases = tuple(signature(result, *pair) for pair in pairs)

    for pair in pairs:

        @lower_builtin(symbol, *pair)
        def _lower(context, builder, sig, args):
            both = (_as_vector(context, builder, value, have, kind) for value, have in zip(args, sig.args, strict=True))
            return emit(builder, *both)


for _kind in (lanes, wide):
    _teach(operator.add, lambda b, x, y: b.fadd(x, y), _kind, _kind)
    _teach(operator.sub, lambda b, x, y: b.fsub(x, y), _kind, _kind)
    _teach(operator.mul, lambda b, x, y: b.fmul(x, y), _kind, _kind)
    _teach(operator.truediv, lambda b, x, y: b.fdiv(x, y), _kind, _kind)
    _teach(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), _kind, lane_mask)
    _teach(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), _kind, lane_mask)
    _teach(operator.le, lambda b, x, y: b.fcmp_ordered("<=", x, y), _kind, lane_mask)
    _teach(operator.ge, lambda b, x, y: b.fcmp_ordered(">=", x, y), _kind, lane_mask)
_teach(operator.and_, lambda b, x, y: b.and_(x, y), lane_mask, lane_mask)

# ------------------------------------------------------------------------------------------------------- memory


def _pointer(context, builder, array, place, kind=None):
    """Address of an element of a contiguous one-dimensional array; arguments are (type, value) pairs."""
    data = context.make_array(array[0])(context, builder, array[1]).data
    pointer = builder.gep(data, [context.cast(builder, place[1], place[0], types.intp)])
    return pointer if kind is None else builder.bitcast(pointer, kind.as_pointer())


@intrinsic
def splat(typing, value):
    """The same float32 in every lane."""

    def emit(context, builder, sig, args):
        return _as_vector(context, builder, args[0], sig.args[0], lanes)

    return lanes(value), emit


@intrinsic
def splat_at(typing, array, place):
    """An element of a contiguous one-dimensional float32 array in every lane (no bounds check, here and below)."""

    def emit(context, builder, sig, args):
        return _copies(builder, _FLOATS, builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True))))

    return lanes(array, place), emit


@intrinsic
def load(typing, array, place):
    """LANES consecutive elements of a float32 array."""

    def emit(context, builder, sig, args):
        return builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True), _FLOATS), align=4)

    return lanes(array, place), emit


@intrinsic
def store(typing, array, place, value):
    """Write LANES consecutive elements."""

    def emit(context, builder, sig, args):
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]), _FLOATS)
        builder.store(args[2], at, align=4)
        return context.get_dummy_value()

    return types.void(array, place, value), emit


@intrinsic
def load_column(typing, array, width, column, row, last):
    """One column of LANES consecutive rows of a float32 array [R, width] (flat), row `last` standing for later ones."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        width, column, row, last = (
            context.cast(builder, a, t, types.intp) for a, t in zip(args[1:], sig.args[1:], strict=True)
        )
        value = ir.Constant(_FLOATS, ir.Undefined)
        for lane in range(LANES):
            here = builder.add(row, row.type(lane))
            here = builder.select(builder.icmp_signed("<", here, last), here, last)
            number = builder.load(builder.gep(data, [builder.add(builder.mul(here, width), column)]))
            value = builder.insert_element(value, number, _INT(lane))
        return value

    return lanes(array, width, column, row, last), emit


@intrinsic
def store_column(typing, array, width, column, row, value):
    """Write one column of LANES consecutive rows of a float32 array [R, width] (flat)."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        width, column, row = (
            context.cast(builder, a, t, types.intp) for a, t in zip(args[1:4], sig.args[1:4], strict=True)
        )
        for lane in range(LANES):
            place = builder.add(builder.mul(builder.add(row, row.type(lane)), width), column)
            builder.store(builder.extract_element(args[4], _INT(lane)), builder.gep(data, [place]))
        return context.get_dummy_value()

    return types.void(array, width, column, row, value), emit


@intrinsic
def load_mask(typing, array, place):
    """Which of LANES consecutive elements of an int32 array are not 0."""

    def emit(context, builder, sig, args):
        value = builder.load(_pointer(context, builder, *zip(sig.args, args, strict=True), _INTS), align=4)
        return builder.icmp_signed("!=", value, ir.Constant(_INTS, [0] * LANES))

    return lane_mask(array, place), emit


@intrinsic
def store_whole(typing, array, place, value):
    """Write LANES consecutive elements of an int32 array, the values cut off at the point."""

    def emit(context, builder, sig, args):
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]), _INTS)
        builder.store(builder.fptosi(args[2], _INTS), at, align=4)
        return context.get_dummy_value()

    return types.void(array, place, value), emit


@intrinsic
def prefetch(typing, array, place):
    """Ask for the cache line of an element that will be needed soon (any place will do, it is only a hint)."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, *zip(sig.args, args, strict=True), ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [pointer, _INT(0), _INT(3), _INT(1)])
        return context.get_dummy_value()

    return types.void(array, place), emit


@intrinsic
def take_ticket(typing, counter):
    """Add 1 to counter[0] (int64) atomically and return what it was."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), emit


# --------------------------------------------------------------------------------------------------- arithmetic


@intrinsic
def ramp(typing):
    """0, 1, ... LANES - 1."""

    def emit(context, builder, sig, args):
        return ir.Constant(_FLOATS, [float(i) for i in range(LANES)])

    return lanes(), emit


@intrinsic
def fma(typing, x, y, z):
    """x y + z, rounded once where the processor can."""

    def emit(context, builder, sig, args):
        return _fma(builder, *args)

    return x(x, y, z), emit


@intrinsic
def fnma(typing, x, y, z):
    """z - x y, rounded once where the processor can."""

    def emit(context, builder, sig, args):
        return _fma(builder, builder.fneg(args[0]), args[1], args[2])

    return x(x, y, z), emit


@intrinsic
def minimum(typing, x, y):
    """The smaller; y where x is not a number."""

    def emit(context, builder, sig, args):
        both = [_as_vector(context, builder, value, have, x) for value, have in zip(args, sig.args, strict=True)]
        return builder.select(builder.fcmp_ordered("<", *both), *both)

    return x(x, y), emit


@intrinsic
def maximum(typing, x, y):
    """The larger; y where x is not a number."""

    def emit(context, builder, sig, args):
        both = [_as_vector(context, builder, value, have, x) for value, have in zip(args, sig.args, strict=True)]
        return builder.select(builder.fcmp_ordered(">", *both), *both)

    return x(x, y), emit


@intrinsic
def minus_abs(typing, x):
    """-|x|."""

    def emit(context, builder, sig, args):
        return builder.fneg(_call(builder, "fabs", args[0]))

    return x(x), emit


@intrinsic
def root(typing, x):
    """Square root."""

    def emit(context, builder, sig, args):
        return _call(builder, "sqrt", args[0])

    return x(x), emit


@intrinsic
def ceiling(typing, x):
    """The next whole number."""

    def emit(context, builder, sig, args):
        return _call(builder, "ceil", args[0])

    return x(x), emit


@intrinsic
def select(typing, mask, x, y):
    """x where the mask is set, else y; one of them may be a number."""
    kind = x if isinstance(x, _Vector) else y

    def emit(context, builder, sig, args):
        x, y = (
            _as_vector(context, builder, value, have, kind) for value, have in zip(args[1:], sig.args[1:], strict=True)
        )
        return builder.select(args[0], x, y)

    return kind(mask, x, y), emit


@intrinsic
def some(typing, mask):
    """Whether any lane of the mask is set."""

    def emit(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), emit


@intrinsic
def widen(typing, x):
    """float32 lanes as float64."""

    def emit(context, builder, sig, args):
        return builder.fpext(args[0], _DOUBLES)

    return wide(x), emit


@intrinsic
def narrow(typing, x):
    """float64 lanes rounded to float32."""

    def emit(context, builder, sig, args):
        return builder.fptrunc(args[0], _FLOATS)

    return lanes(x), emit


def _exp2(builder, x):
    """2^x by a polynomial in what is left of x after rounding; adding 1.5 2^p rounds, its low bits are the integer."""
    single = x.type == _FLOATS
    whole_type, shift, series = (_INTS, 23, _EXP2) if single else (_LONGS, 52, _EXP2_DOUBLE)
    magic = _constant(x.type, 1.5 * 2.0**shift)
    shifted = builder.fadd(x, magic)
    part = builder.fsub(x, builder.fsub(shifted, magic))
    value = _constant(x.type, series[-1])
    for coefficient in series[-2::-1]:
        value = _fma(builder, value, part, _constant(x.type, coefficient))
    exponent = builder.shl(builder.bitcast(shifted, whole_type), ir.Constant(whole_type, [shift] * LANES))
    return builder.bitcast(builder.add(builder.bitcast(value, whole_type), exponent), x.type)


@intrinsic
def exp2(typing, x):
    """2^x for x in [-126, 127], relative error below 2e-7; anything (not a trap) outside."""

    def emit(context, builder, sig, args):
        return _exp2(builder, args[0])

    return x(x), emit


@intrinsic
def log2(typing, x):
    """log2 of positive normal float64 lanes; anything (not a trap) elsewhere."""

    def emit(context, builder, sig, args):
        number = lambda value: ir.Constant(_LONGS, [int(np.float64(value).view(np.int64))] * LANES)
        bits = builder.bitcast(args[0], _LONGS)
        # x = 2^e m with m between sqrt(1/2) and sqrt(2); ln m = 2 artanh s, s = (m - 1) / (m + 1)
        e = builder.ashr(builder.sub(bits, number(math.sqrt(0.5))), ir.Constant(_LONGS, [52] * LANES))
        m = builder.bitcast(builder.sub(bits, builder.shl(e, ir.Constant(_LONGS, [52] * LANES))), _DOUBLES)
        one, magic = _constant(_DOUBLES, 1.0), 1.5 * 2.0**52
        s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))
        square, value = builder.fmul(s, s), _constant(_DOUBLES, 0.0)
        for power in range(19, 0, -2):
            value = _fma(builder, value, square, _constant(_DOUBLES, 2.0 / math.log(2) / power))
        whole = builder.fsub(builder.bitcast(builder.add(e, number(magic)), _DOUBLES), _constant(_DOUBLES, magic))
        return _fma(builder, value, s, whole)

    return wide(x), emit


# --------------------------------------------------------------------------------------------- across the lanes


def _indices(places) -> ir.Constant:
    return ir.Constant(_INTS, list(places))


def _fold(builder, x, y, unit: int, span: int):
    """In each span of lanes, the sums of neighbouring units of x, then those of y."""
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
    rows = vectors + [_constant(_FLOATS, 0.0)] * (LANES - len(vectors))
    steps = [(1, 4), (1, 4)] + [(4, LANES)] * (LANES.bit_length() - 3)
    for unit, span in steps:
        rows = [_fold(builder, *rows[k : k + 2], unit, span) for k in range(0, len(rows), 2)]
    return rows[0]


@intrinsic
def store_totals(typing, array, place, vectors):
    """Write the sums over the lanes of the vectors of a tuple; zeros up to the next multiple of LANES."""

    def emit(context, builder, sig, args):
        rows = [builder.extract_value(args[2], i) for i in range(len(sig.args[2]))]
        at = _pointer(context, builder, (sig.args[0], args[0]), (sig.args[1], args[1]))
        for k in range(0, len(rows), LANES):
            here = builder.bitcast(builder.gep(at, [ir.IntType(64)(k)]), _FLOATS.as_pointer())
            builder.store(_totals(builder, rows[k : k + LANES]), here, align=4)
        return context.get_dummy_value()

    return types.void(array, place, vectors), emit


@intrinsic
def total(typing, x):
    """Sum over the lanes."""

    def emit(context, builder, sig, args):
        return builder.extract_element(_totals(builder, [args[0]]), _INT(0))

    return types.float32(x), emit
