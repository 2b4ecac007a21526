"""The clock of a feed, over the time stamps of its packets: it never falls, and a jump begins another segment."""

from __future__ import annotations

from dataclasses import dataclass, replace

from intrasplat.live.reading import Arrived

MAX_STEP_S = 2.0
"""Time stamps that step by more than this beside the packets' arrival have jumped."""
MAX_FALL_S = 0.5
"""Several streams of one source interleave within this; decoding times of one stream never fall."""


@dataclass(frozen=True)
class Place:
    """Where a packet lies on the feed's clock: source time, s, is its time stamp, s, plus offset_s.

    epoch counts jumps of this connection.
    """

    offset_s: float
    epoch: int


ASSUMED_STEP_S = 1 / 30
WAITED_S = 0.1
"""A packet that is read sooner after the process is ready had come in before."""


class Waited:
    """Dates packets that came in while the process started: each some time after the connection, by its time stamp."""

    def __init__(self, connected_at: float | None, ready_at: float) -> None:
        """connected_at: None: nothing comes in before the process is ready. Times are UNIX times, s."""
        self._connected_at, self._ready_at = connected_at, ready_at
        self._first_s: float | None = None
        self._last_s = 0.0

    def dated(self, arrived: Arrived) -> Arrived:
        """The packet with the time at which it came in."""
        if self._connected_at is None:
            return arrived
        stamp_s = arrived.decoding_s
        if self._first_s is None:
            self._first_s = self._last_s = stamp_s
            if arrived.arrived_at - self._ready_at > WAITED_S:
                self._connected_at = None
                return arrived
        likely_at = self._connected_at + stamp_s - self._first_s
        if likely_at >= arrived.arrived_at or stamp_s < self._last_s - MAX_FALL_S:
            self._connected_at = None
            return arrived
        self._last_s = stamp_s
        return replace(arrived, arrived_at=likely_at)


class SourceClock:
    """Gives packets their place, in order of decoding."""

    def __init__(self, start_s: float, streams: int = 1) -> None:
        """start_s: the feed's time of the first packet. streams: how many streams' packets come in turn."""
        self._max_fall_s = MAX_FALL_S if streams > 1 else 0.0
        self._now_s = start_s
        self._last: tuple[float, float] | None = None
        self._place = Place(0.0, 0)
        self._step_s = ASSUMED_STEP_S

    def place(self, stamp_s: float, arrived_at: float) -> Place:
        """The place of a packet with this decoding time that came in at arrived_at (UNIX time, s)."""
        if self._last is None:
            self._place = Place(self._now_s - stamp_s, 0)
            self._last = (stamp_s, arrived_at)
        step_s, passed_s = stamp_s - self._last[0], max(0.0, arrived_at - self._last[1])
        if step_s < -self._max_fall_s or (step_s > MAX_STEP_S and step_s - passed_s > MAX_STEP_S):
            self._place = Place(self._now_s + max(passed_s, self._step_s) - stamp_s, self._place.epoch + 1)
            self._last = (stamp_s, arrived_at)
        elif step_s > 0:
            self._step_s = step_s
            self._last = (stamp_s, arrived_at)
        self._now_s = max(self._now_s, self._place.offset_s + stamp_s)
        return self._place
