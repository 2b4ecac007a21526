"""The job loop: claim, reconstruct, settle. What a reconstruction is comes in as an argument.

A job ends in exactly one of done, failed and cancelled. If this process dies or is told to end before that, the next
one of the same name gets the job again (contract/queue.py) and goes on from where training was stopped.

Logs name jobs by their ids and errors by their kinds: the text of an error may hold the names of a caller's files.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from contract.errors import Cancelled, InputError, IntrasplatError, UnavailableError
from contract.job import JobError, JobProgress, JobRecord
from contract.queue import ANNOUNCE_PERIOD_S, Claim, Queue
from contract.rendering import WorkerAddress
from contract.store import Store
from worker.checkpoint import RESUME_FILE
from worker.hooks import Hooks, Progress

CLAIM_TIMEOUT_S = 2.0
"""How soon an idle worker notices that it should end."""

REPORT_PERIOD_S = 0.3
"""Least time between two reports of one stage: each is a write that the queue's server puts on disk."""

UNREACHABLE_PAUSE_S = 1.0
SILENCE_S = 5.0
"""After a report that did not arrive there are none for so long: each try holds training up until it is given up."""

PUBLISHING = "publish"
"""The last stage a caller sees: the scene is put in its place."""

FAULT_REMEDY = "This is a fault of intrasplat: please report it with the worker's log."

Work = Callable[[JobRecord, Path, Path, Hooks], object]
"""work(record, spool folder, folder for the scene, hooks); raises Cancelled soon after hooks.should_stop().

The folder is empty, or holds the RESUME_FILE that an attempt left when it was stopped.
"""

logger = logging.getLogger("intrasplat.worker")


def consume(
    queue: Queue,
    store: Store,
    owner: str,
    work: Work,
    end: threading.Event,
    claim_timeout_s: float = CLAIM_TIMEOUT_S,
) -> None:
    """Take jobs one after the other until `end` is set."""
    while not end.is_set():
        try:
            record = queue.claim(owner, claim_timeout_s)
        except UnavailableError as error:
            logger.warning("waiting for the queue: %s", error.problem)
            end.wait(UNREACHABLE_PAUSE_S)
            continue
        if record is not None:
            run_job(queue, store, record, work, end)


def run_job(queue: Queue, store: Store, record: JobRecord, work: Work, end: threading.Event) -> None:
    """Run one claimed job to its end; if `end` is set first, give it back for the next process of this name."""
    assert record.owner is not None
    claim = Claim(record.job_id, record.attempt, record.owner)
    if record.cancel_requested:  # its worker died before it could clear up
        _withdraw(queue, store, claim, end)
        return
    reporter = _Reporter(queue, claim)
    hooks = Hooks(on_progress=reporter.report, should_stop=lambda: reporter.cancelled or end.is_set())
    logger.info("job %s: attempt %d starts", claim.job_id, claim.attempt)
    started_s = time.monotonic()
    settled: bool | None = False
    try:
        out = store.work_folder(claim.job_id, claim.attempt, keep=RESUME_FILE)
        work(record, store.spool_folder(claim.job_id), out, hooks)
        outcome = "done"
        if reporter.may_publish():
            store.publish_scene(claim.job_id, claim.attempt)
            settled = _settle(lambda: queue.finish(claim), end)
    except Cancelled:
        outcome = "given back"
        if not reporter.cancelled:
            settled = _settle(lambda: queue.release(claim), end)
    except Exception as error:
        job_error = describe(error)
        outcome = f"failed ({type(error).__name__})"
        settled = _settle(lambda: queue.fail(claim, job_error), end)
        if settled:
            store.remove_attempt(claim.job_id, claim.attempt)
    if settled:
        logger.info("job %s: %s after %.1f s", claim.job_id, outcome, time.monotonic() - started_s)
    elif settled is not None:
        _withdraw(queue, store, claim, end)


