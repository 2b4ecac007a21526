"""Records of done jobs, remembered: they never change, so their scenes are shown also while the queue is away."""

from __future__ import annotations

import threading

from contract.queue.interface import Queue
from contract.store.store import Store
from contract.wire.job import JobRecord, JobState

REMEMBERED = 1_000
"""Records, of a few kilobytes each."""


class DoneJobs:
    """The queue's records, those of done jobs out of memory; for many threads."""

    def __init__(self, queue: Queue, store: Store) -> None:
        self._queue = queue
        self._store = store
        self._lock = threading.Lock()
        self._records: dict[str, JobRecord] = {}

    def record(self, job_id: str) -> JobRecord | None:
        """The job's record; None if there is none, or if the job is done and its scene has been removed.

        Raises:
            UnavailableError: the queue is away, and the job was not done when it was last looked up.
        """
        record = self._records.get(job_id) or self._queue.get(job_id)
        if record is None or record.state is not JobState.DONE:
            return record
        there = self._store.has_scene(job_id, record.attempt)
        with self._lock:
            self._records.pop(job_id, None)
            if there:
                self._records[job_id] = record  # at the end: looked up last
            if len(self._records) > REMEMBERED:
                del self._records[next(iter(self._records))]
        return record if there else None

    def forget(self, job_id: str) -> None:
        """Remember no more of a job that was purged."""
        with self._lock:
            self._records.pop(job_id, None)
