"""Which frame is shown now: the clip plays in real time, in a loop, or is paused.

Symbols: T frames.
"""

from __future__ import annotations

import bisect
import time
from collections.abc import Sequence

ONLY_FRAME_S = 0.1
"""How long a clip of one frame lasts."""


class Playback:
    """The shown moment. times_s: times of the T frames since the first. t: pause at this model time; None: play."""

    def __init__(self, times_s: Sequence[float], t: float | None = None) -> None:
        self.times_s = tuple(times_s)
        self.frame_count = len(self.times_s)
        self._paused_frame: int | None = None
        self._begin_s = time.monotonic()
        if t is not None:
            self.stand_at(t)

    @property
    def plays(self) -> bool:
        """Whether the clip plays."""
        return self._paused_frame is None and self.frame_count > 1

    @property
    def duration_s(self) -> float:
        """The duration of the clip, including its last frame."""
        if self.frame_count == 1:
            return ONLY_FRAME_S
        return self.times_s[-1] * self.frame_count / (self.frame_count - 1)

    @property
    def frame(self) -> int:
        """The frame that is shown now."""
        return self.frame_after(time.monotonic() - self._begin_s) if self._paused_frame is None else self._paused_frame

    def frame_after(self, seconds: float) -> int:
        """The frame that is shown `seconds` after the clip has started to play."""
        return max(0, bisect.bisect_right(self.times_s, seconds % self.duration_s) - 1)

    def t_of(self, frame: int) -> float:
        """Model time of a frame."""
        return frame / self.frame_count

    def pause(self) -> None:
        """Pause at the shown frame."""
        self._paused_frame = self.frame

    def play(self) -> None:
        """Play from the shown frame."""
        self._begin_s = time.monotonic() - self.times_s[self.frame]
        self._paused_frame = None

    def stand_at(self, t: float) -> None:
        """Pause at the frame nearest to a model time."""
        self._paused_frame = min(max(round(t * self.frame_count), 0), self.frame_count - 1)

    def note_on(self, t: float) -> str:
        """A remark on a requested model time; empty if it lies within the clip."""
        if 0 <= t <= 1:
            return ""
        return (
            f"t={t:g} is outside the clip, which lasts from 0 to 1: its {'first' if t < 0 else 'last'} frame is shown."
        )
