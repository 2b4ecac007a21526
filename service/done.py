"""Records of done jobs, so that their scenes can be shown while the queue is unreachable.

A done job's record never changes, so records are cached. While the queue is unreachable, the record of any other
finished scene is built from the store: the submission names the tenant, and the scene's folder the attempt.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Sequence

from contract.queue.interface import Queue, place_of
from contract.store.store import Store
from contract.wire.job import JobRecord, JobState
from intrasplat.errors import UnavailableError
from service.listing import Page, SceneSearch, find_among, find_page
from service.questions import Questions

REMEMBERED = 1_000
"""Size of the cache in records, of a few kilobytes each."""

PATIENCE_S = 1.0
"""How long to wait for the queue's record. The queue's client itself retries for many seconds."""

LIST_PATIENCE_S = 5.0
"""The same for the list of all jobs."""


class DoneJobs:
    """Records from the queue; those of done jobs also from memory or from the store. Thread-safe."""

    def __init__(self, queue: Queue, store: Store, questions: Questions) -> None:
        self._queue = queue
        self._store = store
        self._lock = threading.Lock()
        self._records: dict[str, JobRecord] = {}
        self._questions = questions
        self._submitted: dict[str, JobRecord] = {}

    def record(self, job_id: str) -> JobRecord | None:
        """The job's record; None if there is none, or if the job is done and its scene has been removed.

        Raises:
            UnavailableError: the queue is unreachable, and the job has no finished scene.
        """
        record = self._records.get(job_id)
        if record is None:
            try:
                record = self._questions.ask(lambda: self._queue.get(job_id), PATIENCE_S)
            except UnavailableError:
                stored = self._stored(job_id)
                if stored is None:
                    raise
                return stored  # not cached: the queue may have a newer record when it is back
        if record is None or record.state is not JobState.DONE:
            return record
        there = self._store.has_scene(job_id, record.attempt)
        with self._lock:
            self._records.pop(job_id, None)
            if there:
                self._records[job_id] = record  # at the end: most recently used
            if len(self._records) > REMEMBERED:
                del self._records[next(iter(self._records))]
        return record if there else None

    def page_of(self, tenant: str, search: SceneSearch) -> tuple[Page, bool]:
        """A page of the tenant's done jobs, and whether it comes from the queue.

        While the queue is unreachable, these are the jobs with a finished scene in the store.
        """
        find = functools.partial(self._queue.records, tenant)
        try:
            page = self._questions.ask(lambda: find_page(search, tenant, find, JobState.DONE), LIST_PATIENCE_S)
        except UnavailableError:
            stored = find_among(self._stored_of(tenant))
            return find_page(search, tenant, lambda limit, before: self._labelled(stored(limit, before))), False
        return page, True

    def forget(self, job_id: str) -> None:
        """Remove a purged job from the cache."""
        with self._lock:
            self._records.pop(job_id, None)

    def _stored(self, job_id: str) -> JobRecord | None:
        """The record of a finished scene, built from the store; None if there is none.

        None also for a job with several finished attempts: only the queue knows which one counts.
        """
        return _as_done(self._store.submission(job_id), self._store.scene_attempts(job_id))

    def _stored_of(self, tenant: str) -> list[JobRecord]:
        """As _stored(), for all scenes of a tenant, the last submitted first."""
        attempts = self._store.finished_scenes()
        found = {job_id: self._submitted.get(job_id) or self._store.submission(job_id) for job_id in attempts}
        self._submitted = {job_id: each for job_id, each in found.items() if each is not None}  # never change
        done = (_as_done(each, attempts[job_id]) for job_id, each in self._submitted.items() if each.tenant == tenant)
        return sorted(filter(None, done), key=place_of, reverse=True)

    def _labelled(self, records: Sequence[JobRecord]) -> list[JobRecord]:
        return [each.model_copy(update={"labels": self._store.labels(each.job_id)}) for each in records]


def _as_done(submitted: JobRecord | None, attempts: list[int]) -> JobRecord | None:
    """The record of a done job; None if the attempt is not known."""
    if submitted is None or len(attempts) != 1:
        return None
    return submitted.model_copy(update={"state": JobState.DONE, "attempt": attempts[0]})
