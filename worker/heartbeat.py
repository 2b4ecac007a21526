"""Renew one claim in a separate thread, which neither work nor a slow disk delays."""

from __future__ import annotations

import logging
import threading
import time

from contract.queue.interface import BEAT_PERIOD_S, Claim, Order, Queue
from contract.wire.job import JobProgress
from intrasplat.errors import UnavailableError

REPORT_PERIOD_S = 0.3
"""Minimum time between two beats that only carry progress: the queue's server writes each to disk."""

RETRY_PERIOD_S = 1.0

logger = logging.getLogger("intrasplat.worker")


class Heartbeat:
    """A context manager that beats for a claim every BEAT_PERIOD_S, and at once when a new stage starts.

    Each beat sends the newest progress and returns the queue's order. CANCEL, YIELD and LOST stay in force.
    While the queue cannot be reached, the work continues; the claim is valid if the queue answers within the lease.
    """

    def __init__(self, queue: Queue, claim: Claim) -> None:
        self._queue = queue
        self._claim = claim
        self._changed = threading.Condition()
        self._beating = threading.Lock()
        self._progress: JobProgress | None = None
        self._unsent = False
        self._urgent = False
        self._ended = False
        self._order = Order.GO_ON
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    @property
    def order(self) -> Order:
        """The queue's last order."""
        return self._order

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join()

    def report(self, progress: JobProgress) -> None:
        """Send this progress with the next beat that is due."""
        with self._changed:
            before = self._progress
            if before is not None:  # keep the scores and iterations of training
                progress = progress.model_copy(update=_reached(before, progress))
            self._urgent = self._urgent or before is None or before.stage != progress.stage
            self._progress, self._unsent = progress, True
            self._changed.notify()

    def beat(self) -> Order:
        """Beat now; return the queue's order.

        Raises:
            UnavailableError: the queue cannot be reached.
        """
        with self._beating:
            with self._changed:
                progress = self._progress if self._unsent else None
                self._unsent = self._urgent = False
            try:
                order = self._queue.beat(self._claim, progress)
            except Exception:
                with self._changed:
                    self._unsent = self._unsent or progress is not None
                raise
            # CANCEL and LOST are final; they may follow YIELD.
            if order is not Order.GO_ON and self._order in (Order.GO_ON, Order.YIELD):
                self._order = order
            return self._order

    def _run(self) -> None:
        earliest_s = latest_s = time.monotonic()
        away = False
        while self._wait(earliest_s, latest_s, hurries=not away):
            began_s = time.monotonic()
            try:
                self.beat()
            except Exception as error:  # continue after any error: without beats the claim is lost
                if not away:
                    reason = error.problem if isinstance(error, UnavailableError) else type(error).__name__
                    logger.warning("the queue cannot be reached: %s", reason, extra={"job_id": self._claim.job_id})
                away = True
                earliest_s = latest_s = time.monotonic() + RETRY_PERIOD_S
            else:
                away = False
                earliest_s, latest_s = began_s + REPORT_PERIOD_S, began_s + BEAT_PERIOD_S

    def _wait(self, earliest_s: float, latest_s: float, *, hurries: bool) -> bool:
        """Wait until a beat is due; False once the context ends.

        A beat is due at latest_s, with unsent progress at earliest_s, with a new stage at once.
        """
        with self._changed:
            while not self._ended:
                due_s = earliest_s if self._unsent else latest_s
                wait_s = 0.0 if self._urgent and hurries else due_s - time.monotonic()
                if wait_s <= 0:
                    return True
                self._changed.wait(wait_s)
        return False


def _reached(before: JobProgress, now: JobProgress) -> dict[str, object]:
    """The earlier scores and iterations, which the progress of a stage without training does not have."""
    scores = {"psnr_db": before.psnr_db, "psnr_right_db": before.psnr_right_db}
    iterations = {"iteration": before.iteration, "iterations": before.iterations}
    return {**(scores if now.psnr_db is None else {}), **(iterations if now.iterations == 0 else {})}
