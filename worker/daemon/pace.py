"""Limit the share of time that renders take while a job trains: both need all cores, and training has a time budget.

A token bucket of seconds. While a job trains, the bucket gains SHARE of the time that passes, up to MAX_SAVED_S. A
render takes its own duration out of the bucket, into debt if need be; the next one begins when the debt is paid. So a
single render is made at once, and any number of viewers who ask without pause get SHARE of the time together. Each
render shows the newest model at its beginning.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SHARE = 0.2
"""Of the time while a job trains. Training takes at most a quarter longer, even if it stands still during renders."""

MAX_SAVED_S = 0.1
"""Enough for a few renders when a viewer opens. More would disturb the 0.3 s in which training times its steps."""


class Pace:
    """Rations renders; for one thread that trains and one that renders. clock: monotonic seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._trains = False
        self._left_s = MAX_SAVED_S
        self._at_s = clock()

    @contextmanager
    def training(self) -> Iterator[None]:
        """Ration renders while the context lasts."""
        with self._lock:
            self._trains, self._left_s, self._at_s = True, MAX_SAVED_S, self._clock()
        try:
            yield
        finally:
            with self._lock:
                self._trains = False

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """Count the time that the context lasts as a render."""
        start_s = self._clock()
        try:
            yield
        finally:
            with self._lock:
                self._left_s -= self._clock() - start_s
                self._fill()

    def rest_s(self) -> float:
        """Seconds until the next render may begin; 0 while no job trains."""
        with self._lock:
            self._fill()
            return max(0.0, -self._left_s / SHARE) if self._trains else 0.0

    def _fill(self) -> None:
        now_s = self._clock()
        self._left_s = min(MAX_SAVED_S, self._left_s + (now_s - self._at_s) * SHARE)
        self._at_s = now_s
