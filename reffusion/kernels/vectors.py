"""Vectors of LANES numbers as values of numba kernels, a thin layer over LLVM vectors.

A *lane* is one number of a vector. LANES is sixteen if the processor has AVX-512, else eight. The types are `lanes`
(float32), `wide` (float64) and `lane_mask` (a bit per lane). LLVM vectorizes a loop only if it finds this safe and
worthwhile, which it does not for blending. With these operations a kernel is vectorized explicitly; the compiler turns
them into AVX-512, AVX2 or SSE instructions.

Operators work lane by lane. If one side is a number, each lane uses this number. Comparisons return masks.

Each `@intrinsic` describes a function of kernels, whose arguments follow `typing`; it returns the signature of this
function, and the code generator `emit` that writes its LLVM instructions.
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
    """Return whether numba compiles for AVX-512; NUMBA_CPU_FEATURES overrides what the processor has."""
    if config.CPU_FEATURES is not None:
        return "+avx512f" in config.CPU_FEATURES.split(",")
    return llvmlite.binding.get_host_cpu_features().get("avx512f", False)


LANES = 16 if _has_avx512() else 8

FLOATS = ir.VectorType(ir.FloatType(), LANES)
DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
INTS = ir.VectorType(ir.IntType(32), LANES)
LONGS = ir.VectorType(ir.IntType(64), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
INT = ir.IntType(32)

ROUND = 1.5 * 2.0**23  # the sum of this and a small float32 has the nearest integer in its low bits
# Coefficients of the minimax polynomial of degree 5 for 2^f on [-0.5, 0.5], lowest power first. Its relative error is
# 7.5e-8, and 2.1e-7 with float32 rounding.
EXP2 = (1.0000000717, 0.6931469671, 0.2402211972, 0.0555071327, 0.0096755413, 0.0013276472)
# Taylor coefficients of 2^f, lowest power first; the relative error on [-0.5, 0.5] is 2e-16.
_EXP2_DOUBLE = tuple(math.log(2) ** k / math.factorial(k) for k in range(13))


class _Vector(types.Type):
    """The numba type of a vector; its instances are `lanes`, `wide` and `lane_mask`."""


lanes, wide, lane_mask = _Vector(f"float32x{LANES}"), _Vector(f"float64x{LANES}"), _Vector(f"boolx{LANES}")
_IR = {lanes: FLOATS, wide: DOUBLES, lane_mask: _BITS}


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _IR[kind])


def _constant(kind: ir.VectorType, value: float) -> ir.Constant:
    """Return an LLVM vector of type `kind` with `value` in every lane."""
    if kind.element == ir.FloatType():
        value = float(np.float32(value))
    return ir.Constant(kind, [value] * LANES)


def _call(builder, name: str, *arguments):
    """Call the LLVM intrinsic `name` on whole vectors; the arguments and the result have one type."""
    kind = arguments[0].type
    name = f"llvm.{name}.v{LANES}f{32 if kind == FLOATS else 64}"
    function_type = ir.FunctionType(kind, [kind] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), arguments)


def _fma(builder, x, y, z):
    """Return x y + z, as a fused multiply-add if the processor supports it."""
    return _call(builder, "fmuladd", x, y, z)


def copies(builder, kind: ir.VectorType, number):
    """Return an LLVM vector of type `kind` with `number` in every lane."""
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), number, INT(0))
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), ir.Constant(INTS, [0] * LANES))


def _as_vector(context, builder, value, have, want):
    """Return a vector of type `want`: `value` itself if it has this type, else the number `value` in every lane."""
    if have == want:
        return value
    number = types.float32 if want == lanes else types.float64
    return copies(builder, _IR[want], context.cast(builder, value, have, number))


def _register_operator(symbol, emit, kind, result):
    """Register a binary operator in numba for two vectors, or a vector and a number unless vectors are masks.

    Args:
        symbol: the operator, as `operator.add`.
        emit: emit(builder, x, y) writes the LLVM instruction.
        kind, result: numba types of the vectors and of the result.
    """
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
    _register_operator(operator.add, lambda b, x, y: b.fadd(x, y), _kind, _kind)
    _register_operator(operator.sub, lambda b, x, y: b.fsub(x, y), _kind, _kind)
    _register_operator(operator.mul, lambda b, x, y: b.fmul(x, y), _kind, _kind)
    _register_operator(operator.truediv, lambda b, x, y: b.fdiv(x, y), _kind, _kind)
    _register_operator(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), _kind, lane_mask)
    _register_operator(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), _kind, lane_mask)
    _register_operator(operator.le, lambda b, x, y: b.fcmp_ordered("<=", x, y), _kind, lane_mask)
    _register_operator(operator.ge, lambda b, x, y: b.fcmp_ordered(">=", x, y), _kind, lane_mask)
_register_operator(operator.and_, lambda b, x, y: b.and_(x, y), lane_mask, lane_mask)


@intrinsic
def splat(typing, value):
    """Return a float32 vector with the number `value` in every lane."""

    def emit(context, builder, sig, args):
        return _as_vector(context, builder, args[0], sig.args[0], lanes)

    return lanes(value), emit


@intrinsic
def ramp(typing):
    """Return the float32 vector 0, 1, ... LANES - 1."""

    def emit(context, builder, sig, args):
        return ir.Constant(FLOATS, [float(i) for i in range(LANES)])

    return lanes(), emit


@intrinsic
def fma(typing, x, y, z):
    """Return x y + z, rounded once if the processor supports it, else twice."""

    def emit(context, builder, sig, args):
        return _fma(builder, *args)

    return x(x, y, z), emit


@intrinsic
def fnma(typing, x, y, z):
    """Return z - x y, rounded once if the processor supports it, else twice."""

    def emit(context, builder, sig, args):
        return _fma(builder, builder.fneg(args[0]), args[1], args[2])

    return x(x, y, z), emit


@intrinsic
def minimum(typing, x, y):
    """Return the smaller of x and y in each lane; y where either is NaN. y may be a number."""

    def emit(context, builder, sig, args):
        both = [_as_vector(context, builder, value, have, x) for value, have in zip(args, sig.args, strict=True)]
        return builder.select(builder.fcmp_ordered("<", *both), *both)

    return x(x, y), emit


@intrinsic
def maximum(typing, x, y):
    """Return the larger of x and y in each lane; y where either is NaN. y may be a number."""

    def emit(context, builder, sig, args):
        both = [_as_vector(context, builder, value, have, x) for value, have in zip(args, sig.args, strict=True)]
        return builder.select(builder.fcmp_ordered(">", *both), *both)

    return x(x, y), emit


@intrinsic
def root(typing, x):
    """Return the square root of each lane."""

    def emit(context, builder, sig, args):
        return _call(builder, "sqrt", args[0])

    return x(x), emit


@intrinsic
def ceiling(typing, x):
    """Return each lane rounded up to a whole number, as a vector of the same type."""

    def emit(context, builder, sig, args):
        return _call(builder, "ceil", args[0])

    return x(x), emit


@intrinsic
def select(typing, mask, x, y):
    """Return x in the lanes where the mask is set, and y in all other lanes; one of x and y may be a number."""
    kind = x if isinstance(x, _Vector) else y

    def emit(context, builder, sig, args):
        x, y = (
            _as_vector(context, builder, value, have, kind) for value, have in zip(args[1:], sig.args[1:], strict=True)
        )
        return builder.select(args[0], x, y)

    return kind(mask, x, y), emit


@intrinsic
def any_lane(typing, mask):
    """Return whether any lane of the mask is set."""

    def emit(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), emit


@intrinsic
def widen(typing, x):
    """Return a float32 vector converted to float64."""

    def emit(context, builder, sig, args):
        return builder.fpext(args[0], DOUBLES)

    return wide(x), emit


@intrinsic
def narrow(typing, x):
    """Return a float64 vector rounded to float32."""

    def emit(context, builder, sig, args):
        return builder.fptrunc(args[0], FLOATS)

    return lanes(x), emit


@intrinsic
def times_power(typing, x, rounded):
    """Return x 2^n in each lane of a float32 vector, by adding n to the exponent of x.

    Args:
        x: float32 vector.
        rounded: float32 vector n + ROUND, with integers n in its low bits.
    """

    def emit(context, builder, sig, args):
        exponent = builder.shl(builder.bitcast(args[1], INTS), ir.Constant(INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(args[0], INTS), exponent), FLOATS)

    return lanes(lanes, lanes), emit


@intrinsic
def exp2(typing, x):
    """Return 2^x of a float64 vector in [-1022, 1023]; outside this range the result is undefined, without a trap."""

    def emit(context, builder, sig, args):
        magic, value = _constant(DOUBLES, 1.5 * 2.0**52), _constant(DOUBLES, _EXP2_DOUBLE[-1])
        shifted = builder.fadd(args[0], magic)
        part = builder.fsub(args[0], builder.fsub(shifted, magic))
        for coefficient in _EXP2_DOUBLE[-2::-1]:
            value = _fma(builder, value, part, _constant(DOUBLES, coefficient))
        exponent = builder.shl(builder.bitcast(shifted, LONGS), ir.Constant(LONGS, [52] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, LONGS), exponent), DOUBLES)

    return wide(wide), emit


@intrinsic
def log2(typing, x):
    """Return log2(x) of a float64 vector of positive normal numbers; for others it is undefined, without a trap."""

    def emit(context, builder, sig, args):
        number = lambda value: ir.Constant(LONGS, [int(np.float64(value).view(np.int64))] * LANES)
        bits = builder.bitcast(args[0], LONGS)
        # x = 2^e m with m between sqrt(1/2) and sqrt(2); ln m = 2 artanh s with s = (m - 1) / (m + 1), by its series.
        e = builder.ashr(builder.sub(bits, number(math.sqrt(0.5))), ir.Constant(LONGS, [52] * LANES))
        m = builder.bitcast(builder.sub(bits, builder.shl(e, ir.Constant(LONGS, [52] * LANES))), DOUBLES)
        one, magic = _constant(DOUBLES, 1.0), 1.5 * 2.0**52
        s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))
        square, value = builder.fmul(s, s), _constant(DOUBLES, 0.0)
        for power in range(19, 0, -2):
            value = _fma(builder, value, square, _constant(DOUBLES, 2.0 / math.log(2) / power))
        whole = builder.fsub(builder.bitcast(builder.add(e, number(magic)), DOUBLES), _constant(DOUBLES, magic))
        return _fma(builder, value, s, whole)

    return wide(x), emit


@intrinsic
def take_ticket(typing, counter):
    """Return counter[0] (int64) and atomically add 1 to it, so that no two threads get the same number."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), emit
