"""Limit the CPU time that renders take while a job trains: both need all cores, and training has a time budget.

The limit is a token bucket of CPU seconds. While a job trains, the bucket gains SHARE of the CPU time that this process
uses, up to MAX_SAVED_S. If other programs use the cores, training gets less time, and so do renders. A render takes the
CPU time that it used out of the bucket, which may become negative (a debt); the next render starts when the debt is
paid. Time in which a render only waits for a core costs nothing.

A GPU renders in milliseconds, but the first render of a scene may compile kernels for seconds. So max_debt_s may limit
the debt; renders that exceed it get more than SHARE.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SHARE = 0.12
"""Renders' share of the CPU time while a job trains. Model copies, the service and its viewers take some more."""

MIN_USE = 0.25
"""The bucket gains as if the process used at least this share of the cores: it uses few while it decodes a clip."""

MAX_SAVED_S = 0.1
"""Enough for a few renders when a viewer opens. More would disturb the 0.3 s in which training times its steps."""


class RenderPace:
    """Limits the CPU time of renders; for one thread that trains and one that renders.

    Args:
        cores: number of cores: CPU seconds available in a second.
        clock: monotonic seconds.
        used_s: CPU seconds that this process has used; None: count all cores as used.
        max_debt_s: CPU seconds; a render never leaves more debt than that.
        share: renders' share of the CPU time while a job trains.
    """

    def __init__(
        self,
        cores: int = 1,
        clock: Callable[[], float] = time.monotonic,
        used_s: Callable[[], float] | None = None,
        max_debt_s: float = math.inf,
        share: float = SHARE,
    ) -> None:
        self._cores = cores
        self._share = share
        self._max_debt_s = max_debt_s
        self._clock = clock
        self._used_s = used_s or (lambda: cores * clock())
        self._used_before_s = self._used_s()
        self._use = 1.0
        self._lock = threading.Lock()
        self._trains = False
        self._left_s = MAX_SAVED_S
        self._at_s = clock()

    @contextmanager
    def training(self) -> Iterator[None]:
        """Limit renders inside the context."""
        with self._lock:
            self._fill()
            self._trains, self._left_s, self._use = True, MAX_SAVED_S, 1.0
        try:
            yield
        finally:
            with self._lock:
                self._trains = False

    def charge(self, cpu_s: float) -> None:
        """Take the CPU seconds of a render out of the bucket."""
        with self._lock:
            self._left_s -= cpu_s
            self._fill()
            self._left_s = max(self._left_s, -self._max_debt_s)

    def rest_s(self) -> float:
        """Seconds until the next render may start; 0 while no job trains."""
        with self._lock:
            self._fill()
            return max(0.0, -self._left_s / self._rate) if self._trains else 0.0

    def affords(self, cpu_s: float) -> bool:
        """Whether the bucket contains enough for a render of so many CPU seconds, or is full."""
        with self._lock:
            self._fill()
            return not self._trains or min(cpu_s, MAX_SAVED_S) <= self._left_s

    @property
    def trains(self) -> bool:
        """Whether a job trains, so that renders are limited."""
        return self._trains

    @property
    def rate(self) -> float:
        """CPU seconds that renders may use in a second."""
        with self._lock:
            return self._rate if self._trains else float(self._cores)

    @property
    def _rate(self) -> float:
        return self._share * self._cores * self._use

    def _fill(self) -> None:
        now_s, used_s = self._clock(), self._used_s()
        passed_s = now_s - self._at_s
        gained_s = min(max(used_s - self._used_before_s, MIN_USE * self._cores * passed_s), self._cores * passed_s)
        if passed_s > 0:
            self._use += (gained_s / (self._cores * passed_s) - self._use) * min(1.0, passed_s)  # mean of about 1 s
        self._left_s = min(MAX_SAVED_S, self._left_s + self._share * gained_s)
        self._at_s, self._used_before_s = now_s, used_s
