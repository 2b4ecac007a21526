"""How much of the time renders may take while a job trains: both need all cores, and training has a time to keep.

A token bucket of seconds. While a job trains it gains SHARE of the time that passes, up to SAVED_S, and a view takes
from it what it took to make, into debt if need be; the next one is begun when there is something in it again. So a
lone view is made at once, and one viewer or a hundred who ask without pause get SHARE of the time among them. What
they are shown is no older for that: a view is of the newest model when it is begun.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SHARE = 0.2
"""Of the time while a job trains: training takes a quarter longer at most, even if it stood still meanwhile."""

SAVED_S = 0.1
"""A few views at once for who opens a viewer. No more: training times some 0.3 s of its steps to see how many fit."""


class Pace:
    """Who may render when; for one thread that trains and one that renders. clock: monotonic seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._trains = False
        self._left_s = SAVED_S
        self._at_s = clock()

    @contextmanager
    def training(self) -> Iterator[None]:
        """A job is worked on inside: renders are rationed."""
        with self._lock:
            self._trains, self._left_s, self._at_s = True, SAVED_S, self._clock()
        try:
            yield
        finally:
            with self._lock:
                self._trains = False

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """A view is made inside; what that takes is counted."""
        start_s = self._clock()
        try:
            yield
        finally:
            with self._lock:
                self._left_s -= self._clock() - start_s
                self._fill()

    def rest_s(self) -> float:
        """Seconds until the next view may be begun; 0 while no job is worked on."""
        with self._lock:
            self._fill()
            return max(0.0, -self._left_s / SHARE) if self._trains else 0.0

    def _fill(self) -> None:
        now_s = self._clock()
        self._left_s = min(SAVED_S, self._left_s + (now_s - self._at_s) * SHARE)
        self._at_s = now_s
