"""Vector types for Numba kernels: LANES pixels of one row, or LANES Gaussians, in one register.

Numba's automatic vectoriser fails on the blend loop, because it cannot prove so many arrays disjoint, and it keeps the
per-Gaussian sums in memory. With a type of our own, ``a * b + c`` on vectors compiles to vector instructions on LANES
numbers, on any processor that LLVM supports (AVX2 and AVX-512 on x86, NEON on Arm). simd.py has the other operations.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.imputils import lower_cast
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

LANES = 8
"""Numbers in a vector. Eight is faster than sixteen on Zen 4: a narrower tile has fewer pixels that a splat misses."""


class VectorType(types.Type):
    """The Numba type of LANES float32 or float64."""

    def __init__(self, element: Any, name: str) -> None:
        self.element, self.suffix = element, f"v{LANES}{name}"
        self.llvm = ir.VectorType(element, LANES)
        super().__init__(name=f"{name}x{LANES}")


vector = VectorType(ir.FloatType(), "f32")
wide = VectorType(ir.DoubleType(), "f64")


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, numba_type.llvm)


def in_every_lane(builder: Any, kind: VectorType, value: Any) -> Any:
    """LLVM code for a vector of one number."""
    index = ir.IntType(32)
    undefined = ir.Constant(kind.llvm, ir.Undefined)
    single = builder.insert_element(undefined, value, index(0))
    return builder.shuffle_vector(single, undefined, ir.Constant(ir.VectorType(index, LANES), [index(0)] * LANES))


@lower_cast(types.Float, VectorType)
def _splat_float(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    """A plain number where a vector is expected."""
    element = types.float32 if wanted is vector else types.float64
    return in_every_lane(builder, wanted, context.cast(builder, value, given, element))


@lower_cast(types.Integer, VectorType)
def _splat_integer(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    return _splat_float(context, builder, given, wanted, value)


def _arithmetic(symbol: Callable[[Any, Any], Any], instruction: str) -> None:
    """Teach Numba one infix operator on two equal vectors, or a vector and a number."""

    @infer_global(symbol)
    class _Typing(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            kinds = {a for a in args if isinstance(a, VectorType)}
            if len(args) != 2 or len(kinds) != 1:
                return None
            kind = kinds.pop()
            return signature(kind, kind, kind) if all(a is kind or isinstance(a, types.Number) for a in args) else None

    @lower_builtin(symbol, VectorType, VectorType)
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")
