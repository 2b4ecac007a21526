"""Repairs differences between spool and queue after a crash or an unreachable queue.

A clip in the spool was accepted, or was about to be, so its job must be in the queue. The sweep goes through the spool
when the service starts, every hour, while the queue may not know a submission, and whenever a job was cancelled or
failed: if its worker had died, the queue ended the job, and nobody has removed its files. It may run in several
services at once, because all its steps may be repeated.
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
"""How often to look for abandoned uploads."""

logger = logging.getLogger("intrasplat.service")


class Sweep:
    """Tracks whether spool and queue may differ, and repairs that."""

    def __init__(self, queue: Queue, store: Store) -> None:
        self._queue = queue
        self._store = store
        self._in_hand: set[str] = set()
        self._lock = threading.Lock()
        self._unsettled = True
        self._ended_badly = 0

    @contextmanager
    def in_hand(self, job_id: str) -> Iterator[None]:
        """Skip this job in sweeps during the context, while a request submits it."""
        with self._lock:
            self._in_hand.add(job_id)
        try:
            yield
        finally:
            with self._lock:
                self._in_hand.discard(job_id)

    def leave(self, job_id: str) -> None:
        """Leave a job to the sweep: its clip is in the spool, and the queue may not know it."""
        with self._lock:
            self._in_hand.discard(job_id)
        self._unsettled = True

    async def run(self) -> None:
        """Run settle() whenever spool and queue may differ, until cancelled."""
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
        """Make the queue match the spool.

        Raises:
            UnavailableError: the queue cannot be reached; a later call does the rest.
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
                    self._queue.ping()  # raises if the queue is unreachable: then no other job can be repaired either
                    logger.warning("an accepted clip cannot be queued: %s", error.problem, extra={"job_id": job_id})
                    self._unsettled = True
            elif record.state is JobState.CANCELLED:  # service or worker died before it removed the clip
                self._store.purge(job_id)
            elif record.state is JobState.DONE:  # its worker died before it removed its work
                if self._store.has_unfinished_work(job_id):
                    self._store.remove_other_attempts(job_id, record.attempt)
            elif record.state is JobState.FAILED:  # its last worker died before it removed its work
                self._store.remove_failed(job_id, record.attempt)

    def _more_ended_badly(self) -> bool:
        """Whether jobs were cancelled or failed since the last call."""
        try:
            ended = self._queue.figures().ended
        except UnavailableError:
            return False
        before, self._ended_badly = self._ended_badly, ended[JobState.CANCELLED] + ended[JobState.FAILED]
        return self._ended_badly != before

    def _try_to_settle(self) -> None:
        self._unsettled = False  # before the work, so that a job that is added meanwhile is not missed
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
        """Enter a job into the queue again: as done if its scene exists, else as queued."""
        submitted = self._store.labelled_submission(job_id)
        if submitted is None:  # removed meanwhile, or damaged
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
        """Remove a job whose clip was removed while it was being queued."""
        self._queue.cancel(record.job_id)
        self._queue.forget(record.job_id)
