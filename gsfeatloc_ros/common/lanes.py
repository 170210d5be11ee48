"""Sixteen float32 numbers side by side, as a type that numba kernels calculate with.

`Lanes` is LLVM's <16 x float>: one AVX-512 register, two of AVX2 or four of NEON, from one source. Arithmetic and
comparisons take `Lanes` or numbers on either side; a comparison gives a mask for `select`.
"""

from __future__ import annotations

import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import lower_builtin, models, register_model

from gsfeatloc_ros.common.kernels import intrinsic, njit

LANES = 16
# Lanes as a square of pixels.
SQUARE = 4

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_BYTES = ir.VectorType(ir.IntType(8), LANES)
_SHORTS = ir.VectorType(ir.IntType(16), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
# Where a float16's sign, exponent and fraction are in a float32; the exponents count from different numbers.
_HALF_BITS = 0x8FFFE000
_HALF_SCALE = 2.0**112
# Not "fast": NaN and infinity keep their meaning, and roundings are not optimised away.
_FLAGS = ("contract", "nsz", "arcp")


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__("Lanes")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__("Mask")


_LANES, _MASK = _LanesType(), _MaskType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, fe_type) -> None:
        super().__init__(manager, fe_type, _FLOATS)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, fe_type) -> None:
        super().__init__(manager, fe_type, _BITS)


def _broadcast(builder, number):
    """Write a vector with the same number in every lane."""
    undefined = ir.Constant(ir.VectorType(number.type, LANES), ir.Undefined)
    first = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_INTS, [0] * LANES))


def _define_operator(function, result, emit) -> None:
    """Let `function` of two Lanes, or of one and a number, give a `result` by what `emit(builder, a, b)` writes."""

    @infer_global(function)
    class _Operator(AbstractTemplate):
        def generic(self, args, kws):
            if len(args) == 2 and _LANES in args and all(a is _LANES or isinstance(a, types.Number) for a in args):
                return signature(result, *(a if a is _LANES else types.float32 for a in args))
            return None

    def lower(context, builder, sig, args):
        vectors = (v if t is _LANES else _broadcast(builder, v) for v, t in zip(args, sig.args, strict=True))
        return emit(builder, *vectors)

    for operands in ((_LANES, _LANES), (_LANES, types.float32), (types.float32, _LANES)):
        lower_builtin(function, *operands)(lower)


