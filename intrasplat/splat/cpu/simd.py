"""Operations on explicit vectors (vectors.py), for kernels:

    a + b, a - b, a * b, a / b  of equal types, or one of them a plain number
    load(row, i)                LANES floats from row[i:]              load_bytes(row, i)   uint8 as floats
    store(row, i, v)            v into row[i:]                         spread(row, i)       row[i] in every lane
    load_strided(row, i, step)  row[i], row[i + step], ...             store_strided(row, i, step, v)
    splat(x)                    x in every lane                        iota()               0, 1, 2, ...
    widen(v), narrow(w)         between vector and wide
    fma(a, b, c)                a * b + c                              sqrt(x), floor(x), ceil(x)
    exp2(x)                     2**x, |relative error| < 2.2e-7 for -120 <= x <= 126; 2**-120 below, noise above
    log2(x)                     base-2 logarithm of a wide, |error| < 1e-9
    minimum(a, b), maximum(a, b), where_less(a, b, x, y) = x where a < b, else y;  all_less(a, b) whether in every lane
    lane_sum(v), lane_max(v)    over the lanes, always in the same order
    add_sums(row, i, a, b, c, d)     the four lane sums added to row[i : i + 4]
    claim(counter)              counter[0]++, for threads that share work

Arrays are 1-D, C-contiguous and of float32 (load_bytes: uint8; claim: int64). Compiling a kernel with any other fails,
because the address arithmetic would read other memory. So would a negative index, which is not checked.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from intrasplat.splat.cpu.vectors import LANES, VectorType, in_every_lane, vector, wide

_FLOAT, _INT32 = ir.FloatType(), ir.IntType(32)
_INTS = ir.VectorType(_INT32, LANES)

# Minimax coefficients of 2**f on [-0.5, 0.5], degree 5, lowest order first.
_EXP2 = (1.000000071655, 0.693146967064, 0.240221197239, 0.055507132750, 0.009675541331, 0.001327647152)
# log2(m) = 2 / ln 2 (s + s^3 / 3 + s^5 / 5 + ...), s = (m - 1) / (m + 1), |s| < 0.172 for m in [sqrt(1/2), sqrt(2)].
_LOG2 = tuple(2.0 / (0.6931471805599453 * k) for k in (1, 3, 5, 7, 9, 11))


def _constant(kind: VectorType, value: float) -> ir.Constant:
    return ir.Constant(kind.llvm, [ir.Constant(kind.element, value)] * LANES)


def _whole(value: int) -> ir.Constant:
    return ir.Constant(_INTS, [ir.Constant(_INT32, value)] * LANES)


def _call(builder: Any, kind: VectorType, name: str, *args: Any) -> Any:
    """An LLVM intrinsic on vectors, with the suffix of the vector type, which llvmlite cannot derive."""
    function = ir.FunctionType(kind.llvm, [kind.llvm] * len(args))
    return builder.call(builder.module.declare_intrinsic(f"llvm.{name}.{kind.suffix}", fnty=function), args)


def _check_dense(array: Any, element: Any = types.float32) -> None:
    """Refuse a strided array: addresses are computed from the first element, so it would be read at wrong places."""
    if not isinstance(array, types.Array) or (array.ndim, array.layout, array.dtype) != (1, "C", element):
        raise TypingError(f"vectors read and write 1-D C-contiguous arrays of {element}, not {array}")


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def _shuffled(builder: Any, left: Any, right: Any, lanes: list[int]) -> Any:
    """These lanes of left (0 ...) and right (LANES ...)."""
    order = ir.Constant(ir.VectorType(_INT32, len(lanes)), [ir.Constant(_INT32, lane) for lane in lanes])
    return builder.shuffle_vector(left, right, order)


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """LANES consecutive float32 from array[index]."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], args[0], args[1])
        loaded = builder.load(builder.bitcast(address, vector.llvm.as_pointer()))
        loaded.align = 4
        return loaded

    return vector(array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write LANES consecutive float32 at array[index]."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], builder.bitcast(address, vector.llvm.as_pointer())).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def load_strided(typing: Any, array: Any, index: Any, step: Any) -> Any:
    """array[index], array[index + step], ... for LANES of them."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, at = ir.Constant(vector.llvm, ir.Undefined), args[1]
        for lane in range(LANES):
            number = builder.load(_address(context, builder, signature.args[0], args[0], at))
            value = builder.insert_element(value, number, ir.Constant(_INT32, lane))
            at = builder.add(at, args[2])
        return value

    return vector(array, types.intp, types.intp), generate


@intrinsic
def store_strided(typing: Any, array: Any, index: Any, step: Any, value: Any) -> Any:
    """The lanes into array[index], array[index + step], ..."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = args[1]
        for lane in range(LANES):
            number = builder.extract_element(args[3], ir.Constant(_INT32, lane))
            builder.store(number, _address(context, builder, signature.args[0], args[0], at))
            at = builder.add(at, args[2])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, vector), generate


