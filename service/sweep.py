"""What a death or an unreachable queue has left between the spool and the queue is put right here.

A clip in the spool was accepted, or was about to be: its job must stand in the queue. The sweep goes through the
spool at the start of the service, every hour, again for as long as a submission's answer is owing, and whenever a job
was cancelled or failed: where its worker had died, the queue ended it, and nobody has removed its files. It may run in
several services at once, for all it does may be repeated.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from starlette.concurrency import run_in_threadpool

from contract.queue.interface import Queue
from contract.store.store import Store
from contract.wire.job import JobRecord, JobState
from intrasplat.errors import UnavailableError

SWEEP_PERIOD_S = 2.0
ABANDONED_PERIOD_S = 3600.0
"""Uploads that nobody goes on with are looked for this often."""

logger = logging.getLogger("intrasplat.service")


class Sweep:
    """Knows whether anything may be unsettled, and settles it."""

    def __init__(self, queue: Queue, store: Store) -> None:
        self._queue = queue
        self._store = store
        self._in_hand: set[str] = set()
        self._lock = threading.Lock()
        self._unsettled = True
        self._ended_badly = 0

    @contextmanager
    def in_hand(self, job_id: str) -> Iterator[None]:
        """A request is submitting this job; the sweep lets it be until the context ends."""
        with self._lock:
            self._in_hand.add(job_id)
        try:
            yield
        finally:
            with self._lock:
                self._in_hand.discard(job_id)

    def owe(self, job_id: str) -> None:
        """The queue may not know this job, whose clip is in the spool: it is the sweep's from now on."""
        with self._lock:
            self._in_hand.discard(job_id)
        self._unsettled = True

    async def run(self) -> None:
        """Settle all clips whenever one may be unsettled, until cancelled."""
        abandoned_at_s = time.monotonic()
        while True:
            if self._unsettled or await run_in_threadpool(self._more_ended_badly):
                await run_in_threadpool(self._try_to_settle)
            if time.monotonic() >= abandoned_at_s:
                await run_in_threadpool(self._store.tidy)
                abandoned_at_s = time.monotonic() + ABANDONED_PERIOD_S
                self._unsettled = True  # a worker may have died just after its job was done
            await asyncio.sleep(SWEEP_PERIOD_S)

    def settle(self) -> None:
        """Bring the queue to what the spool says.

        Raises:
            UnavailableError: the queue cannot be reached; what is left can be settled later.
        """
        for job_id in self._store.spooled_ids():
            with self._lock:
                if job_id in self._in_hand:
                    continue
            record = self._queue.get(job_id)
            if record is None:
                try:
                    self._recover(job_id)
                except UnavailableError as error:
                    self._queue.ping()  # if it is the queue that is away, no other job can be settled either
                    logger.warning("an accepted clip cannot be queued: %s", error.problem, extra={"job_id": job_id})
                    self._unsettled = True
            elif record.state is JobState.CANCELLED:  # its canceller or its worker died before it removed the clip
                self._store.purge(job_id)
            elif record.state is JobState.DONE:  # its worker died before it removed what led to the scene
                if self._store.has_left_work(job_id):
                    self._store.remove_other_attempts(job_id, record.attempt)
            elif record.state is JobState.FAILED:  # by deaths of its workers, and the last could not remove its work
                self._store.remove_failed(job_id, record.attempt)

    def _more_ended_badly(self) -> bool:
        """Whether jobs came to be cancelled or failed since this was asked before."""
        try:
            ended = self._queue.figures().ended
        except UnavailableError:
            return False
        before, self._ended_badly = self._ended_badly, ended[JobState.CANCELLED] + ended[JobState.FAILED]
        return self._ended_badly != before

    def _try_to_settle(self) -> None:
        self._unsettled = False  # before the work, so that what comes to be owed meanwhile is not forgotten
        is_settled = False
        try:
            self.settle()
            is_settled = True
        except UnavailableError as error:
            logger.warning("accepted clips wait for the queue: %s", error.problem)
        except OSError as error:
            logger.error("the spool cannot be read", extra={"error": type(error).__name__})
        finally:
            self._unsettled = self._unsettled or not is_settled

    def _recover(self, job_id: str) -> None:
        """Make the queue know a job again: as done if its scene is there, else to be run."""
        submitted = self._store.labelled_submission(job_id)
        if submitted is None:  # removed since it was listed, or damaged
            return
        attempt = self._store.published_attempt(job_id)
        if attempt is not None:
            ended = {"state": JobState.DONE, "attempt": attempt, "finished_at_s": time.time()}
            self._queue.restore(submitted.model_copy(update=ended))
            logger.info("a finished job was restored", extra={"job_id": job_id, "attempt": attempt})
            return
        standing = self._queue.submit(submitted)
        if standing.job_id != job_id:  # submitted twice under one idempotency key
            self._store.purge(job_id)
        elif self._store.submission(job_id) is None:
            self._take_back(standing)
        else:
            logger.info("an accepted clip was queued", extra={"job_id": job_id})

    def _take_back(self, record: JobRecord) -> None:
        """Its clip went while it was being queued: whoever removed it promised nothing."""
        self._queue.cancel(record.job_id)
        self._queue.forget(record.job_id)
