"""GET /scenes/{id}/thumbnail: rendered once, kept, answered again without a worker, removed with the scene."""

from __future__ import annotations

import pytest

from contract.access.keys import KeyScope
from contract.wire.rendering import RenderRequest
from intrasplat.names import MANIFEST, REPORT, THUMBNAIL
from intrasplat.notices import Notice, NoticeCode
from service import thumbnails
from tests.reports import REPORT_OF_A_SCENE
from tests.service.under_test import COARSE_WIDTH, ServiceUnderTest, assert_problem, bearer


@pytest.fixture
def scene(service: ServiceUnderTest) -> str:
    return service.finished_scene()


def renders(service: ServiceUnderTest) -> list[RenderRequest]:
    return [each for each in service.painter.requests if isinstance(each, RenderRequest)]


def test_a_thumbnail_is_rendered_once_and_then_kept(service: ServiceUnderTest, scene: str) -> None:
    first = service.http.get(f"/scenes/{scene}/thumbnail")
    assert (first.status_code, first.headers["content-type"]) == (200, "image/jpeg")
    (request,) = renders(service)
    assert (request.camera.width, request.t, request.pose, request.attempt) == (thumbnails.WIDTH, 0.0, None, 1)
    service.queue.withdraw("worker-1")  # no worker is left to ask
    second = service.http.get(f"/scenes/{scene}/thumbnail")
    assert (second.status_code, second.content, second.headers["etag"]) == (200, first.content, first.headers["etag"])
    assert len(renders(service)) == 1
    same = service.http.get(f"/scenes/{scene}/thumbnail", headers={"If-None-Match": first.headers["etag"]})
    assert (same.status_code, same.content) == (304, b"")
    assert same.headers["cache-control"] == "private, no-cache"


def test_a_coarse_thumbnail_is_shown_and_not_kept(
    service: ServiceUnderTest, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thumbnails, "WIDTH", COARSE_WIDTH)
    for count in (1, 2):
        assert service.http.get(f"/scenes/{scene}/thumbnail").status_code == 200
        assert len(renders(service)) == count
    assert not (service.store.scene_folder(scene, 1) / THUMBNAIL).exists()


def test_a_thumbnail_goes_with_its_scene_and_does_not_bring_it_back(service: ServiceUnderTest, scene: str) -> None:
    service.http.get(f"/scenes/{scene}/thumbnail")
    folder = service.store.scene_folder(scene, 1)
    assert {each.name for each in folder.iterdir()} >= {THUMBNAIL, MANIFEST}
    receipt = service.http.request("DELETE", f"/scenes/{scene}").json()
    assert receipt["verified"]
    service.store.keep_thumbnail(scene, 1, b"late")
    assert not folder.exists()
    assert_problem(service.http.get(f"/scenes/{scene}/thumbnail"), 404, "scene")


def test_only_the_tenant_with_the_scope_sees_it_and_the_audit_tells(service: ServiceUnderTest) -> None:
    owner = bearer(service, "ward-3")
    scene = service.finished_scene(owner)
    stranger, sender = bearer(service, "ward-4"), bearer(service, "ward-3", frozenset({KeyScope.RECONSTRUCT}))
    assert_problem(service.http.get(f"/scenes/{scene}/thumbnail", headers=stranger), 404, "scene")
    assert_problem(service.http.get(f"/scenes/{scene}/thumbnail", headers=sender), 403, "Authorization")
    assert service.http.get(f"/scenes/{scene}/thumbnail", headers=owner).status_code == 200
    assert '"viewed"' in (service.store.data_dir / "audit.jsonl").read_text()


def test_a_job_without_a_scene_has_no_thumbnail(service: ServiceUnderTest) -> None:
    running = service.running_job()
    assert_problem(service.http.get(f"/scenes/{running}/thumbnail"), 409, "scene")


def test_the_list_tells_length_and_the_codes_of_warnings_for_a_traffic_light(
    service: ServiceUnderTest, scene: str
) -> None:
    notices = (Notice.warning(NoticeCode.BLOOD, "x"), Notice.info(NoticeCode.COPYING_SCORES_MORE, "y"))
    report = REPORT_OF_A_SCENE.model_copy(update={"warnings": notices})
    (service.store.scene_folder(scene, 1) / REPORT).write_text(report.model_dump_json())
    (summary,) = service.http.get("/scenes").json()
    assert summary["warnings"] == ["blood"]
    times_s = report.frame_times_s
    assert summary["duration_s"] == times_s[-1] - times_s[0] > 0
    assert summary["links"]["thumbnail"] == f"/scenes/{scene}/thumbnail"
