"""Run the process that follows a feed from the supervisor: start it, give it orders, watch it, and replace it."""

from __future__ import annotations

import logging
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from contract.runtime.supervised import Supervised
from contract.wire.feeds import FeedRecord, FeedReport, FeedWish
from contract.wire.rendering import WorkerAddress
from intrasplat.formats import missing_extras
from intrasplat.live.state import FeedReason, FeedState
from worker.feed_orders import FeedReady, FollowFeed, WishFeed, read_feed_message
from worker.order_writer import OrderWriter

MAX_START_S = 240.0
"""Time to import torch and compile all kernels on a slow machine with an empty cache."""
MAX_SILENCE_S = 3.0
"""A process that has reported, and reports nothing for longer, hangs."""
MAX_LOST_S = 20.0
"""A process hangs if pairs come in and its model has learnt none for longer."""
GRACE_S = 6.0
"""For a process to close its feed in order."""
HEALTHY_AFTER_S = 10.0
"""A process that ends sooner is replaced after a pause."""
FOLLOWS = (FeedState.LIVE, FeedState.BEHIND)

IPC = "ipc://"

logger = logging.getLogger("intrasplat.worker")


class FeedProcess:
    """One running process, what it said last, and its orders. Any thread may use it.

    fed_since_s: monotonic time from which on pairs have been coming in; None: none come in
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self.ready: FeedReady | None = None
        self.report: FeedReport | None = None
        self.fed_since_s: float | None = None
        self.said_s = time.monotonic()
        assert process.stdin is not None
        self.orders = OrderWriter(process.stdin)
        threading.Thread(target=self._read, name="feed-reports", daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                message = read_feed_message(line)
                if message is None:
                    logger.warning("the process of a feed printed a line of %d bytes that is no message", len(line))
                    continue
                self.said_s = time.monotonic()
                if isinstance(message, FeedReady):
                    self.ready = message
                else:
                    self.report = message.report
                    is_fed = self.report.state in FOLLOWS and self.report.received_fps > 0
                    self.fed_since_s = (self.fed_since_s or self.said_s) if is_fed else None
        self.orders.end()


class FeedChild:
    """Keeps a process for one feed running. The thread that calls look() must live as long as the process.

    wish: what the process is to do
    """

    def __init__(
        self,
        record: FeedRecord,
        folder: Path,
        endpoints: tuple[str, ...],
        command: Sequence[str],
        environment: Mapping[str, str] | None,
    ) -> None:
        self.wish = record.wish
        self._record, self._folder, self._endpoints = record, folder, endpoints
        self._supervised = Supervised(
            "process of a feed",
            command,
            environment,
            pipes=True,
            dies_with_parent=False,  # the child arranges that itself
            grace_s=GRACE_S,
            healthy_after_s=HEALTHY_AFTER_S,
        )
        self._running: FeedProcess | None = None
        self._last = record.report or FeedReport(state=FeedState.CONNECTING, since_s=time.time())
        self._gap = self._without_process(FeedState.CONNECTING, None, "the process that follows it starts")

    def look(self) -> None:
        """Start a process unless one runs, and kill it if it hangs. Call it often."""
        ended = self._supervised.watch()
        if ended is not None:
            logger.warning("the process of a feed %s; another starts", ended.cause, extra=self._about)
            self._note_end()
            self._remove_sockets()
        process = self._supervised.process
        if process is None:
            return
        if self._running is None or self._running.process is not process:
            self._running = FeedProcess(process)
            record = self._record.model_copy(update={"wish": self.wish})
            self._running.orders.send(FollowFeed(record=record, folder=self._folder, endpoints=self._endpoints))
        if self._running.report is not None:
            self._last = self._running.report
        if (cause := self._hang()) is not None:
            logger.warning("the process of a feed %s and is killed", cause, extra=self._about)
            self._supervised.kill()

    def report(self) -> FeedReport:
        """What the feed does. Until its first process reports it is connecting; between two processes it is stalled."""
        running = self._running
        if running is not None and running.report is not None:
            return running.report
        return self._gap.model_copy(update={"model_age_s": self._age_s()})

    def order(self, wish: FeedWish) -> None:
        """Let the process run or pause the feed."""
        self.wish = wish
        if self._running is not None:
            self._running.orders.send(WishFeed(wish=wish))

    def address(self, name: str) -> WorkerAddress | None:
        """Where the process answers; None while it does not."""
        running = self._running
        if running is None or running.ready is None or running.process.poll() is not None:
            return None
        ready = running.ready
        return WorkerAddress(
            name=name,
            endpoint=ready.endpoint,
            device=ready.device,
            renders_only=True,
            feed_id=self._record.feed_id,
            missing_extras=missing_extras(),
        )

    def ask_to_end(self) -> None:
        """Let the process close its feed; do not wait."""
        self._supervised.ask_to_end()

    def stop(self) -> None:
        """End the process in order, and start no other."""
        self._supervised.stop()
        self._remove_sockets()

    def kill(self) -> None:
        """End the process at once, and start no other."""
        self._supervised.kill()
        self.stop()

    @property
    def _about(self) -> dict[str, str]:
        return {"job_id": self._record.feed_id}

    def _remove_sockets(self) -> None:
        for each in self._endpoints:
            if each.startswith(IPC):
                Path(each.removeprefix(IPC)).unlink(missing_ok=True)

    def _note_end(self) -> None:
        if self._running is not None and self._running.report is not None:
            self._last = self._running.report
        self._running = None
        text = "the process that followed it has ended; another starts"
        self._gap = self._without_process(FeedState.STALLED, FeedReason.FAULT, text)

    def _without_process(self, state: FeedState, reason: FeedReason | None, text: str) -> FeedReport:
        """The last report, changed to that of a feed without a process from now on."""
        changes = {"state": state, "reason": reason, "text": text, "since_s": time.time()}
        return self._last.model_copy(update={**changes, "received_fps": 0.0, "used_fps": 0.0})

    def _age_s(self) -> float | None:
        known = self._last.ends_s
        return None if known is None else max(0.0, time.time() - known)

    def _hang(self) -> str | None:
        """How the process hangs; None if it does not."""
        running = self._running
        assert running is not None
        if running.report is None:
            return None if self._supervised.age_s < MAX_START_S else f"was not ready after {MAX_START_S:g} s"
        if time.monotonic() - running.said_s > MAX_SILENCE_S:
            return f"was silent for {MAX_SILENCE_S:g} s"
        fed_since_s, age_s = running.fed_since_s, running.report.model_age_s or 0.0
        is_lost = fed_since_s is not None and min(age_s, time.monotonic() - fed_since_s) > MAX_LOST_S
        return f"has learnt nothing for {MAX_LOST_S:g} s" if is_lost else None
