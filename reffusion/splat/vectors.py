"""Sixteen float32 lanes as one numba value, a thin layer over LLVM vectors.

numba's loops are vectorised only when LLVM finds it safe and worthwhile, which it does not for blending. These few
operations say it outright; the compiler turns them into AVX-512, AVX2 (two halves) or SSE (four quarters).
"""

from __future__ import annotations

import operator

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)

# Minimax polynomial of degree 5 for 2^f on [-0.5, 0.5]: relative error 7.5e-8, 2.1e-7 with float32 rounding.
_EXP2 = (1.0000000717, 0.6931469671, 0.2402211972, 0.0555071327, 0.0096755413, 0.0013276472)


class _Lanes(types.Type):
    def __init__(self):
        super().__init__("float32x16")


class _LaneMask(types.Type):
    def __init__(self):
        super().__init__("bool_x16")


lanes = _Lanes()
lane_mask = _LaneMask()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _FLOATS)


@register_model(_LaneMask)
class _LaneMaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _BITS)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)


def _call(builder, name: str, *arguments):
    """An LLVM intrinsic on whole vectors."""
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(arguments))
    function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(function, arguments)


def _binary(symbol, emit, left, right, result):
    """Teach numba `left symbol right`."""

    @infer_global(symbol)
    class _Typing(ConcreteTemplate):
        cases = (signature(result, left, right),)

    @lower_builtin(symbol, left, right)
    def _lower(context, builder, sig, args):
        return emit(builder, *args)


_binary(operator.add, lambda b, x, y: b.fadd(x, y), lanes, lanes, lanes)
_binary(operator.sub, lambda b, x, y: b.fsub(x, y), lanes, lanes, lanes)
_binary(operator.mul, lambda b, x, y: b.fmul(x, y), lanes, lanes, lanes)
_binary(operator.truediv, lambda b, x, y: b.fdiv(x, y), lanes, lanes, lanes)
_binary(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), lanes, lanes, lane_mask)
_binary(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), lanes, lanes, lane_mask)
_binary(operator.ge, lambda b, x, y: b.fcmp_ordered(">=", x, y), lanes, lanes, lane_mask)
_binary(operator.and_, lambda b, x, y: b.and_(x, y), lane_mask, lane_mask, lane_mask)


@intrinsic
def splat(typing, value):
    """The same float32 in every lane."""

    def emit(context, builder, sig, args):
        value = context.cast(builder, args[0], sig.args[0], types.float32)
        one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(one, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INTS, [0] * LANES))

    return lanes(value), emit


@intrinsic
def pack(typing, values):
    """Sixteen float32 of a tuple, one to a lane."""

    def emit(context, builder, sig, args):
        packed = ir.Constant(_FLOATS, ir.Undefined)
        for i in range(LANES):
            packed = builder.insert_element(packed, builder.extract_value(args[0], i), ir.Constant(ir.IntType(32), i))
        return packed

    return lanes(values), emit


@intrinsic
def ramp(typing):
    """0, 1, ... 15."""

    def emit(context, builder, sig, args):
        return ir.Constant(_FLOATS, [float(i) for i in range(LANES)])

    return lanes(), emit


def _pointer(context, builder, sig, args):
    """Address of element args[1] of a contiguous one-dimensional float32 array."""
    data = context.make_array(sig.args[0])(context, builder, args[0]).data
    place = context.cast(builder, args[1], sig.args[1], types.intp)
    return builder.bitcast(builder.gep(data, [place]), _FLOATS.as_pointer())


@intrinsic
def load(typing, array, place):
    """Sixteen consecutive elements of a contiguous one-dimensional float32 array (no bounds check)."""

    def emit(context, builder, sig, args):
        return builder.load(_pointer(context, builder, sig, args), align=4)

    return lanes(array, place), emit


@intrinsic
def store(typing, array, place, value):
    """Write sixteen consecutive elements."""

    def emit(context, builder, sig, args):
        builder.store(args[2], _pointer(context, builder, sig, args), align=4)
        return context.get_dummy_value()

    return types.void(array, place, value), emit


