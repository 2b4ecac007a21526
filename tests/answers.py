"""Answers for a RequestServer that are made at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from intrasplat.machine.parts import Parts
from worker.pace import RenderPace
from worker.reply import Reply
from worker.scheduler import Scheduler


def at_once(answer: Callable[[Any], Reply], pace: RenderPace | None = None, **settings: Any) -> Scheduler:
    """A scheduler whose answers have one part each. settings: as of Scheduler."""

    def parts(request: Any, level: int) -> Parts[Reply]:
        del level
        return answer(request)
        yield

    return Scheduler(parts, pace or RenderPace(), **settings)
