"""A worker for the tests that follows live feeds as the queue has them; only pictures and files are made up."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from contract.queue.embedded import short_socket_path
from contract.queue.feeds import FeedClaim
from contract.queue.interface import Queue
from contract.wire.feeds import CutRange, FeedReport, FeedShown, FeedWish
from contract.wire.rendering import (
    CutRequest,
    ExportRequest,
    MeasureRequest,
    PushRequest,
    RenderRequest,
    WorkerAddress,
)
from intrasplat.errors import InputError, UnavailableError
from intrasplat.live.state import FeedReason, FeedState
from intrasplat.live.times import FeedTimeKind
from tests.answers import at_once
from tests.measurements import measurement_reply
from worker.aside import Aside
from worker.reply import Reply
from worker.serve import RequestServer

BEGAN_S = 1_700_000_000.0
"""UNIX time of the feeds' first pair."""
PERIOD_S = 0.01


class FeedWorker:
    """Claims feeds, reports and does what is wished. `newest_s`: the newest moment, in seconds of the source."""

    def __init__(self, queue: Queue, folder: Path, clip: bytes = b"") -> None:
        self.newest_s = 60.0
        self.state = FeedState.LIVE
        self.obeys = True
        self.asked: list[Any] = []
        self.pushed: dict[str, bytes] = {}
        self.bodies: list[bytes] = []
        self.losses: list[int] = []
        """Which bodies, counted from 0, are refused as by a process that has just begun."""
        self.replaced: set[str] = set()
        self.clip = clip
        self.cut = CutRange(from_s=BEGAN_S + 30, to_s=BEGAN_S + 60, frames=900)
        self._queue = queue
        self._folder = folder
        self._claims: dict[str, FeedClaim] = {}
        self._servers = ExitStack()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> FeedWorker:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._end.set()
        self._thread.join()
        self._servers.close()

    def report(self) -> FeedReport:
        ends_s = BEGAN_S + self.newest_s
        return FeedReport(
            state=self.state,
            reason=FeedReason.BY_HAND if self.state is FeedState.PAUSED else None,
            since_s=BEGAN_S,
            received_fps=30.0,
            used_fps=5.0,
            dropped=7,
            model_age_s=0.4,
            last_frame_at_s=ends_s,
            stored_bytes=12345,
            begins_s=BEGAN_S,
            ends_s=ends_s,
            source_begins_s=0.0,
            source_ends_s=self.newest_s,
        )

    def _run(self) -> None:
        while not self._end.wait(PERIOD_S):
            record = self._queue.claim_feed("worker-1.token")
            if record is not None:
                self._claims[record.feed_id] = FeedClaim(record.feed_id, record.epoch, "worker-1.token")
                self._serve(record.feed_id)
            for claim in list(self._claims.values()):
                wish = self._queue.beat_feed(claim, self.report())
                if wish is FeedWish.END and self.obeys:
                    self._queue.forget_feed(claim)
                    self._queue.withdraw(f"worker-1-feed-{claim.feed_id[:8]}")
                    del self._claims[claim.feed_id]
                elif self.obeys and (self.state is FeedState.PAUSED) != (wish is FeedWish.PAUSE):
                    self.state = FeedState.PAUSED if wish is FeedWish.PAUSE else FeedState.LIVE

    def _serve(self, feed_id: str) -> None:
        name = f"worker-1-feed-{feed_id[:8]}"
        endpoint = f"ipc://{short_socket_path(self._folder, f'{name}.sock')}"
        aside = Aside({CutRequest: self._answer_aside, PushRequest: self._answer_aside})
        self._servers.enter_context(RequestServer(endpoint, at_once(self._answer), aside=aside))
        address = WorkerAddress(name=name, endpoint=endpoint, device="cpu", feed_id=feed_id, renders_only=True)
        self._queue.announce(address)

    def _answer(self, request: Any) -> Reply:
        self.asked.append(request)
        shown_s = self._second_of(request)
        shown = FeedShown(
            state=self.state,
            source_s=shown_s,
            captured_at_s=BEGAN_S + shown_s,
            age_s=self.newest_s - shown_s + 0.5,
            is_newest=shown_s == self.newest_s,
        )
        if isinstance(request, MeasureRequest):
            return measurement_reply(request)
        if isinstance(request, ExportRequest):
            return Reply(b"ply\n", "application/octet-stream", 0.0, feed=shown)
        if isinstance(request, RenderRequest) and request.newer_than_s is not None and shown_s <= request.newer_than_s:
            return Reply(b"", "image/png", 0.0, feed=shown)
        return Reply(b"picture", "image/png", 0.0, feed=shown)

    def _second_of(self, request: Any) -> float:
        moment = request.moment
        if moment.kind is FeedTimeKind.SOURCE:
            return float(moment.seconds)
        if moment.kind is FeedTimeKind.UNIX:
            return float(moment.seconds) - BEGAN_S
        if moment.seconds > self.newest_s:
            raise InputError("t", "This is before the feed's past.", "Give a later moment.")
        return float(self.newest_s - moment.seconds)

    def _answer_aside(self, request: CutRequest | PushRequest, content: bytes) -> Reply:
        self.asked.append(request)
        if isinstance(request, PushRequest):
            if request.push_id in self.replaced:
                raise InputError("push", "Another connection pushes this feed.", "Push over one connection.")
            self.bodies.append(content)
            if len(self.bodies) - 1 in self.losses:
                self.replaced.add(request.push_id)
                raise UnavailableError("The push was cut off.", "Begin it anew.")
            self.pushed[request.push_id] = self.pushed.get(request.push_id, b"") + content
            return Reply(b"", "application/octet-stream", 0.0)
        if request.begins.kind is FeedTimeKind.UNIX and request.begins.seconds < BEGAN_S:
            raise InputError("from", "This is not recorded.", "Give a later moment.")
        if request.part == 0:
            return Reply(b"", "video/mp4", 0.0, more=True)  # it is being made
        half = len(self.clip) // 2
        body = self.clip[:half] if request.part == 1 else self.clip[half:]
        return Reply(body, "video/mp4", 0.0, cut=self.cut if request.part == 1 else None, more=request.part == 1)


@contextmanager
def following(queue: Queue, folder: Path, clip: bytes = b"") -> Iterator[FeedWorker]:
    """A worker that follows feeds until the end of the context."""
    with FeedWorker(queue, folder, clip) as worker:
        yield worker


def wait_until(is_so: Any, timeout_s: float = 10.0) -> None:
    """Return when it is so."""
    until_s = time.monotonic() + timeout_s
    while not is_so():
        assert time.monotonic() < until_s
        time.sleep(0.005)
