"""Answers for a RequestServer that are made at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from worker.daemon.reply import Reply
from worker.daemon.scheduler import Answer
from worker.machine.parts import Parts


def at_once(answer: Callable[[Any], Reply]) -> Answer:
    """The answer in one part, at any level of detail."""

    def parts(request: Any, level: int) -> Parts[Reply]:
        del level
        return answer(request)
        yield

    return parts
