"""Answers for a RequestServer that are made at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from worker.daemon.pace import Pace
from worker.daemon.reply import Reply
from worker.daemon.scheduler import Scheduler
from worker.machine.parts import Parts


def at_once(answer: Callable[[Any], Reply], pace: Pace | None = None, **settings: Any) -> Scheduler:
    """A scheduler whose answers have one part each. settings: as of Scheduler."""

    def parts(request: Any, level: int) -> Parts[Reply]:
        del level
        return answer(request)
        yield

    return Scheduler(parts, pace or Pace(), **settings)
