"""Work that is done in parts, so that whoever does it may do something else between two of them, or stop."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeAlias, TypeVar

T = TypeVar("T")

Parts: TypeAlias = Generator[None, None, T]
"""A generator that yields after each part of the work but the last, and returns the result. close() abandons the work.

Several may be advanced in turn, each by one thread at a time."""


def whole(parts: Parts[T]) -> T:
    """The result, with all parts done now. Raises whatever a part raises."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            result: T = end.value
            return result
