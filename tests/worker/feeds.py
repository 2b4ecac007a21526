"""Records of feeds, and the processes that follow them, for tests of a worker."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import zmq

from contract.runtime.settings import Settings
from contract.store.feed_files import FeedFiles
from contract.store.shelf import new_job_id
from contract.wire.feeds import FeedOptions, FeedRecord, FeedReport
from contract.wire.rendering import FeedRequest, RenderRequest, WorkerReply, WorkerRequest
from intrasplat.intake.calibration.types import RawCalibration, RectifiedCalibration
from intrasplat.live.times import LIVE, FeedTime
from tests.memory_queue import MemoryQueue
from worker.feeds import FEED_COMMAND, FeedHost, endpoints_of

FEED_STANDIN = (sys.executable, str(Path(__file__).with_name("feed_standin.py")))
WIDTH = 128
WAIT_S = 40.0


def eventually(holds: Callable[[], object], what: Callable[[], object] = lambda: "") -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline_s, what()
        time.sleep(0.02)


def feed_record(
    source: str | None, calibration: RectifiedCalibration | RawCalibration | None = None, **options: object
) -> FeedRecord:
    """A feed that was just opened."""
    return FeedRecord(
        feed_id=new_job_id(),
        options=FeedOptions.model_validate({"source": source, "layout": "sbs", "width": WIDTH} | options),
        calibration="{}" if calibration is None else calibration.model_dump_json(),
        calibration_name="calibration.json",
        created_at_s=time.time(),
    )


def render_request(feed_id: str, moment: FeedTime = LIVE, **more: object) -> RenderRequest:
    return RenderRequest.model_validate({"scene_id": feed_id, "t": 0, "moment": moment, "format": "jpeg"} | more)


class Hosted:
    """A queue, and a worker's side of live feeds."""

    def __init__(
        self, data_dir: Path, *, places: int = 1, command: Sequence[str] = FEED_COMMAND, **settings: object
    ) -> None:
        self.queue, self.files = MemoryQueue(), FeedFiles(data_dir)
        self.run_dir = data_dir / "run"
        self.run_dir.mkdir(parents=True)
        chosen = Settings.model_validate({"data_dir": data_dir, "feed_private": "yes"} | settings)
        environment = {**os.environ, **chosen.to_environment()}
        self.host = FeedHost(
            self.queue, self.files, "worker-1.a", places,
            lambda name: endpoints_of(name, self.run_dir, None), environment, command,
        )  # fmt: skip

    def open(self, record: FeedRecord) -> FeedRecord:
        return self.queue.open_feed(record, 8, 8)

    def report(self, feed_id: str) -> FeedReport | None:
        record = self.queue.feed(feed_id)
        return None if record is None else record.report

    def state(self, feed_id: str) -> str | None:
        report = self.report(feed_id)
        return None if report is None else report.state.value

    def known_s(self, feed_id: str) -> float:
        """Seconds of its past that can be viewed."""
        report = self.report(feed_id)
        if report is None or report.ends_s is None or report.begins_s is None:
            return 0.0
        return report.ends_s - report.begins_s

    def endpoint(self, feed_id: str) -> str:
        """Where its process answers."""
        found: list[str] = []

        def is_there() -> bool:
            found.extend(each.endpoint for each in self.queue.workers() if each.feed_id == feed_id)
            return bool(found)

        eventually(is_there)
        return found[0]


class Asker:
    """Asks a process as the service does."""

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVTIMEO, 20_000)
        self._socket.connect(endpoint)

    def send(self, request: FeedRequest, content: bytes | None = None) -> None:
        frames = [b"1", WorkerRequest(request=request).model_dump_json().encode()]
        self._socket.send_multipart(frames if content is None else [*frames, content])

    def receive(self) -> tuple[WorkerReply, bytes]:
        _, head, body = self._socket.recv_multipart()
        return WorkerReply.model_validate_json(head), body

    def ask(self, request: FeedRequest, content: bytes | None = None) -> tuple[WorkerReply, bytes]:
        self.send(request, content)
        return self.receive()

    def close(self) -> None:
        self._socket.close()
        self._context.term()
