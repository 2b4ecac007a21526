"""Warnings of `up` about the disk: printed once when free space is short, and once when there is enough again."""

from __future__ import annotations

import time
from collections.abc import Callable

from intrasplat.files.disk import FULL_REMEDY, Disk

LOOK_PERIOD_S = 1.0


class DiskWatch:
    """Checks the data directory's disk every LOOK_PERIOD_S. say: prints a message of the launcher."""

    def __init__(self, disk: Disk, min_free_bytes: int, say: Callable[[str], None]) -> None:
        self._disk = disk
        self._min_free_bytes = min_free_bytes
        self._say = say
        self._next_s = 0.0
        self.is_full = False
        """Nothing can be written."""
        self.is_short = False
        """The service accepts no clips."""

    def look(self, *, now: bool = False) -> None:
        """Check the disk if it is time, or now, and print what has changed."""
        if not now and time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + LOOK_PERIOD_S
        try:
            free_bytes, self.is_full = self._disk.free_bytes(), self._disk.is_full()
        except OSError:  # the disk is gone, which the service and the worker report
            return
        was_short, self.is_short = self.is_short, self.is_full or free_bytes < self._min_free_bytes
        if self.is_short == was_short:
            return
        state = f"{self._disk.name} has {free_bytes >> 20} MiB left"
        if self.is_short:
            self._say(
                f"{state}, and {self._min_free_bytes >> 20} are needed: no clips are accepted and jobs may wait; "
                f"views and purges go on. {FULL_REMEDY}"
            )
        else:
            self._say(f"{state}: clips are accepted and jobs go on")
