"""The HTTP surface on a real queue, store and ZeroMQ connection; only the image is painted instead of rendered."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from contract.embedded import short_socket_path
from contract.errors import InputError, SceneError
from contract.job import JobError, JobProgress, JobRecord, JobState
from contract.queue import Claim
from contract.queue_memory import MemoryQueue
from contract.rendering import ExportRequest, RenderRequest, WorkerAddress
from contract.settings import Settings
from contract.store import CURVE, MANIFEST, REPORT, SUBMISSION, Store
from service.app import create_app
from service.renderer import ZmqRenderer
from tests.service.asgi import AsgiClient, serving
from worker.serve import RequestServer, View

CLIP = b"not a video, but the service does not look inside" * 100
IDENTITY = "1,0,0,0,0,1,0,0,0,0,1,0"


class Painter:
    """Answers like a worker and remembers what it was asked."""

    def __init__(self) -> None:
        self.requests: list[RenderRequest | ExportRequest] = []

    def answer(self, request: RenderRequest | ExportRequest) -> View:
        self.requests.append(request)
        if isinstance(request, ExportRequest):
            return View(b"ply\n", "application/octet-stream", request.t)
        if request.camera.width == 8:
            raise InputError("width", "8 is too narrow.", "Use more.")
        if request.camera.width == 9:
            raise SceneError("The scene is damaged.")
        if request.camera.width == 10:
            raise RuntimeError("patient Smith")
        warnings = ("t is after the last frame", "ansicht – geschätzt") if request.t > 1 else ()
        return View(request.format.value.encode(), f"image/{request.format.value}", min(request.t, 1.0), warnings)


@dataclass
class House:
    """A running service and what it stands on."""

    http: AsgiClient
    queue: MemoryQueue
    store: Store
    painter: Painter

    def upload(self, options: str = "{}", parts: Mapping[str, tuple[str, bytes]] | None = None) -> httpx.Response:
        return self.http.post("/reconstruct", files=parts or {"clip": ("a.mp4", CLIP)}, data={"options": options})

    def claimed(self) -> tuple[JobRecord, Claim]:
        record = self.queue.claim("worker-1", 0.0)
        assert record is not None
        return record, Claim(record.job_id, record.attempt, "worker-1")

    def finished_scene(self) -> str:
        self.upload()
        record, claim = self.claimed()
        folder = self.store.work_folder(record.job_id, record.attempt)
        (folder / MANIFEST).write_text("{}")
        (folder / REPORT).write_text('{"psnr_tissue_db": 36.2, "warnings": []}')
        (folder / CURVE).write_text("t_train_s,psnr_tissue_db\n1,30\n")
        self.store.publish_scene(record.job_id, record.attempt)
        self.queue.finish(claim)
        return record.job_id

    def spooled(self) -> list[Path]:
        return [path for area in ("incoming", "spool") for path in (self.store.data_dir / area).iterdir()]


def make_house(data_dir: Path, **changes: Any) -> Iterator[House]:
    queue, store, painter = MemoryQueue(), Store(data_dir), Painter()
    settings = Settings(data_dir=data_dir, render_timeout_s=5.0, min_free_bytes=0).model_copy(update=changes)
    app = create_app(settings, queue, store, ZmqRenderer(queue, settings.render_timeout_s))
    endpoint = f"ipc://{short_socket_path(store.run_dir, 'worker-1.sock')}"
    with (
        RequestServer(endpoint, painter.answer),
        serving(app, "http://127.0.0.1:8765") as http,
    ):
        queue.announce(WorkerAddress(name="worker-1", endpoint=endpoint, device="cpu"))
        yield House(http, queue, store, painter)


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    yield from make_house(tmp_path)


def assert_problem(response: httpx.Response, status: int, field: str | None = None) -> dict[str, Any]:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = response.json()
    assert problem["status"] == status
    assert problem["detail"]
    assert problem.get("field") == field
    return problem


def test_an_accepted_clip_is_on_disk_and_queued_before_the_answer(house: House) -> None:
    response = house.upload('{"preset": "fast", "iterations": 30, "holdout": [1, 9]}')
    assert response.status_code == 202
    job = response.json()
    assert response.headers["location"] == f"/jobs/{job['id']}"
    assert job["state"] == "queued"
    record = house.queue.get(job["id"])
    assert record is not None
    assert record.options.holdout == "1,9"
    assert record.input_sha256 == hashlib.sha256(CLIP).hexdigest()
    folder = house.store.spool_folder(job["id"])
    assert (folder / "clip.mp4").read_bytes() == CLIP
    assert JobRecord.model_validate_json((folder / SUBMISSION).read_text()) == record
    assert list((house.store.data_dir / "incoming").iterdir()) == []


def test_two_eyes_calibration_and_masks_are_kept_under_our_names(house: House) -> None:
    eyes = {"left": ("Smith_L.MOV", b"left"), "right": ("Smith_R.mov", b"right")}
    response = house.upload(parts={**eyes, "calibration": ("stereo.yaml", b"K: 1"), "masks": ("m.zip", b"zip")})
    record = house.queue.get(response.json()["id"])
    assert record is not None
    assert record.files.model_dump() == {
        "clip": "left.mov",
        "right": "right.mov",
        "calibration": "calibration.yaml",
        "masks": "masks.zip",
    }
    assert "Smith" not in "".join(path.read_text() for path in house.store.data_dir.rglob("*.json"))


@pytest.mark.parametrize(
    ("parts", "field"),
    [
        ({"left": ("l.mp4", b"x")}, "right"),
        ({"right": ("r.mp4", b"x")}, "left"),
        ({"masks": ("m.zip", b"x")}, "clip"),
        ({"clip": ("c.mp4", b"x"), "right": ("r.mp4", b"x")}, "clip"),
        ({"clip": ("c.exe", b"x")}, "clip"),
        ({"clip": ("c", b"x")}, "clip"),
        ({"clip": ("c.mp4", b"")}, "clip"),
        ({"clip": ("c.mp4", b"x"), "calibration": ("k.pkl", b"x")}, "calibration"),
        ({"clip": ("c.mp4", b"x"), "passwd": ("k.json", b"x")}, "passwd"),
    ],
)
def test_an_upload_that_cannot_be_used_names_the_part_and_leaves_nothing(
    house: House, parts: dict[str, tuple[str, bytes]], field: str
) -> None:
    assert assert_problem(house.upload(parts=parts), 422, field)["remedy"]
    assert house.spooled() == []
    assert house.queue.records() == []


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ('{"budget_s": 0}', "options.budget_s"),
        ('{"budget_s": 1, "iterations": 1}', "options"),
        ('{"layout": "diagonal"}', "options.layout"),
        ('{"colour": 1}', "options.colour"),
        ("[1]", "options"),
        ("{", "options"),
    ],
)
def test_an_option_that_cannot_be_meant_is_named(house: House, options: str, field: str) -> None:
    assert_problem(house.upload(options), 422, field)
    assert house.spooled() == []


def test_a_part_that_comes_twice_is_refused(house: House) -> None:
    twice = [("clip", ("a.mp4", b"x")), ("clip", ("b.mp4", b"y"))]
    assert_problem(house.http.post("/reconstruct", files=twice), 422, "clip")


@pytest.mark.parametrize(
    ("content_type", "body"),
    [
        ("application/json", b"{}"),
        ("multipart/form-data", b"--x"),
        ("multipart/form-data; boundary=x", b"this is no multipart body"),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="clip"; filename="a.mp4"\r\n\r\nab',
        ),
    ],
)
def test_a_body_that_is_no_complete_form_is_a_bad_request(house: House, content_type: str, body: bytes) -> None:
    response = house.http.post("/reconstruct", content=body, headers={"content-type": content_type})
    assert response.status_code == 400
    assert response.json()["remedy"]
    assert house.spooled() == []


def test_an_upload_over_the_limit_is_cut_off_while_it_is_counted(tmp_path: Path) -> None:
    for house in make_house(tmp_path, max_upload_bytes=1000):
        assert "INTRASPLAT_MAX_UPLOAD_BYTES" in assert_problem(house.upload(), 413, "clip")["remedy"]
        assert house.spooled() == []


def test_nothing_is_accepted_on_a_full_disk(tmp_path: Path) -> None:
    for house in make_house(tmp_path, min_free_bytes=2**62):
        assert_problem(house.upload(), 507)
        assert_problem(house.http.get("/readyz"), 503, "disk")


def test_a_running_job_shows_stage_decibels_and_seconds_left(house: House) -> None:
    job_id = house.upload().json()["id"]
    _, claim = house.claimed()
    house.queue.progress(claim, JobProgress(stage="train", fraction=0.4, psnr_db=33.1, seconds_left=20.0))
    job = house.http.get(f"/jobs/{job_id}").json()
    assert (job["state"], job["stage"], job["psnr_db"], job["seconds_left"]) == ("running", "train", 33.1, 20.0)
    assert [each["id"] for each in house.http.get("/jobs").json()] == [job_id]


def test_a_failed_job_tells_field_and_remedy(house: House) -> None:
    job_id = house.upload().json()["id"]
    _, claim = house.claimed()
    house.queue.fail(claim, JobError(problem="no depth.", field="calibration", remedy="Check the baseline."))
    job = house.http.get(f"/jobs/{job_id}").json()
    assert job["state"] == "failed"
    assert job["error"] == {"problem": "no depth.", "field": "calibration", "remedy": "Check the baseline."}
    assert_problem(house.http.get("/render", params={"scene": job_id}), 409, "scene")
    assert_problem(house.http.delete(f"/jobs/{job_id}"), 409, "job_id")
    assert house.http.delete(f"/scenes/{job_id}").status_code == 204
    assert house.spooled() == []


def test_cancelling_ends_a_queued_job_and_removes_its_clip(house: House) -> None:
    job_id = house.upload().json()["id"]
    assert house.http.delete(f"/jobs/{job_id}").json()["state"] == "cancelled"
    assert house.http.delete(f"/jobs/{job_id}").json()["state"] == "cancelled"
    assert house.spooled() == []


def test_cancelling_a_running_job_only_asks_its_worker(house: House) -> None:
    job_id = house.upload().json()["id"]
    house.claimed()
    job = house.http.delete(f"/jobs/{job_id}").json()
    assert (job["state"], job["cancel_requested"]) == ("running", True)
    assert house.spooled() != []


def test_a_render_carries_scene_state_and_time_and_its_request_reaches_the_worker(house: House) -> None:
    scene = house.finished_scene()
    query = {"t": "0.4", "pose": "orbit:10,-5,1.5", "scene": scene, "width": "64", "layer": "depth", "format": "npy"}
    response = house.http.get("/render", params=query)
    assert response.status_code == 200, response.text
    assert response.content == b"npy"
    assert response.headers["x-intrasplat-scene"] == scene
    assert response.headers["x-intrasplat-state"] == "done"
    assert response.headers["x-intrasplat-t"] == "0.4"
    assert "x-intrasplat-warning" not in response.headers
    (request,) = house.painter.requests
    assert isinstance(request, RenderRequest)
    assert request.model_dump(include={"t", "layer", "scene_id"}) == {"t": 0.4, "layer": "depth", "scene_id": scene}
    assert request.pose is not None
    assert request.pose.kind == "orbit"
    assert request.camera.width == 64


def test_warnings_of_a_render_come_as_a_header(house: House) -> None:
    house.finished_scene()
    response = house.http.get("/render", params={"t": 2, "pose": IDENTITY})
    assert response.headers["x-intrasplat-t"] == "1"
    assert response.headers["x-intrasplat-warning"].startswith("t is after the last frame; ansicht")


def test_the_scene_may_be_left_out_only_while_there_is_exactly_one(house: House) -> None:
    assert_problem(house.http.get("/render"), 400, "scene")
    first = house.finished_scene()
    assert house.http.get("/render").headers["x-intrasplat-scene"] == first
    house.finished_scene()
    assert "2 scenes" in assert_problem(house.http.get("/render"), 400, "scene")["detail"]


@pytest.mark.parametrize(
    ("query", "status", "field"),
    [
        ({"t": "-0.1"}, 422, "t"),
        ({"t": "nan"}, 422, "t"),
        ({"t": "soon"}, 422, "t"),
        ({"pose": "1,2,3"}, 422, "pose"),
        ({"pose": IDENTITY.replace("1,", "3,", 1)}, 422, "pose"),
        ({"layer": "xray"}, 422, "layer"),
        ({"format": "gif"}, 422, "format"),
        ({"width": "100000"}, 422, "width"),
        ({"fx": "inf"}, 422, "fx"),
        ({"scene": "../../etc/passwd"}, 404, "scene"),
        ({"scene": "0" * 32}, 404, "scene"),
        ({"width": "8"}, 422, "width"),
        ({"width": "9"}, 404, "scene"),
        ({"width": "10"}, 500, None),
    ],
)
def test_a_render_that_cannot_be_made_is_a_problem(
    house: House, query: dict[str, str], status: int, field: str | None
) -> None:
    house.finished_scene()
    response = house.http.get("/render", params=query)
    assert_problem(response, status, field)
    assert "Smith" not in response.text


def test_without_a_worker_renders_are_unavailable_and_the_service_is_not_ready(house: House) -> None:
    house.finished_scene()
    assert house.http.get("/readyz").json()["workers"] == ["worker-1"]
    house.queue.withdraw("worker-1")
    response = house.http.get("/render")
    assert "intrasplat up" in assert_problem(response, 503)["remedy"]
    assert response.headers["retry-after"]
    assert_problem(house.http.get("/readyz"), 503, "worker")
    assert house.http.get("/healthz").status_code == 200


def test_a_worker_that_does_not_answer_is_given_up_in_time(tmp_path: Path) -> None:
    for house in make_house(tmp_path, render_timeout_s=0.1):
        house.finished_scene()
        nobody = f"ipc://{short_socket_path(house.store.run_dir, 'nobody.sock')}"
        house.queue.withdraw("worker-1")
        house.queue.announce(WorkerAddress(name="worker-2", endpoint=nobody, device="cpu"))
        assert_problem(house.http.get("/render"), 503)


def test_scenes_have_report_curve_and_export_until_they_are_deleted(house: House) -> None:
    scene = house.finished_scene()
    assert house.http.get("/scenes").json()[0]["psnr_tissue_db"] == 36.2
    assert house.http.get(f"/scenes/{scene}").json()["warnings"] == []
    assert house.http.get(f"/scenes/{scene}/curve").text.startswith("t_train_s")
    exported = house.http.get(f"/scenes/{scene}/export", params={"format": "ply", "t": 0.5})
    assert exported.content == b"ply\n"
    assert f'filename="{scene}.ply"' in exported.headers["content-disposition"]
    assert house.http.delete(f"/scenes/{scene}").status_code == 204
    for path in (f"/scenes/{scene}", f"/scenes/{scene}/curve", f"/jobs/{scene}", f"/scenes/{scene}/export"):
        assert house.http.get(path).status_code == 404
    assert [path for path in house.store.data_dir.rglob("*") if scene in path.name] == []


def test_a_live_job_is_not_deleted_as_a_scene(house: House) -> None:
    job_id = house.upload().json()["id"]
    assert_problem(house.http.delete(f"/scenes/{job_id}"), 409, "scene_id")
    record = house.queue.get(job_id)
    assert record is not None
    assert record.state is JobState.QUEUED


@pytest.mark.parametrize(("method", "path", "status"), [("GET", "/nothing", 404), ("PUT", "/jobs", 405)])
def test_what_does_not_exist_is_a_problem_too(house: House, method: str, path: str, status: int) -> None:
    assert_problem(house.http.request(method, path), status)


@pytest.mark.parametrize("headers", [{"host": "evil.example"}, {"origin": "https://evil.example"}])
def test_foreign_pages_and_names_are_refused(house: House, headers: dict[str, str]) -> None:
    assert house.http.post("/reconstruct", headers=headers).status_code == 403
    assert house.http.get("/jobs", headers=headers).status_code == 403


def test_the_page_itself_may_use_the_service_and_nothing_from_elsewhere_may_run(house: House) -> None:
    response = house.http.get("/jobs", headers={"origin": "http://127.0.0.1:8765"})
    assert response.status_code == 200
    assert "default-src 'none'" in response.headers["content-security-policy"]
    assert response.headers["x-content-type-options"] == "nosniff"


def test_the_api_describes_itself_with_stable_operation_ids(house: House) -> None:
    document = house.http.get("/openapi.json").json()
    operations = {each["operationId"] for path in document["paths"].values() for each in path.values()}
    assert operations == {
        "reconstruct",
        "list_jobs",
        "get_job",
        "cancel_job",
        "render",
        "list_scenes",
        "get_scene",
        "get_curve",
        "export_scene",
        "delete_scene",
        "healthz",
        "readyz",
        "info",
    }
    assert "Not a medical device" in house.http.get("/info").json()["notice"]


def test_the_dashboard_is_served_at_the_root(tmp_path: Path) -> None:
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<!doctype html><title>intrasplat</title>")
    for house in make_house(tmp_path / "data", dashboard_dir=folder):
        assert "intrasplat" in house.http.get("/").text
        assert house.http.get("/jobs").json() == []
        assert_problem(house.http.get("/nothing.js"), 404)
