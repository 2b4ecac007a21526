"""Records of done jobs, so that their scenes are shown also while the queue is away.

A done job's record never changes: those that were looked up are remembered. While the queue is away, the record of any
other finished scene is made of what the store knows: the submission names the tenant, the scene's folder the attempt.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor

from contract.queue.interface import Queue
from contract.store.store import Store
from contract.wire.errors import UnavailableError
from contract.wire.job import JobRecord, JobState

REMEMBERED = 1_000
"""Records, of a few kilobytes each."""

PATIENCE_S = 1.0
"""How long to wait for the queue's record. The queue's client itself tries for many seconds."""

THREADS = 8
"""Look-ups at a time."""


class DoneJobs:
    """The queue's records, those of done jobs out of memory or from the store; for many threads."""

    def __init__(self, queue: Queue, store: Store) -> None:
        self._queue = queue
        self._store = store
        self._lock = threading.Lock()
        self._records: dict[str, JobRecord] = {}
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="records")
        self._unanswered: Future[JobRecord | None] | None = None

    def record(self, job_id: str) -> JobRecord | None:
        """The job's record; None if there is none, or if the job is done and its scene has been removed.

        Raises:
            UnavailableError: the queue is away, and the job has no finished scene.
        """
        record = self._records.get(job_id)
        if record is None:
            try:
                record = self._ask(job_id)
            except UnavailableError:
                stored = self._stored(job_id)
                if stored is None:
                    raise
                return stored  # not remembered: the queue may know better when it is back
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

    def close(self) -> None:
        """Look up nothing more."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _ask(self, job_id: str) -> JobRecord | None:
        """The queue's record; UnavailableError if it, or one that was asked for before, does not come in PATIENCE_S."""
        unanswered = self._unanswered
        if unanswered is None or unanswered.done():
            asked = self._pool.submit(self._queue.get, job_id)
            try:
                return asked.result(PATIENCE_S)
            except TimeoutError:
                self._unanswered = asked
        remedy = "Start it with `intrasplat up`, or correct REDIS_URL."
        raise UnavailableError("The queue does not answer.", remedy, may_return=True)

    def _stored(self, job_id: str) -> JobRecord | None:
        """The record of a finished scene as the store knows it; None if there is none.

        Of a job with several finished attempts only the queue knows which one counts.
        """
        attempts, submitted = self._store.scene_attempts(job_id), self._store.submission(job_id)
        if submitted is None or len(attempts) != 1:
            return None
        return submitted.model_copy(update={"state": JobState.DONE, "attempt": attempts[0]})