_define_operator(operator.add, _LANES, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_define_operator(operator.sub, _LANES, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_define_operator(operator.mul, _LANES, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_define_operator(operator.truediv, _LANES, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
_define_operator(operator.lt, _MASK, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_define_operator(operator.le, _MASK, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_define_operator(operator.gt, _MASK, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_define_operator(operator.ge, _MASK, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))


@infer_global(operator.and_)
class _And(AbstractTemplate):
    def generic(self, args, kws):
        return signature(_MASK, *args) if args == (_MASK, _MASK) else None


@lower_builtin(operator.and_, _MASK, _MASK)
def _lower_and(context, builder, sig, args):
    return builder.and_(*args)


@intrinsic
def broadcast(typingctx, number):
    """Return a number in every lane."""

    def codegen(context, builder, sig, args):
        return _broadcast(builder, args[0])

    return _LANES(types.float32), codegen


def _data(context, builder, array_type, array):
    """Point to the first element of an array."""
    return context.make_array(array_type)(context, builder, array).data


def _vector_at(builder, data, index, vector):
    """Point to the elements from an index on, as a vector."""
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """Return array[index : index + LANES] of a flat, contiguous float32 array; neither end is checked."""

    def codegen(context, builder, sig, args):
        data = _data(context, builder, sig.args[0], args[0])
        return builder.load(_vector_at(builder, data, args[1], _FLOATS), align=4)

    return _LANES(array, types.intp), codegen


@intrinsic
def load_bytes(typingctx, array, index):
    """Do as `load` with a uint8 array."""

    def codegen(context, builder, sig, args):
        data = _data(context, builder, sig.args[0], args[0])
        return builder.uitofp(builder.load(_vector_at(builder, data, args[1], _BYTES), align=1), _FLOATS)

    return _LANES(array, types.intp), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Let array[index] be brought into the CPU's cache meanwhile."""

    def codegen(context, builder, sig, args):
        pointer = builder.gep(_data(context, builder, sig.args[0], args[0]), [args[1]])
        integer = ir.IntType(32)
        function_type = ir.FunctionType(ir.VoidType(), [pointer.type, integer, integer, integer])
        function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0")
        # For reading, to be kept in all levels of the cache, data.
        builder.call(function, [pointer, *(ir.Constant(integer, value) for value in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
def load_halves(typingctx, array, index):
    """Do as `load` with a float16 array of finite numbers, given as the int16 view of it that numba knows.

    Move its bits to where a float32 has them, and multiply: not all CPUs have an instruction for it.
    """

    def codegen(context, builder, sig, args):
        data = _data(context, builder, sig.args[0], args[0])
        halves = builder.load(_vector_at(builder, data, args[1], _SHORTS), align=2)
        moved = builder.shl(builder.sext(halves, _INTS), ir.Constant(_INTS, [13] * LANES))
        bits = builder.and_(moved, ir.Constant(_INTS, [_HALF_BITS] * LANES))
        return builder.fmul(builder.bitcast(bits, _FLOATS), ir.Constant(_FLOATS, [_HALF_SCALE] * LANES), flags=_FLAGS)

    return _LANES(array, types.intp), codegen


@intrinsic
def offsets(typingctx, points, origin, axis):
    """Return how far points lie from an origin, and how far along an axis: (x, y, z, along), in float64 until rounded.

    Args:
        points: tuple of three Lanes.
        origin, axis: tuples of three float64.
    """
    three = types.UniTuple(types.float64, 3)

    def codegen(context, builder, sig, args):
        along, differences = ir.Constant(_DOUBLES, [0.0] * LANES), []
        for i in range(3):
            values, start, slope = (builder.extract_value(arg, i) for arg in args)
            difference = builder.fsub(builder.fpext(values, _DOUBLES), _broadcast(builder, start))
            product = builder.fmul(difference, _broadcast(builder, slope), flags=_FLAGS)
            along = builder.fadd(along, product, flags=_FLAGS)
            differences.append(difference)
        rounded = (builder.fptrunc(values, _FLOATS) for values in (*differences, along))
        return context.make_tuple(builder, sig.return_type, rounded)

    return types.UniTuple(_LANES, 4)(types.UniTuple(_LANES, 3), three, three), codegen


@intrinsic
def store(typingctx, array, index, values):
    """Do array[index : index + LANES] = values with a flat, contiguous float32 array; neither end is checked."""

    def codegen(context, builder, sig, args):
        data = _data(context, builder, sig.args[0], args[0])
        builder.store(args[2], _vector_at(builder, data, args[1], _FLOATS), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, _LANES), codegen


@intrinsic
def store_rows(typingctx, array, index, stride, rows):
    """Do `store` with each of a tuple of Lanes, `stride` elements further on each time."""

    def codegen(context, builder, sig, args):
        data, place = _data(context, builder, sig.args[0], args[0]), args[1]
        for row in range(sig.args[3].count):
            builder.store(builder.extract_value(args[3], row), _vector_at(builder, data, place, _FLOATS), align=4)
            place = builder.add(place, args[2])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, rows), codegen


@intrinsic
def store_columns(typingctx, array, index, mask, rows):
    """Store columns of a square matrix, those in the mask, one behind another from array[index] on.

    Of `array`, flat, contiguous and float32, LANES * LANES elements from there on may be overwritten.

    Args:
        rows: tuple of LANES Lanes, the matrix.

    Returns:
        the index after the last.
    """

    def codegen(context, builder, sig, args):
        array_type, _, _, _ = sig.args
        array, at, mask, rows = args
        data = _data(context, builder, array_type, array)
        for lane, column in enumerate(_transposed(builder, [builder.extract_value(rows, i) for i in range(LANES)])):
            # Each goes to where the next one then overwrites it unless it is in the mask.
            builder.store(column, _vector_at(builder, data, at, _FLOATS), align=4)
            step = builder.zext(builder.extract_element(mask, ir.Constant(ir.IntType(32), lane)), at.type)
            at = builder.add(at, builder.mul(step, ir.Constant(at.type, LANES)))
        return at

    return types.intp(array, types.intp, _MASK, types.UniTuple(_LANES, LANES)), codegen


def _transposed(builder, rows: list) -> list:
    """Return the columns of a square matrix: exchange the blocks off its diagonal, of half the size each time."""
    for size in (8, 4, 2, 1):
        from_a = [lane if not lane & size else LANES + lane - size for lane in range(LANES)]
        from_b = [lane + size if not lane & size else LANES + lane for lane in range(LANES)]
        for i in (i for i in range(LANES) if not i & size):
            a, b = rows[i], rows[i + size]
            rows[i] = builder.shuffle_vector(a, b, ir.Constant(_INTS, from_a))
            rows[i + size] = builder.shuffle_vector(a, b, ir.Constant(_INTS, from_b))
    return rows


@intrinsic
def load_columns(typingctx, array, starts, first):
    """Return a tuple of LANES Lanes: i holds array[start + i] for each start in starts[first : first + LANES].

    Both are flat and contiguous, `array` is float32 and `starts` int64; no end is checked.
    """

    def codegen(context, builder, sig, args):
        array_type, starts_type, _ = sig.args
        data, places = _data(context, builder, array_type, args[0]), _data(context, builder, starts_type, args[1])
        rows = []
        for lane in range(LANES):
            place = builder.gep(places, [builder.add(args[2], ir.Constant(args[2].type, lane))])
            rows.append(builder.load(_vector_at(builder, data, builder.load(place), _FLOATS), align=4))
        return context.make_tuple(builder, sig.return_type, _transposed(builder, rows))

    return types.UniTuple(_LANES, LANES)(array, starts, types.intp), codegen


@intrinsic
def store_square(typingctx, picture, place, stride, channels):
    """Write a square of SQUARE x SQUARE pixels into a picture, row by row; no end is checked.

    Args:
        picture: contiguous float32, the channels of a pixel beside each other.
        place: index of the first channel of the square's first pixel.
        stride: from a row of the picture to the next.
        channels: tuple of Lanes, the pixels' values of each channel.
    """

    def codegen(context, builder, sig, args):
        data = _data(context, builder, sig.args[0], args[0])
        values = [builder.extract_value(args[3], channel) for channel in range(sig.args[3].count)]
        place = args[1]
        for row in range(SQUARE):
            pixels = _interleaved(builder, values, row)
            builder.store(pixels, _vector_at(builder, data, place, pixels.type), align=4)
            place = builder.add(place, args[2])
        return context.get_dummy_value()

    return types.void(picture, types.intp, types.intp, channels), codegen


def _interleaved(builder, channels: list, row: int):
    """Return a row of a square, a pixel's channels beside each other, as one vector."""
    count = len(channels)
    size = SQUARE * count
    mask_type = ir.VectorType(ir.IntType(32), size)
    pixels = None
    for channel, values in enumerate(channels):
        spread = ir.Constant(mask_type, [SQUARE * row + place // count for place in range(size)])
        own = builder.shuffle_vector(values, values, spread)
        taken = ir.Constant(mask_type, [place + size * (place % count == channel) for place in range(size)])
        pixels = own if pixels is None else builder.shuffle_vector(pixels, own, taken)
    return pixels


@intrinsic
def select(typingctx, mask, a, b):
    """Return `a` in the lanes of the mask, `b` in the others; either may be a number."""

    def codegen(context, builder, sig, args):
        a, b = (v if t is _LANES else _broadcast(builder, v) for v, t in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], a, b)

    return _LANES(_MASK, *(t if t is _LANES else types.float32 for t in (a, b))), codegen


@intrinsic
def whole(typingctx, values):
    """Return whole numbers as int32, reinterpreted as float32."""

    def codegen(context, builder, sig, args):
        return builder.bitcast(builder.fptosi(args[0], _INTS), _FLOATS)

    return _LANES(_LANES), codegen


@intrinsic
def total(typingctx, values):
    """Return the sum of all lanes, in whatever order is fastest."""

    def codegen(context, builder, sig, args):
        function_type = ir.FunctionType(ir.FloatType(), [ir.FloatType(), _FLOATS])
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        function = cgutils.get_or_insert_function(builder.module, function_type, name)
        return builder.call(function, [ir.Constant(ir.FloatType(), 0.0), args[0]], fastmath=("reassoc",))

    return types.float32(_LANES), codegen


@intrinsic
def mask_bits(typingctx, mask):
    """Return the mask as a number, of which bit i is lane i."""

    def codegen(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(32))

    return types.uint32(_MASK), codegen


@intrinsic
def mask_from_bits(typingctx, bits):
    """Return the mask whose lane i is bit i of a number."""

    def codegen(context, builder, sig, args):
        return builder.bitcast(builder.trunc(args[0], ir.IntType(LANES)), _BITS)

    return _MASK(types.uint32), codegen


@intrinsic
def lowest_bit(typingctx, bits):
    """Return the position of the lowest bit that is set; some is."""

    def codegen(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return bits(bits), codegen


@intrinsic
def bits_of_float(typingctx, value):
    """Reinterpret a float32 as a uint32."""

    def codegen(context, builder, sig, args):
        return builder.bitcast(args[0], ir.IntType(32))

    return types.uint32(types.float32), codegen


def _unary(name: str):
    """Make one of LLVM's functions of a float, lane by lane."""

    def typer(typingctx, values):
        def codegen(context, builder, sig, args):
            function_type = ir.FunctionType(_FLOATS, [_FLOATS])
            function = cgutils.get_or_insert_function(builder.module, function_type, f"{name}.v{LANES}f32")
            return builder.call(function, args)

        return _LANES(_LANES), codegen

    return intrinsic(typer)


sqrt, floor, log2, absolute = (_unary(f"llvm.{name}") for name in ("sqrt", "floor", "log2", "fabs"))


@intrinsic
def minus_product(typingctx, a, b, c):
    """Return a - b c, in one instruction where there is one for it, although b c is needed elsewhere too."""

    def codegen(context, builder, sig, args):
        a, b, c = args
        function_type = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
        function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.fmuladd.v{LANES}f32")
        return builder.call(function, [builder.fneg(b), c, a])

    return _LANES(_LANES, _LANES, _LANES), codegen


@njit
def minimum(a, b):
    """Return the smaller in each lane; b where either is NaN."""
    return select(a < b, a, b)


@njit
def maximum(a, b):
    """Return the larger in each lane; b where either is NaN."""
    return select(a > b, a, b)


@intrinsic
def _times_power_of_two(typingctx, values, shifted):
    """Return values 2^n, where `shifted` is _TO_WHOLE + n, n from -126 to 127."""

    def codegen(context, builder, sig, args):
        # The lowest bits of `shifted` are n; all others are shifted out.
        exponent = builder.shl(builder.bitcast(args[1], _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(args[0], _INTS), exponent), _FLOATS)

    return _LANES(_LANES, _LANES), codegen


# Added to a number up to 2^22, what comes out has no bits left for less than 1: that rounds it.
_TO_WHOLE = np.float32(1.5 * 2**23)
# 2^f on [-0.5, 0.5]: minimax polynomial of degree 4, relative error 2.6e-6.
_P0, _P1, _P2 = (np.float32(0.99999928), np.float32(0.69312179), np.float32(0.24024744))
_P3, _P4 = np.float32(0.055917859), np.float32(0.0095701021)


@njit
def exp2(x):
    """Return 2^x to a relative 3e-6, for x from -126 to 127; anything for others."""
    shifted = x + _TO_WHOLE
    f = x - (shifted - _TO_WHOLE)
    return _times_power_of_two(_P0 + f * (_P1 + f * (_P2 + f * (_P3 + f * _P4))), shifted)
