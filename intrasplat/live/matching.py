"""Joins the frames of two streams by their times, never by their numbers."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Frame = TypeVar("Frame")

MAX_WAITING = 8
MAX_APART = 0.5
"""Of the step between two frames: frames farther apart show two moments."""
ASSUMED_STEP_S = 1 / 30


class Matcher(Generic[Frame]):
    """Frames of two streams, in; pairs of one moment, out. A frame without a partner is left out."""

    def __init__(self) -> None:
        self._waiting: tuple[deque[tuple[float, Frame]], ...] = (deque(), deque())
        self._step_s = ASSUMED_STEP_S
        self._last_s: float | None = None

    def add(self, stream: int, time_s: float, frame: Frame) -> tuple[float, Frame, Frame] | None:
        """The pair (time of the left frame, left, right) that a frame of stream 0 (left) or 1 completes, if any."""
        if stream == 0:
            if self._last_s is not None and 0 < time_s - self._last_s < 1:
                self._step_s += 0.1 * (time_s - self._last_s - self._step_s)
            self._last_s = time_s
        own, others = self._waiting[stream], self._waiting[1 - stream]
        while others and others[0][0] < time_s - MAX_APART * self._step_s:
            others.popleft()
        if not others or others[0][0] > time_s + MAX_APART * self._step_s:
            own.append((time_s, frame))
            if len(own) > MAX_WAITING:
                own.popleft()
            return None
        other_s, other = others.popleft()
        own.clear()  # older ones have no partner any more
        return (time_s, frame, other) if stream == 0 else (other_s, other, frame)

    @property
    def waiting(self) -> tuple[int, ...]:
        """Frames of each stream without a partner so far."""
        return tuple(len(each) for each in self._waiting)

    def clear(self) -> None:
        """Leave out all that wait."""
        for each in self._waiting:
            each.clear()
        self._last_s = None
