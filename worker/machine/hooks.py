"""What a running reconstruction tells its caller, and how the caller stops it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


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


def _show_nobody(scene: Any, iteration: int) -> None:
    del scene, iteration


def _judge_no_further(frame: int, view: Any) -> None:
    del frame, view


@dataclass(frozen=True)
class Hooks:
    """on_progress is called at least once a second while work goes on; should_stop is asked between steps.

    wants_snapshot is asked between steps of training; if it says so, on_snapshot is given the model as it is then, a
    Scene of worker/scene/checkpoint.py, and how many iterations made it. on_held_out is given each held-out frame
    that is rendered to be scored while training goes on: its number and the View of worker/train/looking.py;
    training's clock stands still meanwhile. None of these changes what training comes to.
    """

    on_progress: Callable[[Progress], None] = _ignore
    should_stop: Callable[[], bool] = _never
    wants_snapshot: Callable[[], bool] = _never
    on_snapshot: Callable[[Any, int], None] = _show_nobody
    on_held_out: Callable[[int, Any], None] = _judge_no_further
