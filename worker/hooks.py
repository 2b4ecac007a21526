"""What a running reconstruction tells its caller, and how the caller stops it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """One report of progress. fraction is of the stage, in [0, 1]; psnr_db is the last held-out psnr_tissue, if any."""

    stage: str
    fraction: float
    iteration: int = 0
    iterations: int = 0
    psnr_db: float | None = None
    seconds_left: float | None = None


def _ignore(progress: Progress) -> None:
    del progress


def _never() -> bool:
    return False


@dataclass(frozen=True)
class Hooks:
    """on_progress is called at least once a second while work goes on; should_stop is asked between steps."""

    on_progress: Callable[[Progress], None] = _ignore
    should_stop: Callable[[], bool] = _never
