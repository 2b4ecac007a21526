"""Callbacks by which a stage of a reconstruction reports progress and learns that it must stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from intrasplat.errors import Cancelled


@dataclass(frozen=True)
class Progress:
    """One report of progress. fraction is the finished part of the stage, in [0, 1].

    psnr_db and psnr_right_db are the last held-out psnr_tissue of the left and the right eye, if any. Some reports have
    the clip's number of frames, and the megapixels of all frames of one eye; else both are 0.
    """

    stage: str
    fraction: float
    iteration: int = 0
    iterations: int = 0
    psnr_db: float | None = None
    psnr_right_db: float | None = None
    seconds_left: float | None = None
    frames: int = 0
    megapixels: float = 0.0

    def __str__(self) -> str:
        """One readable line, such as `train 25 %, 31.2 dB, 42 s left`."""
        parts = [f"{self.stage} {self.fraction:.0%}"]
        if self.psnr_db is not None:
            parts.append(f"{self.psnr_db:.1f} dB")
        if self.seconds_left is not None:
            parts.append(f"{self.seconds_left:.0f} s left")
        return ", ".join(parts)


def ignore(*arguments: object) -> None:
    """A callback that does nothing."""
    del arguments


def never() -> bool:
    """A should_stop that is always False."""
    return False


def always(*arguments: object) -> bool:
    """A check that is always passed."""
    del arguments
    return True


@dataclass(frozen=True)
class Hooks:
    """The caller's callbacks. The first two are called between steps of the work (worker/hang.py has the longest step).

    on_first_moment gets a DepthClip of one frame (intrasplat/clip/types.py) as soon as the first training frame has
    depth. It is called at most once, by the thread that calls the stage.
    """

    on_progress: Callable[[Progress], None] = ignore
    should_stop: Callable[[], bool] = never
    on_first_moment: Callable[[Any], None] = ignore

    def report_stage(self, stage: str, fraction: float) -> None:
        """Report the finished fraction of a stage.

        Raises:
            Cancelled: the caller wants to stop.
        """
        self.on_progress(Progress(stage, fraction))
        if self.should_stop():
            raise Cancelled(f"Stopped during stage {stage!r}.")