@intrinsic
def load_bytes(typing: Any, array: Any, index: Any) -> Any:
    """LANES consecutive uint8, as floats 0..255."""
    _check_dense(array, types.uint8)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        small = ir.VectorType(ir.IntType(8), LANES)
        address = _address(context, builder, signature.args[0], args[0], args[1])
        loaded = builder.load(builder.bitcast(address, small.as_pointer()))
        loaded.align = 1
        return builder.uitofp(loaded, vector.llvm)

    return vector(array, types.intp), generate


@intrinsic
def spread(typing: Any, array: Any, index: Any) -> Any:
    """array[index] in every lane."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = builder.load(_address(context, builder, signature.args[0], args[0], args[1]))
        return in_every_lane(builder, vector, number)

    return vector(array, types.intp), generate


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """The same float in every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return in_every_lane(builder, vector, args[0])

    return vector(types.float32), generate


@intrinsic
def iota(typing: Any) -> Any:
    """0, 1, 2, ... in the lanes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(vector.llvm, [ir.Constant(_FLOAT, float(i)) for i in range(LANES)])

    return vector(), generate


@intrinsic
def widen(typing: Any, value: Any) -> Any:
    """The lanes as float64."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fpext(args[0], wide.llvm)

    return wide(vector), generate


@intrinsic
def narrow(typing: Any, value: Any) -> Any:
    """The lanes rounded to float32."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fptrunc(args[0], vector.llvm)

    return vector(wide), generate


@intrinsic
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, vector, "fma", *args)

    return vector(vector, vector, vector), generate


@intrinsic
def sqrt(typing: Any, x: Any) -> Any:
    """Square root of every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, x, "sqrt", args[0])

    return x(x), generate


@intrinsic
def floor(typing: Any, x: Any) -> Any:
    """The largest whole number not above x."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, x, "floor", args[0])

    return x(x), generate


@intrinsic
def ceil(typing: Any, x: Any) -> Any:
    """The smallest whole number not below x."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, x, "ceil", args[0])

    return x(x), generate


@intrinsic
def minimum(typing: Any, a: Any, b: Any) -> Any:
    """The smaller of a and b, lane by lane (no NaN expected)."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[0], args[1])

    return a(a, a), generate


@intrinsic
def maximum(typing: Any, a: Any, b: Any) -> Any:
    """The larger of a and b, lane by lane (no NaN expected)."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[0], args[1])

    return a(a, a), generate


@intrinsic
def where_less(typing: Any, a: Any, b: Any, x: Any, y: Any) -> Any:
    """x in the lanes where a < b, y elsewhere."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return x(a, a, x, x), generate


@intrinsic
def all_less(typing: Any, a: Any, b: Any) -> Any:
    """Whether a < b in every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = ir.IntType(LANES)
        bits = builder.bitcast(builder.fcmp_ordered("<", args[0], args[1]), lanes)
        return builder.icmp_unsigned("==", bits, ir.Constant(lanes, 2**LANES - 1))

    return types.boolean(vector, vector), generate