@intrinsic
def prefetch(typing, array, place):
    """Ask for the cache line of an element that will be needed soon (any place will do, it is only a hint)."""

    def emit(context, builder, sig, args):
        pointer = builder.bitcast(_pointer(context, builder, sig, args), ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
        name = "llvm.prefetch.p0i8"
        function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        builder.call(function, [pointer, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, place), emit


@intrinsic
def fma(typing, x, y, z):
    """x y + z, rounded once."""

    def emit(context, builder, sig, args):
        return _call(builder, "llvm.fma.v16f32", *args)

    return lanes(x, y, z), emit


@intrinsic
def fnma(typing, x, y, z):
    """z - x y, rounded once."""

    def emit(context, builder, sig, args):
        return _call(builder, "llvm.fma.v16f32", builder.fneg(args[0]), args[1], args[2])

    return lanes(x, y, z), emit


@intrinsic
def minimum(typing, x, y):
    def emit(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return lanes(x, y), emit


@intrinsic
def negative(typing, x):
    def emit(context, builder, sig, args):
        return builder.fneg(args[0])

    return lanes(x), emit


@intrinsic
def select(typing, mask, x, y):
    """x where the mask is set, else y."""

    def emit(context, builder, sig, args):
        return builder.select(*args)

    return lanes(mask, x, y), emit


@intrinsic
def some(typing, mask):
    """Whether any lane of the mask is set."""

    def emit(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), emit


@intrinsic
def exp2(typing, x):
    """2^x for x in [-126, 127], relative error below 2e-7; anything (not a trap) outside."""

    def emit(context, builder, sig, args):
        whole = _call(builder, "llvm.rint.v16f32", args[0])
        part = builder.fsub(args[0], whole)
        value = _constant(_EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            value = _call(builder, "llvm.fma.v16f32", value, part, _constant(coefficient))
        exponent = builder.shl(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _FLOATS)

    return lanes(x), emit


@intrinsic
def total(typing, x):
    """Sum over the lanes, pairwise."""

    def emit(context, builder, sig, args):
        value = args[0]
        for step in (8, 4, 2, 1):
            turned = [(i + step) % LANES for i in range(LANES)]
            value = builder.fadd(value, builder.shuffle_vector(value, value, ir.Constant(_INTS, turned)))
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(x), emit


@intrinsic
def totals(typing, vectors):
    """Sums over the lanes of up to sixteen vectors, given as a tuple: lane k of the result is the sum of vector k."""

    def emit(context, builder, sig, args):
        rows = [builder.extract_value(args[0], i) for i in range(len(sig.args[0]))]
        rows += [ir.Constant(_FLOATS, [0.0] * LANES)] * (LANES - len(rows))
        rows = [rows[int(f"{i:04b}"[::-1], 2)] for i in range(LANES)]  # folding leaves them in bit-reversed order
        # Fold halves: each round puts two vectors side by side, with half as many partial sums of each.
        width = LANES
        while width > 1:
            half, pairs = width // 2, len(rows) // 2
            low = [i for block in range(0, LANES, width) for i in range(block, block + half)]
            keep = [*low, *(LANES + i for i in low)]
            fold = [i + half for i in keep]
            rows = [
                builder.fadd(
                    builder.shuffle_vector(rows[k], rows[k + pairs], ir.Constant(_INTS, keep)),
                    builder.shuffle_vector(rows[k], rows[k + pairs], ir.Constant(_INTS, fold)),
                )
                for k in range(pairs)
            ]
            width = half
        return rows[0]

    return lanes(vectors), emit


_TRIPLE = types.UniTuple(lanes, 3)


def _place_of(source: int) -> ir.Constant:
    return ir.Constant(ir.IntType(32), source)


@intrinsic
def thrice(typing, x):
    """Three vectors that hold each lane three times in a row: 0 0 0 1 1 1 ... 15 15 15."""

    def emit(context, builder, sig, args):
        parts = [
            builder.shuffle_vector(args[0], args[0], ir.Constant(_INTS, [(16 * q + i) // 3 for i in range(LANES)]))
            for q in range(3)
        ]
        return context.make_tuple(builder, _TRIPLE, parts)

    return _TRIPLE(x), emit


@intrinsic
def striped(typing, red, green, blue):
    """Three vectors red green blue red green blue ..., 48 lanes in all."""

    def emit(context, builder, sig, args):
        colors = ir.Constant(_FLOATS, ir.Undefined)
        for c in range(3):
            colors = builder.insert_element(
                colors, context.cast(builder, args[c], sig.args[c], types.float32), _place_of(c)
            )
        parts = [
            builder.shuffle_vector(colors, colors, ir.Constant(_INTS, [(16 * q + i) % 3 for i in range(LANES)]))
            for q in range(3)
        ]
        return context.make_tuple(builder, _TRIPLE, parts)

    return _TRIPLE(red, green, blue), emit


@intrinsic
def triple_sums(typing, x, y, z):
    """Of 48 lanes x y z, the sums of each three in a row."""

    def emit(context, builder, sig, args):
        value = None
        for offset in range(3):
            wanted = [3 * lane + offset for lane in range(LANES)]
            low = builder.shuffle_vector(args[0], args[1], ir.Constant(_INTS, [min(w, 31) for w in wanted]))
            mixed = [lane if w < 32 else LANES + w - 32 for lane, w in enumerate(wanted)]
            part = builder.shuffle_vector(low, args[2], ir.Constant(_INTS, mixed))
            value = part if value is None else builder.fadd(value, part)
        return value

    return lanes(x, y, z), emit


@intrinsic
def take_ticket(typing, counter):
    """Add 1 to counter[0] (int64) atomically and return what it was."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), emit
