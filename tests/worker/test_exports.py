"""Exports over the wire: a format from outside needs one line to register, and parts end when nobody may have them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from contract.queue.embedded import short_socket_path
from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.rendering import ExportRequest, WorkerReply, WorkerRequest
from intrasplat.errors import SceneError, UnavailableError
from intrasplat.export import EXPORTS, export_parts
from intrasplat.export.target import ExportTarget
from intrasplat.scene.checkpoint import save_scene
from tests.answers import at_once
from tests.intrasplat.scenes import random_scene
from tests.worker.exports import export_request, exported
from tests.worker.test_serve import ask, connected
from worker import exports
from worker.exports import IDLE_S, MAX_OPEN, OpenExports
from worker.serve import RequestServer
from worker.views import Views

GAUSSIANS = 11


def points_as_text(target: ExportTarget) -> Iterator[bytes]:
    """A toy format: one line of x, y and z for each Gaussian."""
    mean = target.scene.deformation.deform(target.scene.gaussians, target.t).mean / target.scene.units_per_mm
    yield "".join("{:.3f} {:.3f} {:.3f}\n".format(*row) for row in mean.tolist()).encode()


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


@pytest.fixture
def scene_id(store: Store) -> str:
    job_id = new_job_id()
    save_scene(store.work_folder(job_id, 1), random_scene(count=GAUSSIANS))
    store.publish_scene(job_id, 1)
    return job_id


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[zmq.Socket[bytes]]:
    endpoint = f"ipc://{short_socket_path(tmp_path, 'worker.sock')}"
    with RequestServer(endpoint, at_once(Views(Store(tmp_path)).answer)), connected(endpoint) as socket:
        yield socket


def sent(worker: zmq.Socket[bytes], request: ExportRequest) -> tuple[WorkerReply, bytes]:
    return ask(worker, WorkerRequest(request=request).model_dump_json().encode())


def next_of(request: ExportRequest) -> ExportRequest:
    return request.model_copy(update={"part": request.part + 1})


def test_a_format_from_outside_is_exported(
    monkeypatch: pytest.MonkeyPatch, worker: zmq.Socket[bytes], scene_id: str
) -> None:
    monkeypatch.setitem(EXPORTS, "xyz", points_as_text)
    request = export_request(scene_id, t=0.5).model_copy(update={"format": "xyz"})
    head, body = sent(worker, request)
    assert (head.error, head.more, head.t) == (None, True, 0.5)
    assert body == b"".join(export_parts(random_scene(count=GAUSSIANS), "xyz", request.options))
    assert body.count(b"\n") == GAUSSIANS
    head, body = sent(worker, next_of(request))
    assert (head.error, head.more, body) == (None, False, b"")


def test_a_format_that_is_not_registered_is_refused(worker: zmq.Socket[bytes], scene_id: str) -> None:
    head, body = sent(worker, export_request(scene_id).model_copy(update={"format": "xyz"}))
    assert head.error is not None
    remedy = f"Use one of: {', '.join(EXPORTS)}."
    assert (head.error.kind, head.error.field, head.error.remedy, body) == ("input", "format", remedy, b"")


def test_two_exports_under_way_do_not_mix(store: Store, scene_id: str) -> None:
    views = Views(store)
    alone = exported(views.answer, export_request(scene_id, "ply-zip"))[1]
    requests = [export_request(scene_id, "ply-zip"), export_request(scene_id, "ply-zip", every=2)]
    contents, open_ones = {each.export_id: b"" for each in requests}, list(requests)
    while open_ones:
        request = open_ones.pop(0)
        reply = views.answer(request)
        contents[request.export_id] += reply.body
        if reply.more:
            open_ones.append(next_of(request))
    assert contents[requests[0].export_id] == alone
    assert 0 < len(contents[requests[1].export_id]) < len(alone)


def test_an_export_ends_when_its_scene_is_purged(store: Store, scene_id: str) -> None:
    views, request = Views(store), export_request(scene_id, "ply-zip")
    assert views.answer(request).more
    store.purge(scene_id)
    with pytest.raises(SceneError):
        views.answer(next_of(request))
    views.forget_purged()
    assert views._exports._open == {}


def test_parts_come_in_order_and_once(store: Store, scene_id: str) -> None:
    views, request = Views(store), export_request(scene_id, "ply-zip")
    with pytest.raises(SceneError, match="has ended"):
        views.answer(next_of(request))
    views.answer(request)
    with pytest.raises(SceneError, match="has ended"):
        views.answer(next_of(next_of(request)))


def test_exports_that_nobody_asks_for_any_more_make_room(
    monkeypatch: pytest.MonkeyPatch, store: Store, scene_id: str
) -> None:
    now_s = 0.0
    monkeypatch.setattr(exports, "MAX_OPEN", 2)
    under_way, closed = OpenExports(lambda: now_s), []

    def parts() -> Iterator[bytes]:
        try:
            while True:
                yield b"part"
        finally:
            closed.append(True)

    requests = [export_request(scene_id) for _ in range(3)]
    for request in requests[:2]:
        assert under_way.part(request, parts) == (b"part", True)
    with pytest.raises(UnavailableError):
        under_way.part(requests[2], parts)
    now_s = IDLE_S / 2
    under_way.part(next_of(requests[0]), parts)
    now_s = IDLE_S + 1
    assert under_way.part(requests[2], parts) == (b"part", True)
    assert len(closed) == 1
    assert MAX_OPEN > 2
