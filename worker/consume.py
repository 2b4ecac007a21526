"""The job loop: claim a job, let the device process reconstruct it, tell the queue how it ended.

Nothing here uses torch, so nothing can hang.

A job ends in exactly one of done, failed and cancelled. If the child dies, the job is handed back and the death counts
against it. If this process must end, or the job must yield to another, the job is handed back and a later attempt
resumes it. If this process dies, its child dies too, the claim expires, and any worker takes the job.

A job is done before its scene is scored. The scores follow within seconds. If scoring is interrupted, the worker scores
the scene when no job waits.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from contract.queue.interface import Claim, Order, Queue
from contract.runtime import traces
from contract.store.store import Store
from contract.wire.job import JobProgress, JobRecord, JobState
from intrasplat.errors import ErrorCode, IntrasplatError, UnavailableError
from intrasplat.files.disk_errors import StoreFullError
from worker.child import ChildKeeper, DeviceChild, Ended, watch
from worker.claim_file import ClaimFile
from worker.disk_space import FreeSpace
from worker.heartbeat import Heartbeat
from worker.job_errors import describe
from worker.orders import FETCHING, Failed, Finished, RunJob, Scored, Stopped
from worker.scores import AwaitedScores, InterruptedScores
from worker.spans import StageSpans, attempt_span

CLAIM_TIMEOUT_S = 1.0
"""How soon an idle worker notices that it should end, or that its child has."""

UNREACHABLE_PAUSE_S = 1.0

MAX_STORE_S = 60.0
"""The job fails when the store fails for so long. For space on the disk the worker waits without limit."""

PUBLISHING = "publish"
"""The last stage that a caller sees: the scene is published."""

DONE = "done"
UNSETTLED = "the queue cannot be reached; the lease will run out"

_Result = TypeVar("_Result")

logger = logging.getLogger("intrasplat.worker")


@dataclass(frozen=True)
class Died:
    """The child has died. excused: not because of the job: it had been ordered to stop, or had died before."""

    cause: str
    excused: bool


class Consumer:
    """Runs one job after the other. job_id names the running one; any thread may read it."""

    def __init__(
        self,
        queue: Queue,
        store: Store,
        keeper: ChildKeeper,
        name: str,
        owner: str,
        end: threading.Event,
        min_free_bytes: int = 0,
    ) -> None:
        self._free_space = FreeSpace(store, min_free_bytes)
        self._queue = queue
        self._store = store
        self._keeper = keeper
        self._name = name
        self._owner = owner
        self._end = end
        self._interrupted_scores = InterruptedScores(queue, store, name, end)
        self.claim_file = ClaimFile(store.run_dir / f"{name}.claim")
        self.job_id: str | None = None

    def run(self, claim_timeout_s: float = CLAIM_TIMEOUT_S) -> None:
        """Take jobs until `end` is set.

        Raises:
            UnavailableError: the child cannot work here.
        """
        away = short = False
        while (child := self._keeper.child(self._end)) is not None:
            was_short, short = short, self._free_space.is_short()
            if short != was_short:
                logger.warning(
                    "jobs wait for free space on the disk" if short else "the disk has enough free space for jobs again"
                )
            if short:
                self._end.wait(claim_timeout_s)
                continue
            try:
                record = self._queue.claim(self._owner, claim_timeout_s)
            except UnavailableError as error:
                if not away:
                    logger.warning("waiting for the queue: %s", error)
                away = True
                self._end.wait(UNREACHABLE_PAUSE_S)
                continue
            away = False
            if record is not None:
                self.job_id = record.job_id
                self.claim_file.note(Claim(record.job_id, record.attempt, self._owner))
                scores = run_job(self._queue, self._store, child, record, self._name, self._end, self._free_space)
                self.claim_file.forget()
                self.job_id = None
                if scores is not None:
                    # Also while a job waits: scoring the scene later takes several times as long.
                    scores.take(child, stop=self._end.is_set)
            else:
                self._interrupted_scores.make_up(child)


def run_job(
    queue: Queue,
    store: Store,
    child: DeviceChild,
    record: JobRecord,
    name: str,
    end: threading.Event,
    free_space: FreeSpace,
) -> AwaitedScores | None:
    """Run one claimed job to its end; hand it back if `end` is set first. name: the worker's name.

    Returns the wait for the scores that the child now measures, if the job is done.
    """
    assert record.owner is not None
    claim = Claim(record.job_id, record.attempt, record.owner)
    log, started_s = _log_of(claim), time.monotonic()
    free_space.begins()
    with attempt_span(record, name) as span, Heartbeat(queue, claim) as heart:
        log.info("an attempt starts")
        job = _Job(queue, store, claim, heart, name, end, free_space)
        try:
            outcome = job.settle(job.work(child, record))
        except IntrasplatError as error:  # the store failed before the child got the job, or after it finished
            outcome = job.settle(job.without_store(error))
        except Exception as error:
            child.kill()
            outcome = job.settle(Failed(error=describe(error), fault=type(error).__name__))
        traces.describe(span, outcome=outcome)
        log.info("%s after %.1f s", outcome, time.monotonic() - started_s)
    if not job.is_scoring:
        return None
    scores = AwaitedScores(store, name, record)
    if outcome == DONE:
        return scores
    if outcome != UNSETTLED:  # if unsettled, the queue may still have accepted the end
        with contextlib.suppress(UnavailableError):  # if this fails, InterruptedScores removes it
            store.expect_no_scores(name, claim.job_id, claim.attempt)
    scores.take(child, stop=lambda: True)
    return None


def _log_of(claim: Claim) -> logging.LoggerAdapter[logging.Logger]:
    """A logger whose lines contain the job's id."""
    return logging.LoggerAdapter(logger, {"job_id": claim.job_id, "attempt": claim.attempt})


