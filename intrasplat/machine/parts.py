"""Work in parts, so that its caller can do something else between two parts, or stop."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeAlias, TypeVar

T = TypeVar("T")

Parts: TypeAlias = Generator[None, None, T]
"""A generator that yields after each part of the work except the last, and returns the result. close() cancels it.

Several may be advanced in turn, each by one thread at a time."""


def whole(parts: Parts[T]) -> T:
    """The result, after running all parts now. Raises as the parts do."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            result: T = end.value
            return result