@intrinsic
def exp2(typing: Any, x: Any) -> Any:
    """2**x: round, degree-5 polynomial on the remainder, exponent added as an integer.

    x is raised to at least -120: below, the integer would wrap round. Above 127.5 it does wrap; no caller gets there.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        floor = _constant(vector, -120.0)
        clamped = builder.select(builder.fcmp_ordered("<", args[0], floor), floor, args[0])
        whole = _call(builder, vector, "rint", clamped)
        rest = builder.fsub(clamped, whole)
        power = _constant(vector, _EXP2[5])
        for coefficient in reversed(_EXP2[:5]):
            power = _call(builder, vector, "fma", power, rest, _constant(vector, coefficient))
        exponent = builder.shl(builder.fptosi(whole, _INTS), _whole(23))
        return builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), vector.llvm)

    return vector(vector), generate


@intrinsic
def log2(typing: Any, x: Any) -> Any:
    """log2 of positive normal numbers: the exponent, and a series in (m - 1) / (m + 1) for the mantissa m."""
    bits = ir.VectorType(ir.IntType(64), LANES)

    def whole(value: int) -> ir.Constant:
        return ir.Constant(bits, [ir.Constant(ir.IntType(64), value)] * LANES)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        half_root = 0x3FE6A09E667F3BCD  # the bits of sqrt(1/2): mantissas are taken from there to sqrt(2)
        shifted = builder.sub(builder.bitcast(args[0], bits), whole(half_root))
        exponent = builder.ashr(shifted, whole(52))
        mantissa = builder.bitcast(
            builder.add(builder.and_(shifted, whole((1 << 52) - 1)), whole(half_root)), wide.llvm
        )
        one = _constant(wide, 1.0)
        s = builder.fdiv(builder.fsub(mantissa, one), builder.fadd(mantissa, one))
        square = builder.fmul(s, s)
        series = _constant(wide, _LOG2[-1])
        for coefficient in reversed(_LOG2[:-1]):
            series = _call(builder, wide, "fma", series, square, _constant(wide, coefficient))
        return _call(builder, wide, "fma", series, s, builder.sitofp(exponent, wide.llvm))

    return wide(wide), generate


@intrinsic
def lane_sum(typing: Any, value: Any) -> Any:
    """Sum over lanes by halves: the same order on every processor."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, width = args[0], LANES
        while width > 1:
            width //= 2
            total = builder.fadd(total, _shuffled(builder, total, total, [(i + width) % LANES for i in range(LANES)]))
        return builder.extract_element(total, ir.Constant(_INT32, 0))

    return (types.float32 if value is vector else types.float64)(value), generate


@intrinsic
def lane_max(typing: Any, value: Any) -> Any:
    """The largest lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        largest, width = args[0], LANES
        while width > 1:
            width //= 2
            moved = _shuffled(builder, largest, largest, [(i + width) % LANES for i in range(LANES)])
            largest = builder.select(builder.fcmp_ordered(">", largest, moved), largest, moved)
        return builder.extract_element(largest, ir.Constant(_INT32, 0))

    return types.float32(vector), generate


@intrinsic
def add_sums(typing: Any, array: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Add the lane sums of a, b, c, d to array[index : index + 4]; a third of the instructions of four lane_sum."""
    _check_dense(array)

    def paired(builder: Any, left: Any, right: Any) -> Any:
        """In each four lanes: two sums of neighbours of left, two of right."""
        even = [group + i for group in range(0, LANES, 4) for i in (0, 2, LANES, LANES + 2)]
        odd = [i + 1 for i in even]
        return builder.fadd(_shuffled(builder, left, right, even), _shuffled(builder, left, right, odd))

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, width = paired(builder, paired(builder, *args[2:4]), paired(builder, *args[4:6])), LANES
        while width > 4:
            width //= 2
            low, high = (_shuffled(builder, total, total, list(range(at, at + width))) for at in (0, width))
            total = builder.fadd(low, high)
        address = _address(context, builder, signature.args[0], args[0], args[1])
        place = builder.bitcast(address, ir.VectorType(_FLOAT, 4).as_pointer())
        before = builder.load(place)
        before.align = 4
        builder.store(builder.fadd(before, total), place).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, vector, vector, vector, vector), generate


@intrinsic
def claim(typing: Any, counter: Any) -> Any:
    """counter[0], which is then incremented atomically: no two threads get the same number."""
    _check_dense(counter, types.int64)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), generate