class _Job:
    """One attempt at a job: work() watches the child, settle() tells the queue how it ended."""

    def __init__(
        self,
        queue: Queue,
        store: Store,
        claim: Claim,
        heart: Heartbeat,
        name: str,
        end: threading.Event,
        free_space: FreeSpace,
    ) -> None:
        self._free_space = free_space
        self._queue = queue
        self._store = store
        self._claim = claim
        self._heart = heart
        self._name = name
        self._end = end
        self._log = _log_of(claim)
        self._stages = StageSpans()
        self.is_scoring = False

    def work(self, child: DeviceChild, record: JobRecord) -> Finished | Stopped | Failed | Died:
        """Let the child reconstruct; stop it when the queue orders it or `end` is set; kill it when it hangs."""
        job_id, attempt = self._claim.job_id, self._claim.attempt
        self._report(JobProgress(stage=FETCHING, fraction=0.0))
        spool = self._retry_store(lambda: self._store.fetch_clip(job_id))
        resume_dir = self._retry_store(lambda: self._store.resume_folder(job_id, attempt))
        out = self._retry_store(lambda: self._store.work_folder(job_id, attempt))
        if child.ended is not None:
            return Died(child.ended.cause, excused=True)
        child.send(RunJob(record=record, spool=spool, out=out, resume_dir=resume_dir))
        report = watch(child, self._is_to_stop, self._report)
        if isinstance(report, Ended):
            return Died(report.cause, excused=report.was_stopping)
        assert not isinstance(report, Scored)  # follows Finished
        self.is_scoring = isinstance(report, Finished)
        return report

    def _report(self, progress: JobProgress) -> None:
        self._heart.report(progress)
        self._stages.reached(progress.stage)

    def _is_to_stop(self) -> bool:
        return self._heart.order is not Order.GO_ON or self._end.is_set()

    def without_store(self, error: IntrasplatError) -> Failed | Died:
        """The end of an attempt when the store fails: handed back if it had to stop anyway, else failed."""
        if self._is_to_stop():
            return Died("waited for the store", excused=True)
        return Failed(error=describe(error), fault=type(error).__name__)

    def settle(self, result: Finished | Stopped | Failed | Died) -> str:
        """Tell the queue how the attempt ended, and tidy up; return the outcome for the log.

        Retry until the queue answers or `end` is set. If `end` comes first, touch nothing: the claim may have expired.
        """
        if isinstance(result, Failed | Died):
            self._stages.end(result.fault if isinstance(result, Failed) else "died")
        try:
            return self._settle(result)
        finally:
            self._stages.end()

    def _settle(self, result: Finished | Stopped | Failed | Died) -> str:
        if self._heart.order in (Order.CANCEL, Order.LOST):
            return self._withdraw()
        result = self._excuse(result)
        accepted, outcome = self._report_end(result)
        if accepted is None:
            return UNSETTLED
        if not accepted:
            return self._withdraw()
        self._tidy(result)
        return outcome

    def _excuse(self, result: Finished | Stopped | Failed | Died) -> Finished | Stopped | Failed | Died:
        """The same result, except that a job that a full disk ended is handed back without a counted death."""
        is_full = isinstance(result, Failed) and result.error.code is ErrorCode.STORE_FULL
        died = isinstance(result, Died) and not result.excused
        if is_full or (died and self._free_space.is_short()):
            if self._free_space.ran_out(self._claim.job_id):
                return Died("found the disk full", excused=True)
            if isinstance(result, Failed):
                return result.model_copy(update={"error": self._free_space.full_error()})
        elif isinstance(result, Finished | Failed):
            self._free_space.sufficed(self._claim.job_id)
        return result

    def _report_end(self, result: Finished | Stopped | Failed | Died) -> tuple[bool | None, str]:
        """Whether the queue accepts the end (None: it cannot be reached), and a description of the end for the log."""
        if isinstance(result, Finished):
            return self._publish(), DONE
        if isinstance(result, Failed):
            return self._retry_queue(lambda: self._queue.fail(self._claim, result.error)), f"failed ({result.fault})"
        died = isinstance(result, Died) and not result.excused
        if isinstance(result, Died):
            self._log.warning("the device process %s", result.cause)
        if isinstance(result, Stopped) and result.checkpointed:
            self._store.hand_over(self._claim.job_id, self._claim.attempt)
        accepted = self._retry_queue(lambda: self._queue.release(self._claim, died=died))
        return accepted, "released, counted as a death" if died else "released"

    def _publish(self) -> bool | None:
        """Publish the scene, then finish the record: a caller who sees that the job is done must find its scene."""
        self._report(JobProgress(stage=PUBLISHING, fraction=1.0, seconds_left=0.0))
        order = self._retry_queue(self._heart.beat)
        if order is None or order in (Order.CANCEL, Order.LOST):
            return None if order is None else False
        self._retry_store(lambda: self._store.expect_scores(self._name, self._claim.job_id, self._claim.attempt))
        self._retry_store(lambda: self._store.publish_scene(self._claim.job_id, self._claim.attempt))
        return self._retry_queue(lambda: self._queue.finish(self._claim))

    def _withdraw(self) -> str:
        """Remove the whole job if it is cancelled, or this attempt's files if another worker has taken it over."""
        order = self._heart.order
        if order not in (Order.CANCEL, Order.LOST):
            order = self._retry_queue(self._heart.beat) or order
        if order is Order.CANCEL:
            self._remove(lambda: self._store.purge(self._claim.job_id))
            confirmed = self._retry_queue(lambda: self._queue.confirm_cancel(self._claim))
            return UNSETTLED if confirmed is None else "cancelled"
        if order is Order.LOST:
            self._remove(lambda: self._store.remove_attempt(self._claim.job_id, self._claim.attempt))
            return "lost to another attempt"
        return UNSETTLED

    def _tidy(self, result: Finished | Stopped | Failed | Died) -> None:
        """Remove what nobody needs once the queue has accepted the end."""
        job_id, attempt = self._claim.job_id, self._claim.attempt
        if isinstance(result, Finished):
            self._remove(lambda: self._store.remove_other_attempts(job_id, attempt))
        elif isinstance(result, Failed) or (isinstance(result, Died) and self._is_given_up()):
            self._remove(lambda: self._store.remove_attempt(job_id, attempt))

    def _is_given_up(self) -> bool:
        """Whether the queue has failed the job after too many deaths."""
        record = self._retry_queue(lambda: self._queue.get(self._claim.job_id))
        return record is not None and record.state is JobState.FAILED

    def _retry_queue(self, ask: Callable[[], _Result]) -> _Result | None:
        """Retry until the queue answers; None if `end` is set first."""
        while True:
            try:
                return ask()
            except UnavailableError as error:
                self._log.warning("waiting for the queue: %s", error.problem)
                if self._end.wait(UNREACHABLE_PAUSE_S):
                    return None

    def _retry_store(self, work: Callable[[], _Result]) -> _Result:
        """Retry while the store cannot be reached, for up to MAX_STORE_S; the heartbeat continues."""
        deadline_s = time.monotonic() + MAX_STORE_S
        while True:
            try:
                return work()
            except UnavailableError as error:
                is_over = time.monotonic() > deadline_s and not isinstance(error, StoreFullError)
                if is_over or self._is_to_stop():
                    raise
                self._log.warning("waiting for the store: %s", error.problem)
                self._end.wait(UNREACHABLE_PAUSE_S)

    def _remove(self, work: Callable[[], object]) -> None:
        """Remove files. If that fails now, the service's sweep removes them later."""
        try:
            work()
        except UnavailableError as error:
            self._log.warning("files were not removed: %s", error.problem)
