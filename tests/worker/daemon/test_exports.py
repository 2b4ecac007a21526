"""An export format from outside needs one line to register, and is then served like the program's own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from contract.queue.embedded import short_socket_path
from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.rendering import ExportRequest, WorkerRequest
from tests.worker.daemon.test_serve import ask, connected
from tests.worker.scenes import random_scene
from worker.daemon.serve import RequestServer
from worker.daemon.views import Views
from worker.scene.checkpoint import save_scene
from worker.scene.export import EXPORTS, ExportFormat
from worker.scene.scene import Scene

GAUSSIANS = 11


def points_as_text(scene: Scene, t: float) -> bytes:
    """A toy format: one line of x, y and z for each Gaussian."""
    mean = scene.deformation.deform(scene.gaussians, t).mean / scene.units_per_mm
    return "".join("{:.3f} {:.3f} {:.3f}\n".format(*row) for row in mean.tolist()).encode()


@pytest.fixture
def scene_id(tmp_path: Path) -> str:
    store, job_id = Store(tmp_path), new_job_id()
    save_scene(store.work_folder(job_id, 1), random_scene(count=GAUSSIANS))
    store.publish_scene(job_id, 1)
    return job_id


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[zmq.Socket[bytes]]:
    endpoint = f"ipc://{short_socket_path(tmp_path, 'worker.sock')}"
    with RequestServer(endpoint, Views(Store(tmp_path)).answer), connected(endpoint) as socket:
        yield socket


def wire(scene_id: str, format: str) -> bytes:
    request = ExportRequest(scene_id=scene_id, attempt=1, t=0.5, format=format)
    return WorkerRequest(request=request).model_dump_json().encode()


def test_a_format_from_outside_is_exported(
    monkeypatch: pytest.MonkeyPatch, worker: zmq.Socket[bytes], scene_id: str
) -> None:
    monkeypatch.setitem(EXPORTS, "xyz", ExportFormat("text/plain", points_as_text))
    head, body = ask(worker, wire(scene_id, "xyz"))
    assert (head.error, head.media_type, head.t) == (None, "text/plain", 0.5)
    assert body == points_as_text(random_scene(count=GAUSSIANS), 0.5)
    assert ask(worker, wire(scene_id, "ply"))[1].startswith(b"ply\n")


def test_a_format_that_is_not_registered_is_refused(worker: zmq.Socket[bytes], scene_id: str) -> None:
    head, body = ask(worker, wire(scene_id, "xyz"))
    assert head.error is not None
    remedy = f"Use one of: {', '.join(EXPORTS)}."
    assert (head.error.kind, head.error.field, head.error.remedy, body) == ("input", "format", remedy, b"")
