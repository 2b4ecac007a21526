"""GET /scenes/{id}/recorded: recorded frames and masks of a job that trains and of a scene that keeps them."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from contract.access.audit import AUDIT_FILE
from contract.access.keys import KeyScope
from contract.wire.rendering import RecordedRequest
from intrasplat.names import RECORDED
from intrasplat.picture import RecordedMasks
from intrasplat.scene.recorded_file import MASK, PICTURE, name_of
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer

KEPT = (0, 3, 6, 11)
"""Of the 12 frames of a clip."""


def keep(folder: Path, *, eyes: tuple[str, ...] = ("left", "right"), masks: bool = True) -> int:
    """Frames whose bytes say what they are; how many bytes they take."""
    kinds = (PICTURE, MASK) if masks else (PICTURE,)
    with zipfile.ZipFile(folder / RECORDED, "w") as archive:
        for eye in eyes:
            for frame in KEPT:
                for kind in kinds:
                    archive.writestr(name_of(eye, frame, kind), f"{eye} {frame} {kind}")  # type: ignore[arg-type]
    return (folder / RECORDED).stat().st_size


@pytest.mark.parametrize("state", ["running", "done"])
def test_marked_frames_are_drawn_by_the_worker(service: ServiceUnderTest, state: str) -> None:
    job_id = service.running_job() if state == "running" else service.finished_scene()
    frame = service.http.get(f"/scenes/{job_id}/recorded", params={"t": 0.3})
    assert (frame.status_code, frame.content) == (200, b"jpeg"), frame.text
    assert frame.headers["content-type"] == "image/jpeg"
    assert frame.headers["cache-control"] == "no-store"
    assert (frame.headers["x-intrasplat-state"], frame.headers["x-intrasplat-t"]) == (state, "0.25")
    attempt = None if state == "running" else 1
    assert service.painter.requests == [RecordedRequest(scene_id=job_id, attempt=attempt, t=0.3)]
    stranger = bearer(service, "another")
    assert service.http.get(f"/scenes/{job_id}/recorded", headers=stranger).status_code == 404


@pytest.mark.parametrize(("t", "frame"), [(0.0, 0), (0.2, 3), (0.4, 6), (0.99, 11), (7.0, 11)])
def test_recorded_frames_are_sent_as_they_are_stored_without_a_worker(
    service: ServiceUnderTest, t: float, frame: int
) -> None:
    scene = service.finished_scene()
    keep(service.store.scene_folder(scene, 1))
    for eye in ("left", "right"):
        for masks, kind, media_type in (("off", "jpg", "image/jpeg"), ("only", "png", "image/png")):
            answer = service.http.get(f"/scenes/{scene}/recorded", params={"t": t, "eye": eye, "masks": masks})
            assert (answer.status_code, answer.text) == (200, f"{eye} {frame} {kind}")
            assert (answer.headers["content-type"], answer.headers["cache-control"]) == (media_type, "no-store")
            assert answer.headers["x-intrasplat-scene"] == scene
            assert float(answer.headers["x-intrasplat-t"]) == pytest.approx(frame / 12, abs=1e-5)
    assert service.painter.requests == []


def test_the_job_that_trains_is_asked_for_either_eye(service: ServiceUnderTest) -> None:
    job_id = service.running_job()
    service.http.get(f"/scenes/{job_id}/recorded", params={"t": 0.5, "eye": "right", "masks": "only"})
    wanted = RecordedRequest(scene_id=job_id, t=0.5, eye="right", masks=RecordedMasks.ONLY)
    assert service.painter.requests == [wanted]


@pytest.mark.parametrize(
    ("query", "status", "field"),
    [
        ({"eye": "middle"}, 422, "eye"),
        ({"masks": "green"}, 422, "masks"),
        ({"eye": "right", "masks": "off"}, 422, "eye"),
        ({"masks": "only"}, 422, "masks"),
        ({"t": "-1"}, 422, "t"),
        ({"eyes": "left"}, 422, "eyes"),
    ],
)
def test_what_a_scene_does_not_keep_is_refused_by_its_name(
    service: ServiceUnderTest, query: dict[str, str], status: int, field: str
) -> None:
    scene = service.finished_scene()
    keep(service.store.scene_folder(scene, 1), eyes=("left",), masks=False)
    assert_problem(service.http.get(f"/scenes/{scene}/recorded", params=query), status, field)


def test_a_scene_of_before_says_that_it_keeps_none(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    problem = assert_problem(service.http.get(f"/scenes/{scene}/recorded?masks=off"), 404, "scene")
    assert "keeps no recorded frames" in problem["detail"]


def test_frames_are_for_keys_that_may_view_and_for_their_own_tenant(service: ServiceUnderTest) -> None:
    own = bearer(service, "ward-3")
    scene = service.finished_scene(own)
    keep(service.store.scene_folder(scene, 1))
    path = f"/scenes/{scene}/recorded?masks=off"
    assert service.http.get(path, headers=bearer(service, "ward-3", {KeyScope.VIEW})).status_code == 200
    assert_problem(
        service.http.get(path, headers=bearer(service, "ward-3", {KeyScope.RECONSTRUCT})), 403, "Authorization"
    )
    assert_problem(service.http.get(path, headers=bearer(service, "ward-4")), 404, "scene")
    lines = (json.loads(line) for line in (service.store.data_dir / AUDIT_FILE).read_text().splitlines())
    assert ("viewed", scene) in [(line["action"], line["job_id"]) for line in lines if line["outcome"] == "ok"]


def test_a_purge_counts_and_removes_them(service: ServiceUnderTest) -> None:
    bare, scene = service.finished_scene(), service.finished_scene()
    size_bytes = keep(service.store.scene_folder(scene, 1))
    less, more = (service.http.request("DELETE", f"/scenes/{each}").json() for each in (bare, scene))
    assert more["files"]["scenes"] == less["files"]["scenes"] + 1
    assert more["bytes"]["scenes"] == less["bytes"]["scenes"] + size_bytes
    assert more["verified"]
    assert_problem(service.http.get(f"/scenes/{scene}/recorded?masks=off"), 404, "scene")
