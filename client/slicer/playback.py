"""Which frame is shown now: the clip plays in real seconds and begins again, or stands."""

from __future__ import annotations

import time

from client.slicer.clip import Clip


class Playback:
    """The moment that is shown; it plays unless a model time t is given."""

    def __init__(self, clip: Clip, t: float | None = None) -> None:
        self._clip = clip
        self._standing: int | None = None if t is None else clip.frame_at_t(t)
        self._begin_s = time.monotonic()

    @property
    def plays(self) -> bool:
        """Whether time goes on."""
        return self._standing is None and self._clip.frame_count > 1

    @property
    def frame(self) -> int:
        """The frame that is shown now."""
        if self._standing is not None:
            return self._standing
        return self._clip.frame_at(time.monotonic() - self._begin_s)

    def pause(self) -> None:
        """Stay at the frame that is shown."""
        self._standing = self.frame

    def play(self) -> None:
        """Go on from the frame that is shown."""
        self._begin_s = time.monotonic() - self._clip.times_s[self.frame]
        self._standing = None

    def stand_at(self, t: float) -> None:
        """Show the frame nearest to a model time and stay there."""
        self._standing = self._clip.frame_at_t(t)
