"""GET /scenes/{id}/export: what is asked of the worker, what is refused before it, and what a long file is like."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import pytest

from contract.wire.labels import LabelChange
from contract.wire.rendering import ExportRequest, SceneRequest
from intrasplat.errors import InputError, UnavailableError
from intrasplat.formats import EXPORT_FORMATS
from service import exports
from service.renderer import ADDRESSES_VALID_S
from tests.service.live import live_service
from tests.service.under_test import ServiceUnderTest, assert_problem
from worker.reply import Reply

PARTS = 5


class Exporter:
    """A worker whose exports have PARTS parts; `fault` happens at the part of that number."""

    def __init__(self) -> None:
        self.asked: list[ExportRequest] = []
        self.empty = 0
        self.fault: tuple[int, Exception] | None = None

    def answer(self, request: SceneRequest) -> Reply:
        assert isinstance(request, ExportRequest)
        self.asked.append(request)
        if self.fault is not None and request.part == self.fault[0]:
            raise self.fault[1]
        if request.part < self.empty:
            return Reply(b"", "video/webm", 0.0, more=True)
        content = bytes([request.part]) * 1000 if request.part < PARTS else b""
        return Reply(content, "video/webm", 0.0, more=request.part < PARTS)


@pytest.mark.parametrize("name", [name for name, each in EXPORT_FORMATS.items() if not each.is_stored])
def test_every_format_has_its_file_name(service: ServiceUnderTest, name: str) -> None:
    scene = service.finished_scene()
    answer = service.http.get(f"/scenes/{scene}/export", params={"format": name})
    assert answer.status_code == 200
    named = rf'attachment; filename="scene-\d{{4}}-\d\d-\d\d-{scene[:8]}{EXPORT_FORMATS[name].suffix}"'
    assert re.fullmatch(named, answer.headers["content-disposition"])
    asked = service.painter.requests[-1]
    assert isinstance(asked, ExportRequest)
    assert (asked.format, asked.part, asked.options.given()) == (name, 0, {})


def test_files_are_named_after_the_scene_in_any_script(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    service.queue.relabel(scene, LabelChange(label='../Läsion "3" 肝臓'))
    (offer,) = (each for each in service.http.get(f"/scenes/{scene}/exports").json() if each["format"] == "mesh-stl")
    assert offer["file_name"] == "Läsion_3_肝臓-mesh.stl"
    saved_as = service.http.get(f"/scenes/{scene}/export?format=mesh-stl").headers["content-disposition"]
    assert saved_as == f"attachment; filename=\"Lasion_3_-mesh.stl\"; filename*=UTF-8''{quote(offer['file_name'])}"


def test_formats_that_no_worker_can_make_are_listed_and_refused_with_the_extra(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    assert {each["needs"] for each in service.http.get(f"/scenes/{scene}/exports").json()} == {None}
    (able,) = service.queue.workers()
    service.queue.announce(able.model_copy(update={"missing_extras": ("mesh",)}))
    offers = newest_offers(service, scene)
    assert {name for name, each in offers.items() if each["needs"]} == {"mesh-stl", "mesh-ply", "mesh-glb"}
    assert offers["mesh-glb"]["needs"] == "intrasplat[mesh]"
    assert offers["mp4"]["views"] == ["endoscope", "orbit", "rock"]  # the other eye of this scene is not known
    refused = service.http.get(f"/scenes/{scene}/export?format=mesh-glb")
    problem = assert_problem(refused, 501, "format")
    assert (problem["code"], service.painter.requests) == ("missing_extra", [])
    assert "intrasplat[mesh]" in problem["remedy"]
    assert service.http.get(f"/scenes/{scene}/export?format=ply").status_code == 200
    service.queue.announce(able.model_copy(update={"name": "able"}))
    assert not newest_offers(service, scene)["mesh-glb"]["needs"]
    assert service.http.get(f"/scenes/{scene}/export?format=mesh-glb").status_code == 200


def newest_offers(service: ServiceUnderTest, scene: str) -> dict[str, Any]:
    """By format, once the service has read the workers anew."""
    for pause_s in (ADDRESSES_VALID_S, 0.1):  # the first request begins to read
        time.sleep(pause_s)
        answer = service.http.get(f"/scenes/{scene}/exports")
    return {each["format"]: each for each in answer.json()}


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ({"format": "splatz"}, "format"),
        ({"format": "ply", "every": 2}, "every"),
        ({"format": "depth", "t": 0.5}, "t"),
        ({"format": "ply", "t": -1}, "t"),
        ({"format": "ply", "t": "nan"}, "t"),
        ({"format": "ply", "colour": "red"}, "colour"),
        ({"format": "depth", "every": "two"}, "every"),
        ({"format": "ply", "recorded": "off"}, "recorded"),
        ({"format": "html", "recorded": "some"}, "recorded"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_worker_is_asked(
    service: ServiceUnderTest, query: dict[str, object], field: str
) -> None:
    scene = service.finished_scene()
    assert_problem(service.http.get(f"/scenes/{scene}/export", params=query), 422, field)
    assert service.painter.requests == []


def test_a_scene_that_is_not_there_is_not_found(service: ServiceUnderTest) -> None:
    assert_problem(service.http.get(f"/scenes/{'0' * 32}/export"), 404, "scene")


@pytest.fixture
def exporter() -> Exporter:
    return Exporter()


@pytest.fixture
def address(tmp_path: Path, exporter: Exporter) -> Iterator[str]:
    """Of the export of a scene, over a real socket."""
    with live_service(tmp_path, lambda request: exporter.answer(request)) as service:
        yield f"http://127.0.0.1:{service.port}/scenes/{service.finished_scene()}/export?format=depth"


def test_a_long_file_is_sent_part_by_part(address: str, exporter: Exporter) -> None:
    exporter.empty = 3
    answer = httpx.get(address)
    assert answer.content == b"".join(bytes([part]) * 1000 for part in range(3, PARTS))
    assert "content-length" not in answer.headers
    assert answer.headers["content-disposition"].endswith('-depth.npy"')
    assert [each.part for each in exporter.asked] == list(range(PARTS + 1))
    assert len({each.export_id for each in exporter.asked}) == 1


def test_an_error_before_the_first_bytes_has_its_status(address: str, exporter: Exporter) -> None:
    exporter.empty, exporter.fault = 3, (2, InputError("every", "too much.", "Use every=2."))
    assert_problem(httpx.get(address), 422, "every")


def test_an_export_that_fails_later_is_cut_off(address: str, exporter: Exporter) -> None:
    exporter.fault = (3, RuntimeError("the disk is full"))
    with pytest.raises(httpx.RemoteProtocolError):
        httpx.get(address)


def test_an_export_ends_after_a_time(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exports, "MAX_EXPORT_S", 0.0)
    with pytest.raises(httpx.RemoteProtocolError):
        httpx.get(address)


def test_a_busy_worker_is_asked_again_for_the_next_part(address: str, exporter: Exporter) -> None:
    refused: list[int] = []
    answer = exporter.answer

    def once_busy(request: SceneRequest) -> Reply:
        assert isinstance(request, ExportRequest)
        if request.part == 2 and not refused:
            refused.append(request.part)
            raise UnavailableError("Too many.", "Ask again.")
        return answer(request)

    exporter.answer = once_busy  # type: ignore[method-assign]
    assert len(httpx.get(address).content) == 1000 * PARTS
    assert refused == [2]
