"""Triton's interpreter of kernels without the work that it repeats: several times as fast, with the same result.

It checks as much as before, overflow of integers included. lab/gpu/ and the tests ask for it.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

SetAttribute = Callable[[Any, str, Any], None]
"""setattr, or one that is taken back at some time."""


def hasten(set_attribute: SetAttribute) -> None:
    """Replaces functions of the interpreter; Triton must be installed."""
    interpreter = importlib.import_module("triton.runtime.interpreter")
    semantic = interpreter.interpreter_semantic
    set_attribute(interpreter, "_patch_builtin", _patch_builtin_of(interpreter))
    set_attribute(interpreter, "_patch_lang", _patch_lang_of(interpreter))
    set_attribute(interpreter, "_get_np_dtype", _get_np_dtype_of(interpreter))
    set_attribute(semantic, "binary_op_sanitize_overflow_impl", _overflow_check_of(semantic))
    set_attribute(semantic, "broadcast_impl_value", _broadcast_of(semantic))
    set_attribute(interpreter.tl.tensor, "__init__", _init_of_tensor(interpreter.tl.tensor))
    block = interpreter.tl.core.block_type
    set_attribute(block, "with_element_ty", _with_element_of(block))
    set_attribute(interpreter.interpreter_builder, "get_block_ty", _block_type_of(interpreter.interpreter_builder))


def _patch_builtin_of(interpreter: Any) -> Callable[[Any, Any, Any], None]:
    """All of a package was searched for what has to be replaced; which names these are does not change."""
    is_builtin = interpreter.tl.core.is_builtin

    @cache
    def names(package: Any) -> list[str]:
        return [name for name, member in inspect.getmembers(package) if is_builtin(member)]

    def patch(package: Any, builder: Any, scope: Any) -> None:
        for name in names(package):
            member = getattr(package, name)
            if is_builtin(member):
                interpreter._patch_attr(package, name, member, builder, scope)

    return patch


def _patch_lang_of(interpreter: Any) -> Callable[[Any], Any]:
    """At every call of a device function everything was replaced that its kernel's launch had replaced before."""
    language, patch, is_builtin = interpreter.tl, interpreter._patch_lang, interpreter.tl.core.is_builtin
    nothing_to_restore = SimpleNamespace(restore=lambda: None)

    @cache
    def languages(function: Any) -> list[Any]:
        return [each for each in function.__globals__.values() if each is language or each is language.core]

    def patch_once(function: Any) -> Any:
        found = languages(function)
        if any(is_builtin(each.load) or is_builtin(each.tensor.__add__) for each in found):
            return patch(function)
        return nothing_to_restore

    return patch_once


def _get_np_dtype_of(interpreter: Any) -> Callable[[Any], Any]:
    """A table of all types was built for each look into it."""
    pointer, looked_up = interpreter.tl.pointer_type, interpreter._get_np_dtype
    of_scalar = cache(looked_up)

    def remembered(kind: Any) -> Any:
        return looked_up(kind) if isinstance(kind.scalar, pointer) else of_scalar(kind.scalar)

    return remembered


def _overflow_check_of(semantic: Any) -> Callable[[Any, Any, Callable[..., Any]], None]:
    """Seven operations of the interpreter on int64 were made for each on fewer bits."""
    operations = {"add": np.add, "sub": np.subtract, "mul": np.multiply}

    def check(one: Any, other: Any, operation: Callable[..., Any]) -> None:
        kind = one.type.scalar
        if kind.int_bitwidth >= 64 or not semantic.builder.options.sanitize_overflow:
            return
        name = operation.__name__
        exact = operations[name](one.handle.data, other.handle.data, dtype=np.int64)
        inside = exact.min() >= kind.get_int_min_value() and exact.max() <= kind.get_int_max_value()
        assert inside, f"int{kind.int_bitwidth} overflow detected for operation {name}"

    return check


def _broadcast_of(semantic: Any) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Of two blocks of one shape it was computed which shape both have."""
    broadcast = semantic.broadcast_impl_value

    def only_where_shapes_differ(one: Any, other: Any) -> tuple[Any, Any]:
        if one.type.is_block() and other.type.is_block() and one.handle.data.shape == other.handle.data.shape:
            return one, other
        both: tuple[Any, Any] = broadcast(one, other)
        return both

    return only_where_shapes_differ


def _init_of_tensor(tensor: Any) -> Callable[[Any, Any, Any], None]:
    """For every tensor its type's shape was made of constants anew."""
    init = tensor.__init__

    def remembering(self: Any, handle: Any, kind: Any) -> None:
        if "_tensor" not in vars(kind):
            init(self, handle, kind)
            kind._tensor = self.shape, self.numel
            return
        self.handle, self.type, self.dtype = handle, kind, kind.scalar
        self.shape, self.numel = kind._tensor

    return remembering


def _with_element_of(block: Any) -> Callable[[Any, Any], Any]:
    """The type of a block of other numbers was made for every operation."""
    make = block.with_element_ty

    def remembered(self: Any, element: Any) -> Any:
        made = vars(self).setdefault("_with", {})
        if id(element) not in made:
            made[id(element)] = element, make(self, element)  # the element lives on, so its id is its own
        return made[id(element)][1]

    return remembered


def _block_type_of(builder: Any) -> Callable[[Any, Any], Any]:
    """The same, where the interpreter asks for it."""
    make, made = builder.get_block_ty, dict[tuple[int, tuple[int, ...]], Any]()

    def remembered(element: Any, shape: Any) -> Any:
        key = id(element), tuple(getattr(each, "value", each) for each in shape)
        if key not in made:
            made[key] = element, make(element, shape)
        return made[key][1]

    return remembered