def describe(error: Exception) -> JobError:
    """What the caller is told of an error; of one nobody foresaw only its kind, for its text may hold anything."""
    if isinstance(error, InputError):
        return JobError(problem=error.problem, field=error.field, remedy=error.remedy)
    if isinstance(error, UnavailableError):
        return JobError(problem=error.problem, remedy=error.remedy)
    if isinstance(error, IntrasplatError):
        return JobError(problem=str(error), remedy="The worker's log has the details.")
    where = "".join(traceback.format_tb(error.__traceback__))
    logger.error("a fault while a job ran: %s\n%s", type(error).__name__, where)
    if isinstance(error, MemoryError):
        return JobError(problem="The worker ran out of memory.", remedy="Send a shorter or smaller clip.")
    return JobError(problem=f"A fault in the worker ({type(error).__name__}).", remedy=FAULT_REMEDY)


@contextlib.contextmanager
def announced(queue: Queue, address: WorkerAddress) -> Iterator[None]:
    """Say that this worker is live for as long as the context lasts."""
    end = threading.Event()

    def announce() -> None:
        while not end.is_set():
            with contextlib.suppress(UnavailableError):
                queue.announce(address)
            end.wait(ANNOUNCE_PERIOD_S)

    thread = threading.Thread(target=announce, name="announce", daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()
        with contextlib.suppress(UnavailableError):
            queue.withdraw(address.name)


class _Reporter:
    """Passes progress on to the queue, not too often, and hears from it that the job is cancelled."""

    def __init__(self, queue: Queue, claim: Claim) -> None:
        self._queue = queue
        self._claim = claim
        self._last = Progress(stage="", fraction=0.0)
        self._next_s = 0.0
        self._silent_until_s = 0.0
        self.cancelled = False

    def report(self, progress: Progress) -> None:
        """Send it on, if it is time for another."""
        now_s = time.monotonic()
        same_stage = progress.stage == self._last.stage
        if now_s < self._silent_until_s or (same_stage and now_s < self._next_s):
            return
        self._send(progress)

    def may_publish(self) -> bool:
        """Whether the job is still this attempt's, as far as the queue can be asked."""
        self._send(replace(self._last, stage=PUBLISHING, fraction=1.0, seconds_left=0.0))
        return not self.cancelled

    def _send(self, progress: Progress) -> None:
        if progress.psnr_db is None:  # a later stage measures none; what training reached stays visible
            progress = replace(progress, psnr_db=self._last.psnr_db)
        self._last = progress
        try:
            self.cancelled = not self._queue.progress(self._claim, job_progress(progress)) or self.cancelled
        except UnavailableError:
            # A queue that is away does not stop the work: the result is settled when it is back.
            self._silent_until_s = time.monotonic() + SILENCE_S
        self._next_s = time.monotonic() + REPORT_PERIOD_S


def job_progress(progress: Progress) -> JobProgress:
    """The report as the contract has it: fraction in [0, 1], no numbers that JSON cannot hold."""
    return JobProgress(
        stage=progress.stage,
        fraction=min(1.0, max(0.0, progress.fraction)) if math.isfinite(progress.fraction) else 0.0,
        iteration=progress.iteration,
        iterations=progress.iterations,
        psnr_db=_finite(progress.psnr_db),
        seconds_left=_finite(progress.seconds_left),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _settle(settle: Callable[[], bool], end: threading.Event) -> bool | None:
    """Tell the queue how the job ended, as often as it takes to reach it; None if `end` comes first.

    After None nothing may be touched: the job may have ended as was said, or still be this worker's.
    """
    while True:
        try:
            return settle()
        except UnavailableError as error:
            logger.warning("the result waits for the queue: %s", error.problem)
            if end.wait(UNREACHABLE_PAUSE_S):
                return None


def _withdraw(queue: Queue, store: Store, claim: Claim, end: threading.Event) -> None:
    """The job was cancelled, or is no longer ours: remove what this attempt made."""
    cancelled = _settle(lambda: queue.confirm_cancel(claim), end)
    if cancelled:
        store.remove(claim.job_id)
        logger.info("job %s: cancelled", claim.job_id)
    elif cancelled is not None:
        store.remove_attempt(claim.job_id, claim.attempt)
