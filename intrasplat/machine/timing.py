"""Clocks of a run: seconds per stage, and seconds of training without pauses."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Timings:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def add(self, stage: str, seconds: float) -> None:
        """Add seconds to the stage."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the duration of the block to the stage, unless the block raises."""
        start = time.perf_counter()
        yield
        self.add(stage, time.perf_counter() - start)


class Stopwatch:
    """Seconds since the start, without the pauses."""

    def __init__(self, elapsed_s: float = 0.0) -> None:
        self.restart(elapsed_s)

    def restart(self, elapsed_s: float = 0.0) -> None:
        """Continue from elapsed_s."""
        self._start, self._paused = time.perf_counter() - elapsed_s, 0.0

    @property
    def elapsed_s(self) -> float:
        return time.perf_counter() - self._start - self._paused

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the duration of the block."""
        start = time.perf_counter()
        yield
        self._paused += time.perf_counter() - start
