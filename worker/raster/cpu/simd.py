"""Explicit float vectors for Numba kernels: LANES pixels of one row, in one register.

Numba's automatic vectoriser gives up on the blend loop (too many arrays to prove disjoint) and keeps the per-Gaussian
sums in memory. A vector type of its own removes both: what is written here as ``a * b + c`` on vectors is one
instruction on LANES pixels, on any processor LLVM knows (AVX2 and AVX-512 on x86, two NEON registers on Arm).

    v = load(plane, i)          LANES floats from plane[i:]
    store(plane, i, v)
    splat(x)                    x in every lane
    fma(a, b, c)                a * b + c
    exp2(x)                     2**x, |relative error| < 2e-7 for -126 <= x <= 0
    where_less(a, b, x, y)      x where a < b, else y
    lane_sum(v)                 the sum over lanes, always in the same order
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.errors import TypingError
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 8
"""Pixels a vector holds. Eight beats sixteen on Zen 4: a tile strip this narrow wastes fewer pixels beside a splat."""

_FLOAT = ir.FloatType()
_INT32 = ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT32, LANES)

# Minimax coefficients of 2**f on [-0.5, 0.5], degree 5, lowest order first.
_EXP2 = (1.000000071655, 0.693146967064, 0.240221197239, 0.055507132750, 0.009675541331, 0.001327647152)


class VectorType(types.Type):
    """The Numba type of LANES float32."""

    def __init__(self) -> None:
        super().__init__(name=f"f32x{LANES}")


vector = VectorType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _VECTOR)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, value)] * LANES)


def _call(builder: Any, name: str, *args: Any) -> Any:
    """An LLVM intrinsic on vectors; llvmlite cannot derive the suffix of a vector type, so it is spelt out."""
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
    return builder.call(builder.module.declare_intrinsic(f"llvm.{name}.v{LANES}f32", fnty=kind), args)


def _check_dense(array: Any) -> None:
    """Addresses are computed from the first element alone: a strided array would be read at the wrong place."""
    if not isinstance(array, types.Array) or array.ndim != 1 or array.layout != "C":
        raise TypingError(f"a vector is loaded from and stored to 1-D C-contiguous arrays, not {array}")


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """LANES consecutive float32 of a 1-D C-contiguous array, from array[index]."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        loaded = builder.load(_pointer(context, builder, signature.args[0], args[0], args[1]))
        loaded.align = 4
        return loaded

    return vector(array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write LANES consecutive float32 into a 1-D C-contiguous array at array[index]."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        stored = builder.store(args[2], _pointer(context, builder, signature.args[0], args[0], args[1]))
        stored.align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def load_bytes(typing: Any, array: Any, index: Any) -> Any:
    """LANES consecutive uint8 of a 1-D C-contiguous array, as floats 0..255."""
    _check_dense(array)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        small = ir.VectorType(ir.IntType(8), LANES)
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        loaded = builder.load(builder.bitcast(builder.gep(data, [args[1]]), small.as_pointer()))
        loaded.align = 1
        return builder.uitofp(loaded, _VECTOR)

    return vector(array, types.intp), generate


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """The same float in every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        single = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), args[0], ir.Constant(_INT32, 0))
        lanes = ir.Constant(_INTS, [ir.Constant(_INT32, 0)] * LANES)
        return builder.shuffle_vector(single, ir.Constant(_VECTOR, ir.Undefined), lanes)

    return vector(types.float32), generate


@intrinsic
def iota(typing: Any) -> Any:
    """0, 1, 2, ... in the lanes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, float(i)) for i in range(LANES)])

    return vector(), generate


@intrinsic
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, "fma", *args)

    return vector(vector, vector, vector), generate


@intrinsic
def minimum(typing: Any, a: Any, b: Any) -> Any:
    """The smaller of a and b, lane by lane (no NaN expected)."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[0], args[1])

    return vector(vector, vector), generate


@intrinsic
def where_less(typing: Any, a: Any, b: Any, x: Any, y: Any) -> Any:
    """x in the lanes where a < b, y elsewhere."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return vector(vector, vector, vector, vector), generate


@intrinsic
def exp2(typing: Any, x: Any) -> Any:
    """2**x: round, degree-5 polynomial on the remainder, exponent added as an integer. x is raised to at least -120."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        floor = _constant(-120.0)
        clamped = builder.select(builder.fcmp_ordered("<", args[0], floor), floor, args[0])
        whole = _call(builder, "rint", clamped)
        rest = builder.fsub(clamped, whole)
        power = _constant(_EXP2[5])
        for coefficient in reversed(_EXP2[:5]):
            power = _call(builder, "fma", power, rest, _constant(coefficient))
        exponent = builder.shl(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [ir.Constant(_INT32, 23)] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), _VECTOR)

    return vector(vector), generate


@intrinsic
def sqrt(typing: Any, x: Any) -> Any:
    """Square root of every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, "sqrt", args[0])

    return vector(vector), generate


@intrinsic
def lane_sum(typing: Any, value: Any) -> Any:
    """Sum over lanes by halves: the same order on every processor."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, width = args[0], LANES
        while width > 1:
            width //= 2
            order = [ir.Constant(_INT32, (i + width) % LANES) for i in range(LANES)]
            moved = builder.shuffle_vector(total, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTS, order))
            total = builder.fadd(total, moved)
        return builder.extract_element(total, ir.Constant(_INT32, 0))

    return types.float32(vector), generate


@intrinsic
def lane_max(typing: Any, value: Any) -> Any:
    """The largest lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        largest, width = args[0], LANES
        while width > 1:
            width //= 2
            order = [ir.Constant(_INT32, (i + width) % LANES) for i in range(LANES)]
            moved = builder.shuffle_vector(largest, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTS, order))
            largest = builder.select(builder.fcmp_ordered(">", largest, moved), largest, moved)
        return builder.extract_element(largest, ir.Constant(_INT32, 0))

    return types.float32(vector), generate


def _arithmetic(symbol: Callable[[Any, Any], Any], instruction: str) -> None:
    """Teach Numba one infix operator on two vectors."""

    @infer_global(symbol)
    class _Typing(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and all(isinstance(a, VectorType) for a in args):
                return signature(vector, vector, vector)
            return None

    @lower_builtin(symbol, VectorType, VectorType)
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")
