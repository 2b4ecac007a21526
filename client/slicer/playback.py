"""Which frame is shown now: the clip plays in real seconds and begins again, or stands.

Symbols: T frames.
"""

from __future__ import annotations

import bisect
import time
from collections.abc import Sequence

ONLY_FRAME_S = 0.1
"""How long a clip of one frame lasts."""


class Playback:
    """The moment that is shown. times_s: of the T frames, from the first. t: stand at this model time; None: play."""

    def __init__(self, times_s: Sequence[float], t: float | None = None) -> None:
        self.times_s = tuple(times_s)
        self.frame_count = len(self.times_s)
        self._standing: int | None = None
        self._begin_s = time.monotonic()
        if t is not None:
            self.stand_at(t)

    @property
    def plays(self) -> bool:
        """Whether time goes on."""
        return self._standing is None and self.frame_count > 1

    @property
    def duration_s(self) -> float:
        """Of the clip, its last frame included."""
        if self.frame_count == 1:
            return ONLY_FRAME_S
        return self.times_s[-1] * self.frame_count / (self.frame_count - 1)

    @property
    def frame(self) -> int:
        """The frame that is shown now."""
        return self.frame_after(time.monotonic() - self._begin_s) if self._standing is None else self._standing

    def frame_after(self, seconds: float) -> int:
        """The frame that is shown so long after the clip has begun to play."""
        return max(0, bisect.bisect_right(self.times_s, seconds % self.duration_s) - 1)

    def t_of(self, frame: int) -> float:
        """Model time of a frame."""
        return frame / self.frame_count

    def pause(self) -> None:
        """Stay at the frame that is shown."""
        self._standing = self.frame

    def play(self) -> None:
        """Go on from the frame that is shown."""
        self._begin_s = time.monotonic() - self.times_s[self.frame]
        self._standing = None

    def stand_at(self, t: float) -> None:
        """Show the frame nearest to a model time and stay there."""
        self._standing = min(max(round(t * self.frame_count), 0), self.frame_count - 1)

    def note_on(self, t: float) -> str:
        """What to say of a model time that is asked for; empty where the clip has it."""
        if 0 <= t <= 1:
            return ""
        return (
            f"t={t:g} is outside the clip, which lasts from 0 to 1: its {'first' if t < 0 else 'last'} frame is shown."
        )
