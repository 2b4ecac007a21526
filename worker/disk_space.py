"""Decide whether the disk has space for a job, and whether a job that found it full runs again."""

from __future__ import annotations

import math
import time
from collections import Counter

from contract.store.store import Store
from contract.wire.job import JobError
from intrasplat.errors import ErrorCode, UnavailableError
from intrasplat.files.disk import Disk

SPARE_BYTES = 16 * 2**20
MAX_SHORTAGES = 3
"""A job that finds the disk full so often, though it started with enough space, is too large for the disk and fails."""
PAUSE_S = 60.0
"""Wait before the next job, unless space becomes free earlier: what fills the disk may be gone by then."""


class FreeSpace:
    """The free space of a worker's data directory. min_free_bytes: what the service reserves for jobs it has accepted.

    A job may start while a quarter of that is free. After a job has found the disk full, the next one starts when the
    service accepts uploads again, and either more is free than that job started with or PAUSE_S have passed.
    """

    def __init__(self, store: Store, min_free_bytes: int) -> None:
        self._store = store
        self._min_free_bytes = min_free_bytes
        self._enough_bytes = max(min_free_bytes, SPARE_BYTES)
        self._needed_bytes = self._least_bytes = max(min_free_bytes // 4, SPARE_BYTES)
        self._began_bytes: float = 0
        self._shortages: Counter[str] = Counter()
        self._paused_until_s = -math.inf

    def is_short(self) -> bool:
        """Whether no job may start now."""
        free_bytes = self._free_bytes()
        pauses = time.monotonic() < self._paused_until_s and free_bytes <= self._began_bytes + SPARE_BYTES
        return pauses or free_bytes < self._needed_bytes or Disk(self._store.data_dir).is_full()

    def begins(self) -> None:
        """Note that a job starts."""
        self._began_bytes = self._free_bytes()

    def ran_out(self, job_id: str) -> bool:
        """Note that the job found the disk full; return whether it may run again."""
        if self._began_bytes >= self._enough_bytes:
            self._shortages[job_id] += 1
        self._needed_bytes, self._paused_until_s = self._enough_bytes, time.monotonic() + PAUSE_S
        may_run_again = self._shortages[job_id] < MAX_SHORTAGES
        if not may_run_again:  # a caller may retry it, with a new count
            del self._shortages[job_id]
        return may_run_again

    def full_error(self) -> JobError:
        """The error of a job that is too large for the disk."""
        began_mib = round(self._began_bytes / 2**20) if math.isfinite(self._began_bytes) else 0
        problem = f"The worker's disk was full {MAX_SHORTAGES} times; {began_mib} MiB were free when the job began."
        remedy = (
            f"Free more than {began_mib} MiB on it, send a shorter clip, or raise INTRASPLAT_MIN_FREE_BYTES "
            f"({self._min_free_bytes}), which keeps space free for jobs; then retry the job."
        )
        return JobError(code=ErrorCode.STORE_FULL, problem=problem, remedy=remedy)

    def sufficed(self, job_id: str) -> None:
        """Note that the job did not find the disk full."""
        del self._shortages[job_id]
        self._needed_bytes, self._paused_until_s = self._least_bytes, -math.inf

    def _free_bytes(self) -> float:
        try:
            return self._store.free_bytes()
        except UnavailableError:  # the disk is gone; the store reports that for each job
            return math.inf
