"""GET /scenes/{id}/files/{name}: who gets the stored files, whole, in parts and not again."""

from __future__ import annotations

import hashlib
import json

import pytest

from contract.access.audit import AUDIT_FILE
from contract.access.keys import KeyScope
from intrasplat.names import CURVE, MANIFEST, RECORDED, REPORT, SCENE
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer

CONTENT = bytes(range(256)) * 40
SHA256 = hashlib.sha256(CONTENT).hexdigest()
READER = frozenset({KeyScope.VIEW, KeyScope.DOWNLOAD})


@pytest.fixture
def scene(service: ServiceUnderTest) -> str:
    """A finished scene of tenant ward-3 with CONTENT as its Gaussians."""
    scene_id = service.finished_scene(bearer(service, "ward-3"))
    folder = service.store.scene_folder(scene_id, 1)
    (folder / SCENE).write_bytes(CONTENT)
    (folder / "masks.zip").write_bytes(b"PK")
    listed = {SCENE: {"bytes": len(CONTENT), "sha256": SHA256}, REPORT: {"bytes": 1, "sha256": "ab"}}
    beside = {RECORDED: {"bytes": 2, "sha256": hashlib.sha256(b"PK").hexdigest()}}
    (folder / RECORDED).write_bytes(b"PK")
    (folder / MANIFEST).write_text(json.dumps({"files": listed, "beside": beside}))
    return scene_id


def downloads(service: ServiceUnderTest) -> list[tuple[str, str]]:
    lines = (json.loads(line) for line in (service.store.data_dir / AUDIT_FILE).read_text().splitlines())
    return [(line["action"], line["job_id"]) for line in lines if line["action"] == "downloaded"]


def test_a_scenes_files_come_as_they_are_stored_and_are_recorded(service: ServiceUnderTest, scene: str) -> None:
    headers = bearer(service, "ward-3", READER)
    stored = service.http.get(f"/scenes/{scene}/files/{SCENE}", headers=headers)
    assert (stored.status_code, stored.content) == (200, CONTENT)
    assert stored.headers["content-type"] == "application/octet-stream"
    assert stored.headers["etag"] == f'"{SHA256}"'
    assert stored.headers["cache-control"] == "private, max-age=31536000, immutable"
    assert stored.headers["vary"] == "Authorization, X-API-Key"
    manifest = service.http.get(f"/scenes/{scene}/files/{MANIFEST}", headers=headers)
    assert manifest.headers["content-type"] == "application/json"
    assert manifest.headers["cache-control"] == "private, no-cache"  # the scores come later
    assert manifest.headers["etag"] == f'"{hashlib.sha256(manifest.content).hexdigest()}"'
    assert [*manifest.json()["files"]] == [SCENE, REPORT]
    recorded = service.http.get(f"/scenes/{scene}/files/{RECORDED}", headers=headers)
    assert (recorded.status_code, recorded.content) == (200, b"PK")
    assert downloads(service) == [("downloaded", scene)] * 3


def test_a_download_goes_on_where_it_was_cut_off(service: ServiceUnderTest, scene: str) -> None:
    path, headers = f"/scenes/{scene}/files/{SCENE}", bearer(service, "ward-3", READER)
    head = service.http.request("HEAD", path, headers=headers)
    assert (head.status_code, head.content) == (200, b"")
    assert (head.headers["content-length"], head.headers["accept-ranges"]) == (str(len(CONTENT)), "bytes")
    assert downloads(service) == []  # its header tells nothing of the scene but its size
    rest = headers | {"Range": "bytes=100-", "If-Range": head.headers["etag"]}
    part = service.http.get(path, headers=rest)
    assert (part.status_code, part.content) == (206, CONTENT[100:])
    assert part.headers["content-range"] == f"bytes 100-{len(CONTENT) - 1}/{len(CONTENT)}"
    another = service.http.get(path, headers=rest | {"If-Range": '"of another file"'})
    assert (another.status_code, another.content) == (200, CONTENT)
    beyond = service.http.get(path, headers=headers | {"Range": f"bytes={len(CONTENT)}-"})
    assert (beyond.status_code, beyond.headers["content-range"]) == (416, f"bytes */{len(CONTENT)}")
    known = service.http.get(path, headers=headers | {"If-None-Match": head.headers["etag"]})
    assert (known.status_code, known.content) == (304, b"")
    assert known.headers["etag"] == head.headers["etag"]


@pytest.mark.parametrize("name", ["masks.zip", CURVE, "nothing", "..%2fmanifest.json", SCENE + "%00"])
def test_only_what_the_manifest_lists_is_a_file_of_the_scene(service: ServiceUnderTest, scene: str, name: str) -> None:
    response = service.http.get(f"/scenes/{scene}/files/{name}", headers=bearer(service, "ward-3", READER))
    assert response.status_code == 404
    assert downloads(service) == []


def test_a_key_needs_the_scope_download(service: ServiceUnderTest, scene: str) -> None:
    viewer = bearer(service, "ward-3")
    assert service.http.get("/key", headers=viewer).json()["scopes"] == ["reconstruct", "view"]
    refusal = service.http.get(f"/scenes/{scene}/files/{SCENE}", headers=viewer)
    assert "--scopes download" in assert_problem(refusal, 403, "Authorization")["remedy"]
    assert downloads(service) == []
    stranger = bearer(service, "ward-4", READER)
    assert service.http.get("/key", headers=stranger).json()["tenant"] == "ward-4"
    assert_problem(service.http.get(f"/scenes/{scene}/files/{SCENE}", headers=stranger), 404, "scene")


def test_a_job_that_runs_and_a_purged_scene_have_no_files(service: ServiceUnderTest, scene: str) -> None:
    headers = bearer(service, "ward-3", frozenset(KeyScope))
    running = service.running_job(headers)
    assert_problem(service.http.get(f"/scenes/{running}/files/{SCENE}", headers=headers), 409, "scene")
    assert service.http.request("DELETE", f"/scenes/{scene}", headers=headers).status_code == 200
    for known in ({}, {"If-None-Match": f'"{SHA256}"'}):
        gone = service.http.get(f"/scenes/{scene}/files/{SCENE}", headers=headers | known)
        assert_problem(gone, 404, "scene")


def test_a_damaged_manifest_is_told(service: ServiceUnderTest, scene: str) -> None:
    (service.store.scene_folder(scene, 1) / MANIFEST).write_text("{")
    response = service.http.get(f"/scenes/{scene}/files/{SCENE}", headers=bearer(service, "ward-3", READER))
    assert "JSONDecodeError" in assert_problem(response, 404, "scene")["detail"]
