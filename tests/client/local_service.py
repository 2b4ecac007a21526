"""A service on a real port for the client's tests, and a line to it that can be cut."""

from __future__ import annotations

import asyncio
import contextlib
import io
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from contract.queue.embedded import short_socket_path
from contract.queue.interface import Claim
from contract.queue.memory import MemoryQueue
from contract.runtime.settings import Settings
from contract.store.store import Store
from contract.wire.cameras import CamerasRequest
from contract.wire.job import JobError
from contract.wire.names import CURVE, MANIFEST, REPORT
from contract.wire.rendering import (
    MEDIA_TYPES,
    ExportRequest,
    Highlights,
    MeasureRequest,
    RecordedRequest,
    SceneRequest,
    Unseen,
    WorkerAddress,
)
from service.app import create_app
from service.renderer import ZmqRenderer
from service.server import Server
from tests.answers import at_once
from tests.cameras import cameras_reply
from tests.measurements import measurement_reply
from tests.reports import REPORT_OF_A_SCENE, a_warning
from worker.daemon.reply import Reply
from worker.daemon.serve import RequestServer

CLIP = Path(__file__).resolve().parents[1] / "data" / "stereo_sbs_h264.mp4"
SNAPSHOT_ITERATION = 7


def paint(request: SceneRequest) -> Reply:
    """A 4 x 6 depth map that holds t everywhere, -t without highlights.

    A quarter of it is unseen, unless guesses are asked for.
    """
    if isinstance(request, CamerasRequest):
        return cameras_reply(request)
    if isinstance(request, MeasureRequest):
        return measurement_reply(request)
    if isinstance(request, ExportRequest):
        return Reply(b"ply\n", "application/octet-stream", request.options.t or 0.0)
    if isinstance(request, RecordedRequest):
        return Reply(b"jpeg", "image/jpeg", request.t)
    buffer = io.BytesIO()
    shown = request.t if request.highlights is Highlights.ON else -request.t
    np.save(buffer, np.full((4, 6), shown, np.float32))
    iteration = SNAPSHOT_ITERATION if request.attempt is None else None
    unseen, warnings = 0.25 if request.unseen is Unseen.MARK else 0.0, (a_warning("seen from afar"),)
    return Reply(buffer.getvalue(), MEDIA_TYPES[request.format], request.t, warnings, iteration, unseen)


class LocalService:
    """The service, and the queue and store behind it."""

    def __init__(self, data_dir: Path, **changes: Any) -> None:
        self.queue, self.store = MemoryQueue(), Store(data_dir)
        self.endpoint = f"ipc://{short_socket_path(self.store.run_dir, 'worker-1.sock')}"
        settings = Settings(data_dir=data_dir, min_free_bytes=0).model_copy(update=changes)
        app = create_app(settings, self.queue, self.store, ZmqRenderer(self.queue, 5.0))
        self._server = Server(app, settings)
        self._server.config.port = 0
        self._thread = threading.Thread(target=lambda: asyncio.run(self._server.serve()))
        self._thread.start()
        while not self._server.started:
            time.sleep(0.01)
        self.port: int = self._server.servers[0].sockets[0].getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"

    def stop(self) -> None:
        self._server.should_exit = True
        self._thread.join()

    def announce(self, job_id: str | None = None) -> None:
        """Say that the worker is there, and what it runs."""
        self.queue.announce(WorkerAddress(name="worker-1", endpoint=self.endpoint, device="cpu", job_id=job_id))

    def claim(self) -> Claim:
        record = self.queue.claim("worker-1", 5.0)
        assert record is not None
        self.announce(record.job_id)
        return Claim(record.job_id, record.attempt, "worker-1")

    def finish(self, claim: Claim | None = None, *, scored: bool = True) -> None:
        claim = claim or self.claim()
        report = REPORT_OF_A_SCENE if scored else REPORT_OF_A_SCENE.model_copy(update={"scored": False})
        folder = self.store.work_folder(claim.job_id, claim.attempt)
        (folder / MANIFEST).write_text('{"files": {}}')
        (folder / REPORT).write_text(report.model_dump_json())
        (folder / CURVE).write_text("t_train_s,psnr_tissue_db,psnr_right_db\n1,30,\n")
        self.store.publish_scene(claim.job_id, claim.attempt)
        assert self.queue.finish(claim)

    def fail(self, error: JobError) -> None:
        assert self.queue.fail(self.claim(), error)


@contextmanager
def local_service(data_dir: Path, **changes: Any) -> Iterator[LocalService]:
    service = LocalService(data_dir, **changes)
    try:
        with RequestServer(service.endpoint, at_once(paint)):
            service.announce()
            yield service
    finally:
        service.stop()


class Line:
    """A TCP line to a port, as through a proxy; cut() ends all connections that are open, new ones are put through."""

    def __init__(self, port: int) -> None:
        self._target = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = []
        self.connections = 0
        self.bytes = 0
        """Sent through it, both ways."""
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def open_connections(self) -> int:
        return sum(end.fileno() >= 0 for end in self._open) // 2

    def cut(self) -> None:
        cut, self._open = self._open, []
        for end in cut:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._target)
                self.connections += 1
                self._open += [near, far]
                threading.Thread(target=self._put_through, args=(near, far), daemon=True).start()

    def _put_through(self, near: socket.socket, far: socket.socket) -> None:
        with near, far:
            back = threading.Thread(target=self._forward, args=(far, near), daemon=True)
            back.start()
            self._forward(near, far)
            back.join()

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while piece := source.recv(65536):
                self.bytes += len(piece)
                target.sendall(piece)
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


@contextmanager
def line_to(service: LocalService) -> Iterator[Line]:
    line = Line(service.port)
    try:
        yield line
    finally:
        line.close()
