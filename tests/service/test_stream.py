"""/stream: the newest view that was asked for, no more than a viewer takes, and nothing for who may not see it."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from contract.access.keys import DEFAULT_SCOPES, KeyFile, KeyScope
from contract.wire.rendering import ExportRequest, RenderRequest
from intrasplat.picture import Highlights, Unseen
from tests.reports import a_warning
from tests.service.live import LiveService, live_service
from tests.service.under_test import CAMERA
from worker.reply import NotYetError, Reply

TIMEOUT_S = 10.0
LARGE = 4 * 2**20


class Painter:
    """A worker that waits to be let go, if it is held, and notes what it was asked."""

    def __init__(self) -> None:
        self.asked: list[float] = []
        self.highlights: list[Highlights] = []
        self.go_on = threading.Event()
        self.go_on.set()
        self.began = threading.Event()
        self.bytes = 100

    def answer(self, request: RenderRequest | ExportRequest) -> Reply:
        self.asked.append(request.t)
        self.began.set()
        assert self.go_on.wait(TIMEOUT_S)
        if request.t == 500:
            raise NotYetError("Nothing to show yet.")
        if request.t == 600:
            raise RuntimeError("patient Smith")
        if isinstance(request, RenderRequest):
            self.highlights.append(request.highlights)
        iteration = 7 if request.attempt is None else None
        unseen = 0.0 if isinstance(request, ExportRequest) or request.unseen is Unseen.GUESS else 0.12345
        return Reply(b"\xff" * self.bytes, "image/jpeg", request.t, (LOOK_OUT,), iteration, unseen, camera=CAMERA)


LOOK_OUT = a_warning("look out")


@pytest.fixture
def painter() -> Painter:
    return Painter()


@pytest.fixture
def service(tmp_path: Path, painter: Painter) -> Iterator[LiveService]:
    with live_service(tmp_path, painter.answer) as service:
        yield service


@contextmanager
def viewing(service: LiveService, **arguments: Any) -> Iterator[ClientConnection]:
    with connect(f"ws://127.0.0.1:{service.port}/stream", compression=None, **arguments) as viewer:
        yield viewer


def view(viewer: ClientConnection) -> tuple[dict[str, Any], bytes]:
    """The head and the image of the next message, which is a view."""
    message = viewer.recv(timeout=TIMEOUT_S)
    assert isinstance(message, bytes), message
    length = int.from_bytes(message[:4], "big")
    return json.loads(message[4 : 4 + length]), message[4 + length :]


def problem(viewer: ClientConnection) -> dict[str, Any]:
    """The next message, which is a problem document."""
    message = viewer.recv(timeout=TIMEOUT_S)
    assert isinstance(message, str)
    document: dict[str, Any] = json.loads(message)
    return document


def ask(viewer: ClientConnection, **query: Any) -> None:
    viewer.send(json.dumps(query))


def test_one_connection_shows_a_finished_scene_and_a_running_job(service: LiveService) -> None:
    scene = service.finished_scene()
    job_id = service.running_job().job_id
    with viewing(service) as viewer:
        ask(viewer, scene=scene, t=0.5, pose="orbit:1,2,1", format="jpeg", quality=80, id="a")
        head, image = view(viewer)
        assert image == b"\xff" * 100
        assert head.pop("render_ms") <= head.pop("total_ms")
        assert head == {
            "id": "a",
            "scene": scene,
            "state": "done",
            "t": 0.5,
            "iteration": None,
            "unseen": 0.123,
            "detail": 0.0,
            "warnings": [LOOK_OUT.model_dump()],
            "media_type": "image/jpeg",
            "depth_range_mm": None,
            "camera": CAMERA.model_dump(mode="json"),
        }
        ask(viewer, scene=scene, unseen="guess")
        assert view(viewer)[0]["unseen"] == 0
        ask(viewer, scene=job_id, id=2)
        head, _ = view(viewer)
        assert (head["id"], head["scene"], head["state"], head["iteration"]) == (2, job_id, "running", 7)


def test_that_a_scene_is_there_is_told_without_a_view_of_it(service: LiveService, painter: Painter) -> None:
    scene = service.finished_scene()
    job_id = service.running_job().job_id
    with viewing(service) as viewer:
        for each, state in ((scene, "done"), (job_id, "running")):
            ask(viewer, scene=each, confirm=True, id=3)
            assert json.loads(viewer.recv(timeout=TIMEOUT_S)) == {"id": 3, "state": state}
        service.store.purge(scene)
        ask(viewer, scene=scene, confirm=True, id=4)
        document = problem(viewer)
        assert (document["status"], document["id"]) == (404, 4)
    assert painter.asked == []


def test_a_stream_asks_for_views_with_and_without_highlights(service: LiveService, painter: Painter) -> None:
    scene = service.finished_scene()
    with viewing(service) as viewer:
        for highlights in ("off", "on"):
            ask(viewer, scene=scene, highlights=highlights)
            view(viewer)
        ask(viewer, scene=scene)
        view(viewer)
    assert painter.highlights == [Highlights.OFF, Highlights.ON, Highlights.ON]


def test_while_one_view_is_made_only_the_newest_request_waits(service: LiveService, painter: Painter) -> None:
    scene = service.finished_scene()
    painter.go_on.clear()
    with viewing(service) as viewer:
        ask(viewer, scene=scene, t=0)
        assert painter.began.wait(TIMEOUT_S)
        for number in range(1, 200):
            ask(viewer, scene=scene, t=number)
        viewer.ping().wait(TIMEOUT_S)  # the service has read them all
        painter.go_on.set()
        assert [view(viewer)[0]["t"] for _ in range(2)] == [0, 199]
    assert painter.asked == [0, 199]


def test_a_viewer_that_does_not_read_is_not_rendered_for(service: LiveService, painter: Painter) -> None:
    scene = service.finished_scene()
    painter.bytes = LARGE
    with viewing(service, max_queue=1, max_size=None) as viewer:
        for number in range(200):
            ask(viewer, scene=scene, t=number)
            painter.began.wait(0.005)
        with viewing(service, max_size=None) as other:  # others are served meanwhile
            ask(other, scene=scene, t=1000)
            assert view(other)[0]["t"] == 1000
        assert len(painter.asked) < 10
        while view(viewer)[0]["t"] != 199:
            pass


def test_what_cannot_be_shown_is_told_with_its_id_and_the_connection_goes_on(service: LiveService) -> None:
    scene = service.finished_scene()
    with viewing(service) as viewer:
        for query, status, field in (
            ({"scene": scene, "t": -1}, 422, "t"),
            ({"scene": scene, "pose": "1,2"}, 422, "pose"),
            ({"scene": scene, "zoom": 2}, 422, "zoom"),
            ({"scene": "0" * 32}, 404, "scene"),
            ({"scene": scene, "t": 500}, 503, "scene"),
        ):
            ask(viewer, id="x", **query)
            told = problem(viewer)
            assert (told["status"], told["field"], told["id"]) == (status, field, "x")
            assert told["detail"]
            assert (told["detail"] == "There is no such parameter here.") == (field == "zoom")
        ask(viewer, scene=scene, t=600)
        told = problem(viewer)
        assert told["status"] == 500
        assert "Smith" not in told["detail"]
        for text in ("", "{", "[]", '"t"', "[" * 5000, '{"t": NaN}'):
            viewer.send(text)
            assert problem(viewer)["status"] in (400, 422)
        ask(viewer, scene=scene)
        assert view(viewer)[0]["scene"] == scene


@pytest.mark.parametrize(
    "text", ['{"id": "\\ud800"}', '{"id": ' + "[" * 5000 + "]" * 5000 + "}", '{"t": ' + "9" * 5000 + "}"]
)
def test_json_that_is_built_to_trip_its_reader_is_told_to_be_none(service: LiveService, text: str) -> None:
    service.finished_scene()
    with viewing(service) as viewer:
        viewer.send(text)
        assert problem(viewer)["status"] in (400, 422)
        ask(viewer, id="next")
        assert view(viewer)[0]["id"] == "next"


def test_the_scene_may_be_left_out_while_there_is_exactly_one(service: LiveService) -> None:
    with viewing(service) as viewer:
        ask(viewer)
        assert problem(viewer)["status"] == 400
        scene = service.finished_scene()
        ask(viewer)
        assert view(viewer)[0]["scene"] == scene


def test_a_purged_scene_is_shown_no_more(service: LiveService) -> None:
    scene = service.finished_scene()
    with viewing(service) as viewer:
        ask(viewer, scene=scene)
        view(viewer)
        service.store.purge(scene)
        ask(viewer, scene=scene)
        assert problem(viewer)["status"] == 404


@pytest.mark.parametrize("path", ["/stream", f"/feeds/{'0' * 32}/pictures"])
def test_parameters_in_the_address_are_refused_before_the_handshake(service: LiveService, path: str) -> None:
    with pytest.raises(InvalidStatus) as refused, connect(f"ws://127.0.0.1:{service.port}{path}?scene=x"):
        pass
    told = json.loads(refused.value.response.body)
    assert (told["status"], told["field"]) == (422, "scene")
    assert "docs/stream.md" in told["remedy"]


@pytest.mark.parametrize(("message", "code"), [(b"\x00", 1003), ("x" * 20_000, 1009), ("x" * 200_000, 1009)])
def test_what_is_no_request_at_all_ends_the_connection(service: LiveService, message: str | bytes, code: int) -> None:
    with viewing(service) as viewer:
        viewer.send(message)
        with contextlib.suppress(ConnectionClosed):
            assert problem(viewer)["status"] in (413, 422)  # of what uvicorn itself refuses there is none
            viewer.recv(timeout=TIMEOUT_S)
    assert viewer.close_code == code


@pytest.fixture
def guarded(tmp_path: Path, painter: Painter) -> Iterator[LiveService]:
    """A service that asks for keys."""
    with live_service(tmp_path, painter.answer, hosts=("elsewhere.example",)) as service:
        yield service


def key(service: LiveService, tenant: str = "ward-3", scopes: frozenset[KeyScope] = DEFAULT_SCOPES) -> str:
    return KeyFile(service.store.data_dir).create(tenant, scopes)[1]


def bearer(text: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {text}"}


def test_a_key_opens_the_scenes_of_its_tenant_alone(guarded: LiveService) -> None:
    own, other = guarded.finished_scene("ward-3"), guarded.finished_scene("ward-4")
    with viewing(guarded, additional_headers=bearer(key(guarded))) as viewer:
        ask(viewer)
        assert view(viewer)[0]["scene"] == own
        ask(viewer, scene=other)
        foreign = problem(viewer)
        ask(viewer, scene="0" * 32)
        assert foreign | {"detail": ""} == problem(viewer) | {"detail": ""}
        assert foreign["status"] == 404


def test_a_browser_sends_its_key_first(guarded: LiveService) -> None:
    own = guarded.finished_scene("ward-3")
    with viewing(guarded) as viewer:
        ask(viewer, authorize=key(guarded))
        ask(viewer, scene=own)
        assert view(viewer)[0]["scene"] == own


@pytest.mark.parametrize("first", ['{"scene": "x"}', '{"authorize": "isp_0_0"}', '{"authorize": 1}', "{", ""])
def test_who_does_not_is_shown_out(guarded: LiveService, first: str) -> None:
    with viewing(guarded) as viewer:
        viewer.send(first)
        assert problem(viewer)["status"] == 401
        with pytest.raises(ConnectionClosed) as closed:
            viewer.recv(timeout=TIMEOUT_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008


def test_who_sends_no_key_at_all_is_shown_out_too(guarded: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.sockets.AUTHORIZE_TIMEOUT_S", 0.1)
    with viewing(guarded) as viewer:
        assert problem(viewer)["status"] == 401


def test_strangers_hold_few_places_and_none_of_those_with_keys(
    guarded: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.access.MAX_STRANGERS", 1)
    own = guarded.finished_scene("ward-3")
    with viewing(guarded) as stranger:
        with pytest.raises(InvalidStatus) as refused, viewing(guarded):
            pass
        assert refused.value.response.status_code == 503
        with viewing(guarded, additional_headers=bearer(key(guarded))) as known:
            ask(known, scene=own)
            assert view(known)[0]["scene"] == own
        ask(stranger, authorize=key(guarded))
        ask(stranger, scene=own)
        assert view(stranger)[0]["scene"] == own
        with viewing(guarded):  # there is a place again
            pass


def test_a_wrong_key_or_one_that_may_not_see_is_refused_before_the_handshake(guarded: LiveService) -> None:
    blind = key(guarded, scopes=frozenset({KeyScope.RECONSTRUCT}))
    for text, status in (("isp_0_0", 401), (blind, 403)):
        with pytest.raises(InvalidStatus) as refused, viewing(guarded, additional_headers=bearer(text)):
            pass
        assert refused.value.response.status_code == status


def rotate_at_once(keys: KeyFile, key_id: str) -> None:
    keys.rotate(key_id, keys.successor(key_id)[0], time.time())


@pytest.mark.parametrize("end", [KeyFile.revoke, rotate_at_once])
def test_a_key_that_is_revoked_or_expires_ends_its_streams(
    guarded: LiveService, end: Callable[[KeyFile, str], object]
) -> None:
    own, text = guarded.finished_scene("ward-3"), key(guarded)
    with viewing(guarded, additional_headers=bearer(text)) as viewer:
        ask(viewer, scene=own)
        view(viewer)
        end(KeyFile(guarded.store.data_dir), text.split("_")[1])
        ask(viewer, scene=own)
        assert problem(viewer)["status"] == 401
        with pytest.raises(ConnectionClosed):
            viewer.recv(timeout=TIMEOUT_S)


def test_what_a_viewer_sees_is_in_the_audit(guarded: LiveService) -> None:
    own = guarded.finished_scene("ward-3")
    with viewing(guarded, additional_headers=bearer(key(guarded))) as viewer:
        ask(viewer, scene=own)
        view(viewer)
    assert f'"job_id":"{own}"' in (guarded.store.data_dir / "audit.jsonl").read_text().replace(" ", "")


def test_the_example_of_the_document_shows_views(
    service: LiveService, painter: Painter, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[2] / "docs/stream.md").read_text(encoding="utf-8")
    example = page.split("```python\n")[1].split("```")[0]
    exec(example.replace("8765", str(service.port)).replace("JOB", service.finished_scene()), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines == [f"{yaw} image/jpeg {painter.bytes} bytes" for yaw in range(-10, 11)]
