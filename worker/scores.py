"""Wait for the scores that the device process measures, and score scenes whose scoring was interrupted.

Nothing here uses torch, so nothing can hang.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable

from contract.queue.interface import Queue
from contract.runtime import traces
from contract.store.store import Store
from contract.wire.job import JobRecord, JobState
from intrasplat.errors import SceneError, UnavailableError
from intrasplat.report import Report
from intrasplat.scene.results import without_scores
from worker.child import DeviceChild, Ended, watch
from worker.orders import Scored, ScoreScene

ASK_PERIOD_S = 1.0
"""How often the worker asks the queue for waiting jobs while it only scores."""

RETRY_AFTER_S = 60.0
"""How long a scene waits after an attempt that ended without scores."""

logger = logging.getLogger("intrasplat.worker")


class AwaitedScores:
    """Waits for the scores of a finished scene and adds them to it. name: the worker's name."""

    def __init__(self, store: Store, name: str, record: JobRecord) -> None:
        self._store = store
        self._scene = name, record.job_id, record.attempt
        self._trace = record.trace or traces.NEW
        self._log = logging.LoggerAdapter(logger, _named(record.job_id, record.attempt))

    def take(self, child: DeviceChild, stop: Callable[[], bool], *, gives_up: bool = False) -> bool:
        """Wait until the child has scored the scene, is stopped, hangs or dies.

        gives_up: blame the scene if the child hangs or dies: its report then says that there will be no scores.

        Returns:
            Whether the scene is complete: its scores are added, or no longer expected.
        """
        name, job_id, attempt = self._scene
        with traces.span("score", self._trace, job_id=job_id, attempt=attempt, worker=name):
            return self._take(child, stop, gives_up=gives_up)

    def _take(self, child: DeviceChild, stop: Callable[[], bool], *, gives_up: bool) -> bool:
        report = watch(child, stop)
        if isinstance(report, Scored):
            return self._add_report(lambda: report.report)
        if isinstance(report, Ended) and not report.was_stopping:
            cause = report.cause
            self._log.warning("the device process %s while it scored a scene", cause)
            if gives_up:
                return self._add_report(lambda: without_scores(self._store.newest_report(*self._scene[1:]), cause))
        return False

    def _add_report(self, scored: Callable[[], Report]) -> bool:
        """Add the report that `scored` returns. False: that failed, and the scene will be scored again later."""
        try:
            try:
                self._store.add_scores(*self._scene, scored())
            except SceneError as error:  # it was purged, or is damaged
                self._log.warning("the scores were not stored: %s", error)
                self._store.expect_no_scores(*self._scene)
        except UnavailableError as error:
            self._log.warning("the scores were not stored: %s", error)
            return False
        return True


class InterruptedScores:
    """Scores scenes whose scoring a death or the end of this worker interrupted. name: the worker's name."""

    def __init__(self, queue: Queue, store: Store, name: str, end: threading.Event) -> None:
        self._queue = queue
        self._store = store
        self._name = name
        self._end = end
        self._warned: set[str] = set()
        self._tried_s: dict[str, float] = {}
        """When the last attempt ended, on the monotonic clock."""

    def make_up(self, child: DeviceChild) -> None:
        """Score one of these scenes; stop when a job waits. A scene whose files cannot be fetched is skipped."""
        try:
            expected = self._store.unscored(self._name)
        except UnavailableError as error:
            self._warn_once("", 0, error)
            return
        for job_id, attempt in expected:
            if time.monotonic() < self._tried_s.get(job_id, -RETRY_AFTER_S) + RETRY_AFTER_S:
                continue
            try:
                order = self._order_for(job_id, attempt)
            except (UnavailableError, SceneError) as error:
                self._warn_once(job_id, attempt, error)
                continue
            if order is not None:
                logger.info("scoring a scene whose scoring was interrupted", extra=_named(job_id, attempt))
                child.send(order)
                scores = AwaitedScores(self._store, self._name, order.record)
                if not scores.take(child, stop=self._is_to_stop(), gives_up=True):
                    self._tried_s[job_id] = time.monotonic()
                return

    def _order_for(self, job_id: str, attempt: int) -> ScoreScene | None:
        """The order to score a scene; None: its scores are not needed any more."""
        record = self._queue.get(job_id)
        if record is None or record.state is not JobState.DONE or record.attempt != attempt:
            self._store.expect_no_scores(self._name, job_id, attempt)
            return None
        try:
            report = self._store.newest_report(job_id, attempt)
        except SceneError as error:  # it was purged, or is damaged
            self._warn_once(job_id, attempt, error)
            self._store.expect_no_scores(self._name, job_id, attempt)
            return None
        if report.scored:  # adding the same scores again completes an addition that a kill interrupted
            self._store.add_scores(self._name, job_id, attempt, report)
            return None
        spool, scene = self._store.fetch_clip(job_id), self._store.scene_folder(job_id, attempt)
        return ScoreScene(record=record, spool=spool, scene=scene)

    def _warn_once(self, job_id: str, attempt: int, error: Exception) -> None:
        if job_id not in self._warned:
            logger.warning("a scene waits for its scores: %s", error, extra=_named(job_id, attempt))
        self._warned.add(job_id)

    def _is_to_stop(self) -> Callable[[], bool]:
        """A function: whether this worker ends or a job waits. It asks the queue every ASK_PERIOD_S."""
        asked_s = time.monotonic()

        def is_to_stop() -> bool:
            nonlocal asked_s
            if self._end.is_set() or time.monotonic() < asked_s + ASK_PERIOD_S:
                return self._end.is_set()
            asked_s = time.monotonic()
            with contextlib.suppress(UnavailableError):
                return self._queue.figures().queued > 0
            return False

        return is_to_stop


def _named(job_id: str, attempt: int) -> dict[str, object]:
    """The fields of a log line that name a job."""
    return {"job_id": job_id, "attempt": attempt}
