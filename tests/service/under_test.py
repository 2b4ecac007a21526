"""A running service for the tests: real queue, store and ZeroMQ connection; only the image is painted."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from contract.access.keys import DEFAULT_SCOPES, KeyFile, KeyScope
from contract.queue.embedded import short_socket_path
from contract.queue.interface import Claim, Queue
from contract.runtime.settings import Settings
from contract.store.store import Store
from contract.wire.cameras import CamerasRequest
from contract.wire.job import JobRecord
from contract.wire.rendering import (
    ExportRequest,
    MeasureRequest,
    PictureCamera,
    RecordedRequest,
    SceneRequest,
    WorkerAddress,
)
from intrasplat.errors import InputError, SceneError
from intrasplat.names import CURVE, MANIFEST, REPORT
from intrasplat.notices import Notice, NoticeCode
from intrasplat.picture import ImageFormat, Layer
from service.__main__ import KNOWN_WORKERS
from service.app import create_app
from service.renderer import ZmqRenderer
from tests.answers import at_once
from tests.cameras import cameras_reply
from tests.measurements import measurement_reply
from tests.memory_queue import MemoryQueue
from tests.reports import REPORT_OF_A_SCENE, a_warning
from tests.service.asgi import AsgiClient, serving
from worker.reply import Reply
from worker.serve import RequestServer

CLIP = (Path(__file__).resolve().parents[1] / "data" / "stereo_sbs_h264.mp4").read_bytes()
EMPTY_ZIP = b"PK\x05\x06" + bytes(18)
IDENTITY = "1,0,0,0,0,1,0,0,0,0,1,0"


UNSEEN_SHARE = 0.06251
DEPTH_RANGE_MM = (41.0, 78.0)
COARSE_WIDTH = 11
CAMERA = PictureCamera(width=64, height=48, fx=80, fy=81, cx=31.5, cy=24.25, world_from_camera=tuple(range(12)))
AFTER_THE_END = a_warning("t is after the last frame", NoticeCode.TIME_OUTSIDE_CLIP)


def another_clip(mark: bytes) -> bytes:
    """A clip with other bytes and the same pictures."""
    return CLIP + (8 + len(mark)).to_bytes(4, "big") + b"free" + mark


class Painter:
    """Answers like a worker and remembers what it was asked."""

    def __init__(self) -> None:
        self.requests: list[SceneRequest] = []

    def answer(self, request: SceneRequest) -> Reply:
        self.requests.append(request)
        if isinstance(request, CamerasRequest):
            return cameras_reply(request)
        if isinstance(request, MeasureRequest):
            return measurement_reply(request)
        if isinstance(request, ExportRequest):
            return Reply(b"ply\n", "application/octet-stream", request.options.t or 0.0)
        if isinstance(request, RecordedRequest):
            return Reply(b"jpeg", "image/jpeg", 0.25, iteration=7 if request.attempt is None else None)
        if request.camera.width == 8:
            raise InputError("width", "8 is too narrow.", "Use more.")
        if request.camera.width == 9:
            raise SceneError("The scene is damaged.")
        if request.camera.width == 10:
            raise RuntimeError("patient Smith")
        coarse = (Notice.info(NoticeCode.COARSE, "half"),) if request.camera.width == COARSE_WIDTH else ()
        late = (AFTER_THE_END, a_warning("ansicht – geschätzt")) if request.t > 1 else ()
        iteration = 7 if request.attempt is None else None
        media_type, shown_t = f"image/{request.format.value}", min(request.t, 1.0)
        range_mm = DEPTH_RANGE_MM if request.layer is Layer.DEPTH and request.format is ImageFormat.JPEG else None
        return Reply(
            request.format.value.encode(),
            media_type,
            shown_t,
            coarse + late,
            iteration,
            UNSEEN_SHARE,
            depth_range_mm=range_mm,
            camera=CAMERA,
        )


@dataclass
class ServiceUnderTest:
    """A running service and what it stands on."""

    http: AsgiClient
    queue: Queue
    store: Store
    painter: Painter

    def upload(
        self,
        options: str = "{}",
        parts: Mapping[str, tuple[str, bytes]] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        files = parts or {"clip": ("a.mp4", CLIP)}
        return self.http.post("/reconstruct", files=files, data={"options": options}, headers=headers)

    def claimed(self) -> tuple[JobRecord, Claim]:
        record = self.queue.claim("worker-1", 0.0)
        assert record is not None
        return record, Claim(record.job_id, record.attempt, "worker-1")

    def finished_scene(self, headers: Mapping[str, str] | None = None) -> str:
        assert self.upload(headers=headers).status_code == 202
        record, claim = self.claimed()
        folder = self.store.work_folder(record.job_id, record.attempt)
        (folder / MANIFEST).write_text("{}")
        (folder / REPORT).write_text(REPORT_OF_A_SCENE.model_dump_json())
        (folder / CURVE).write_text("t_train_s,psnr_tissue_db\n1,30\n")
        self.store.publish_scene(record.job_id, record.attempt)
        assert self.queue.finish(claim)
        return record.job_id

    def running_job(self, headers: Mapping[str, str] | None = None) -> str:
        """A job that worker-1 runs, and says so."""
        assert self.upload(headers=headers).status_code == 202
        record, _ = self.claimed()
        (address,) = self.queue.workers()
        self.queue.announce(address.model_copy(update={"job_id": record.job_id}))
        return record.job_id

    def spooled(self) -> list[Path]:
        return [path for area in ("incoming", "spool") for path in (self.store.data_dir / area).iterdir()]


def running_service(data_dir: Path, queue: Queue | None = None, **changes: Any) -> Iterator[ServiceUnderTest]:
    queue, store, painter = queue or MemoryQueue(), Store(data_dir), Painter()
    settings = Settings(data_dir=data_dir, render_timeout_s=5.0, min_free_bytes=0).model_copy(update=changes)
    known = store.run_dir / KNOWN_WORKERS
    app = create_app(settings, queue, store, ZmqRenderer(queue, settings.render_timeout_s, known=known))
    endpoint = f"ipc://{short_socket_path(store.run_dir, 'worker-1.sock')}"
    with (
        RequestServer(endpoint, at_once(painter.answer)),
        serving(app, "http://127.0.0.1:8765") as http,
    ):
        queue.announce(WorkerAddress(name="worker-1", endpoint=endpoint, device="cpu"))
        yield ServiceUnderTest(http, queue, store, painter)


def assert_problem(response: httpx.Response, status: int, field: str | None = None) -> dict[str, Any]:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = response.json()
    assert problem["status"] == status
    assert problem["detail"]
    assert problem["remedy"]
    assert problem.get("field") == field
    return problem


def bearer(service: ServiceUnderTest, tenant: str, scopes: Collection[KeyScope] = DEFAULT_SCOPES) -> dict[str, str]:
    """The headers of a tenant with a new key."""
    _, text = KeyFile(service.store.data_dir).create(tenant, scopes)
    return {"Authorization": f"Bearer {text}"}
