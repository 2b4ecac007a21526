"""The beats of one claim, in a thread of their own: neither work nor a slow disk holds them up."""

from __future__ import annotations

import logging
import threading
import time

from contract.queue.promise import BEAT_PERIOD_S, Claim, Order, Queue
from contract.wire.errors import UnavailableError
from contract.wire.job import JobProgress

REPORT_PERIOD_S = 0.3
"""Least time between two beats for progress alone: each is a write that the queue's server puts on disk."""

RETRY_PERIOD_S = 1.0

logger = logging.getLogger("intrasplat.worker")


class Heartbeat:
    """Beats while its context lasts: at least every BEAT_PERIOD_S, with the newest progress, at once in a new stage.

    order is what the queue wants; CANCEL, YIELD and LOST stay once they were heard. A queue that cannot be reached
    changes nothing: the work goes on, and the claim stands if it is back within the lease.
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
        """The last word of the queue."""
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
        """Send this with one of the next beats."""
        with self._changed:
            before = self._progress
            if progress.psnr_db is None and before is not None:  # what training reached stays visible
                progress = progress.model_copy(update={"psnr_db": before.psnr_db})
            self._urgent = self._urgent or before is None or before.stage != progress.stage
            self._progress, self._unsent = progress, True
            self._changed.notify()

    def beat(self) -> Order:
        """Beat now.

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
            # To yield is a wish, and may be followed by either of the others, which are final.
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
            except Exception as error:  # whatever it was: without beats the claim is lost, and no order is heard
                if not away:
                    reason = error.problem if isinstance(error, UnavailableError) else type(error).__name__
                    logger.warning("no beat gets through: %s", reason, extra={"job_id": self._claim.job_id})
                away = True
                earliest_s = latest_s = time.monotonic() + RETRY_PERIOD_S
            else:
                away = False
                earliest_s, latest_s = began_s + REPORT_PERIOD_S, began_s + BEAT_PERIOD_S

    def _wait(self, earliest_s: float, latest_s: float, *, hurries: bool) -> bool:
        """Until a beat is due: by latest_s, with progress from earliest_s on, with a new stage at once."""
        with self._changed:
            while not self._ended:
                due_s = earliest_s if self._unsent else latest_s
                wait_s = 0.0 if self._urgent and hurries else due_s - time.monotonic()
                if wait_s <= 0:
                    return True
                self._changed.wait(wait_s)
        return False
