"""Pictures and scenes: asked of the worker, described truthfully, gone when deleted."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import zmq

from contract.access.keys import KeyScope
from contract.queue.embedded import short_socket_path
from contract.queue.interface import Claim
from contract.wire.cameras import CamerasRequest, SceneCameras
from contract.wire.job import JobRecord
from contract.wire.rendering import RenderRequest, WorkerAddress, WorkerReply
from intrasplat.names import MANIFEST, MASKS, REPORT
from intrasplat.report import Report
from tests.cameras import CAMERAS
from tests.memory_queue import MemoryQueue
from tests.reports import REPORT_OF_A_SCENE
from tests.service.under_test import (
    CAMERA,
    COARSE_WIDTH,
    IDENTITY,
    ServiceUnderTest,
    assert_problem,
    bearer,
    running_service,
)


def test_a_render_carries_scene_state_and_time_and_its_request_reaches_the_worker(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    query = {"t": "0.4", "pose": "orbit:10,-5,1.5", "scene": scene, "width": "64", "layer": "depth", "format": "npy"}
    response = service.http.get("/render", params=query)
    assert response.status_code == 200, response.text
    assert response.content == b"npy"
    assert response.headers["x-intrasplat-scene"] == scene
    assert response.headers["x-intrasplat-state"] == "done"
    assert response.headers["x-intrasplat-t"] == "0.4"
    assert "x-intrasplat-warning" not in response.headers
    (request,) = service.painter.requests
    assert isinstance(request, RenderRequest)
    assert request.model_dump(include={"t", "layer", "scene_id"}) == {"t": 0.4, "layer": "depth", "scene_id": scene}
    assert request.pose is not None
    assert request.pose.kind == "orbit"
    assert request.camera.width == 64


def test_warnings_of_a_render_come_as_a_header(service: ServiceUnderTest) -> None:
    service.finished_scene()
    response = service.http.get("/render", params={"t": 2, "pose": IDENTITY})
    assert response.headers["x-intrasplat-t"] == "1"
    assert response.headers["x-intrasplat-warning"].startswith("t is after the last frame; ansicht")
    assert response.headers["x-intrasplat-warning-codes"] == "time_outside_clip, unclassified"


def test_the_scene_may_be_left_out_only_while_there_is_exactly_one(service: ServiceUnderTest) -> None:
    assert_problem(service.http.get("/render"), 400, "scene")
    first = service.finished_scene()
    assert service.http.get("/render").headers["x-intrasplat-scene"] == first
    service.finished_scene()
    assert "2 scenes" in assert_problem(service.http.get("/render"), 400, "scene")["detail"]


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
    service: ServiceUnderTest, query: dict[str, str], status: int, field: str | None
) -> None:
    service.finished_scene()
    response = service.http.get("/render", params=query)
    assert_problem(response, status, field)
    assert "Smith" not in response.text


def test_without_a_worker_renders_are_unavailable_and_the_service_is_not_ready(service: ServiceUnderTest) -> None:
    service.finished_scene()
    assert service.http.get("/readyz").json()["workers"] == ["worker-1"]
    service.queue.withdraw("worker-1")
    response = service.http.get("/render")
    assert "intrasplat up" in assert_problem(response, 503)["remedy"]
    assert response.headers["retry-after"]
    assert_problem(service.http.get("/readyz"), 503, "worker")
    assert service.http.get("/healthz").status_code == 200


def test_a_worker_that_does_not_answer_is_given_up_in_time(tmp_path: Path) -> None:
    for service in running_service(tmp_path, render_timeout_s=0.1):
        service.finished_scene()
        nobody = f"ipc://{short_socket_path(service.store.run_dir, 'nobody.sock')}"
        service.queue.withdraw("worker-1")
        service.queue.announce(WorkerAddress(name="worker-2", endpoint=nobody, device="cpu"))
        assert_problem(service.http.get("/render"), 503)


def test_format_and_quality_reach_the_worker(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    response = service.http.get("/render", params={"scene": scene, "format": "webp", "quality": "35"})
    assert response.headers["content-type"] == "image/webp"
    (request,) = service.painter.requests
    assert isinstance(request, RenderRequest)
    assert (request.attempt, request.format, request.quality) == (1, "webp", 35)
    assert_problem(service.http.get("/render", params={"scene": scene, "quality": "0"}), 422, "quality")


def test_a_render_says_how_much_of_it_nothing_saw_and_the_caller_chooses_what_is_shown_there(
    service: ServiceUnderTest,
) -> None:
    query = {"scene": service.finished_scene()}
    marked = service.http.get("/render", params=query)
    assert marked.headers["x-intrasplat-unseen"] == "0.063"
    assert json.loads(marked.headers["x-intrasplat-camera"]) == CAMERA.model_dump(mode="json")
    guessed = service.http.get("/render", params=query | {"unseen": "guess"})
    assert guessed.headers["etag"] != marked.headers["etag"]
    assert [each.unseen for each in service.painter.requests if isinstance(each, RenderRequest)] == ["mark", "guess"]
    assert_problem(service.http.get("/render", params=query | {"unseen": "hide"}), 422, "unseen")
    answer = service.http.get("/openapi.json").json()["paths"]["/render"]["get"]["responses"]["200"]
    assert answer["headers"]["X-Intrasplat-Unseen"]["schema"] == {"type": "number", "minimum": 0, "maximum": 1}
    export = service.http.get(f"/scenes/{query['scene']}/export")
    assert export.status_code == 200
    assert "x-intrasplat-unseen" not in export.headers


def test_a_page_from_elsewhere_may_read_what_a_render_says_of_itself(tmp_path: Path) -> None:
    origin = "https://viewer.hospital"
    for service in running_service(tmp_path, cors_origins=(origin,)):
        query = {"scene": service.finished_scene(), "t": "2"}
        headers = service.http.get("/render", params=query, headers={"origin": origin}).headers
        exposed = {each.strip().lower() for each in headers["access-control-expose-headers"].split(",")}
        assert {each for each in headers if each.startswith("x-intrasplat-")} <= exposed


def test_the_caller_chooses_the_light_and_workers_of_older_versions_understand_the_default(
    service: ServiceUnderTest,
) -> None:
    scene = service.finished_scene()
    for chosen in ({}, {"light": "recorded", "smoke": "show"}):
        assert service.http.get("/render", params={"scene": scene} | chosen).status_code == 200
    steady, recorded = (each for each in service.painter.requests if isinstance(each, RenderRequest))
    assert (steady.light, recorded.light) == ("steady", "recorded")
    assert (steady.smoke, recorded.smoke) == ("remove", "show")
    assert '"light"' not in steady.model_dump_json()
    assert '"smoke"' not in steady.model_dump_json()
    for name in ("light", "smoke"):
        assert_problem(service.http.get("/render", params={"scene": scene, name: "dim"}), 422, name)


def test_the_caller_chooses_whether_highlights_are_shown(service: ServiceUnderTest) -> None:
    query = {"scene": service.finished_scene()}
    answers = [service.http.get("/render", params=query | each) for each in ({}, {"highlights": "off"})]
    assert answers[0].headers["etag"] != answers[1].headers["etag"]
    asked = [each.highlights for each in service.painter.requests if isinstance(each, RenderRequest)]
    assert asked == ["on", "off"]
    assert_problem(service.http.get("/render", params=query | {"highlights": "some"}), 422, "highlights")


def test_an_answer_says_how_long_it_took(service: ServiceUnderTest) -> None:
    timing = service.http.get("/render", params={"scene": service.finished_scene()}).headers["server-timing"]
    figures = re.fullmatch(r"render;dur=(\d+\.\d), total;dur=(\d+\.\d)", timing)
    assert figures is not None
    assert float(figures[1]) <= float(figures[2])


def test_who_has_the_picture_is_told_so_without_asking_the_worker(service: ServiceUnderTest) -> None:
    query = {"scene": service.finished_scene(), "t": "0.5", "pose": "orbit:10,0,1"}
    first = service.http.get("/render", params=query)
    assert first.headers["cache-control"] == "private, no-cache"
    for given in (first.headers["etag"], f'"other", {first.headers["etag"]}', "*"):
        again = service.http.get("/render", params=query, headers={"If-None-Match": given})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", first.headers["etag"])
    assert len(service.painter.requests) == 1
    another = service.http.get("/render", params=query | {"t": "0.6"}, headers={"If-None-Match": first.headers["etag"]})
    assert another.status_code == 200
    assert another.headers["etag"] != first.headers["etag"]


def test_nobody_may_keep_a_coarse_picture_because_a_sharp_one_may_follow(service: ServiceUnderTest) -> None:
    response = service.http.get("/render", params={"scene": service.finished_scene(), "width": COARSE_WIDTH})
    assert response.headers["cache-control"] == "no-store"
    assert "etag" not in response.headers


def test_who_has_the_picture_of_a_purged_scene_is_not_told_that_it_is_still_right(service: ServiceUnderTest) -> None:
    query = {"scene": service.finished_scene()}
    tag = service.http.get("/render", params=query).headers["etag"]
    assert service.http.delete(f"/scenes/{query['scene']}").status_code == 200
    assert_problem(service.http.get("/render", params=query, headers={"If-None-Match": tag}), 404, "scene")


def test_a_running_job_is_shown_by_its_newest_snapshot_which_nobody_may_keep(service: ServiceUnderTest) -> None:
    job_id = service.running_job()
    response = service.http.get("/render", params={"scene": job_id}, headers={"If-None-Match": "*"})
    assert response.status_code == 200, response.text
    assert response.headers["x-intrasplat-state"] == "running"
    assert response.headers["x-intrasplat-iteration"] == "7"
    assert response.headers["cache-control"] == "no-store"
    assert "etag" not in response.headers
    (request,) = service.painter.requests
    assert request.attempt is None


def test_a_running_job_that_no_worker_shows_yet_is_to_be_asked_for_again_in_a_second(service: ServiceUnderTest) -> None:
    service.upload()
    record, _ = service.claimed()
    response = service.http.get("/render", params={"scene": record.job_id})
    assert_problem(response, 503, "scene")
    assert response.headers["retry-after"] == "1"


@pytest.mark.parametrize("died", [True, False])
def test_a_job_that_has_lost_its_worker_is_to_be_asked_for_again_until_it_is_claimed(
    service: ServiceUnderTest, died: bool
) -> None:
    job_id = service.running_job()
    assert service.http.get("/render", params={"scene": job_id}).status_code == 200
    assert service.queue.release(Claim(job_id, 1, "worker-1"), died=died)
    response = service.http.get("/render", params={"scene": job_id})
    assert_problem(response, 503, "scene")
    assert response.headers["Retry-After"]
    service.claimed()
    assert service.http.get("/render", params={"scene": job_id}).status_code == 200


def test_a_job_that_has_nothing_to_show_says_where_it_stands(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    assert "queued" in assert_problem(service.http.get("/render", params={"scene": job_id}), 409, "scene")["detail"]
    service.queue.cancel(job_id)
    assert "cancelled" in assert_problem(service.http.get("/render", params={"scene": job_id}), 409, "scene")["detail"]


def test_a_tenant_sees_and_counts_only_its_own_scenes(tmp_path: Path) -> None:
    for service in running_service(tmp_path, host="0.0.0.0", hosts=("127.0.0.1",)):
        own, other = (bearer(service, tenant) for tenant in ("ward-3", "ward-4"))
        scene, job = service.finished_scene(own), service.running_job(other)
        assert service.http.get("/render", headers=own).headers["x-intrasplat-scene"] == scene
        assert_problem(service.http.get("/render", headers=other), 400, "scene")
        unknown = assert_problem(service.http.get("/render", params={"scene": "0" * 32}, headers=own), 404, "scene")
        for headers, foreign in ((own, job), (other, scene)):
            refused = assert_problem(
                service.http.get("/render", params={"scene": foreign}, headers=headers), 404, "scene"
            )
            assert refused | {"detail": ""} == unknown | {"detail": ""}
        assert_problem(service.http.get("/render", params={"scene": scene}), 401, "Authorization")
        blind = bearer(service, "ward-3", {KeyScope.RECONSTRUCT})
        assert_problem(service.http.get("/render", params={"scene": scene}, headers=blind), 403, "Authorization")


class EndingQueue(MemoryQueue):
    """The job ends just after it was looked up as running."""

    finish_next: Callable[[], None] | None = None

    def get(self, job_id: str) -> JobRecord | None:
        record = super().get(job_id)
        if self.finish_next is not None:
            finish, self.finish_next = self.finish_next, None
            finish()
        return record


def test_a_job_that_ends_while_it_is_asked_for_is_shown_as_its_scene(tmp_path: Path) -> None:
    queue = EndingQueue()
    for service in running_service(tmp_path, queue):
        service.upload()
        record, claim = service.claimed()

        def finish(service: ServiceUnderTest = service, claim: Claim = claim) -> None:
            (service.store.work_folder(claim.job_id, claim.attempt) / MANIFEST).write_text("{}")
            service.store.publish_scene(claim.job_id, claim.attempt)
            assert service.queue.finish(claim)

        queue.finish_next = finish
        response = service.http.get("/render", params={"scene": record.job_id})
        assert response.status_code == 200, response.text
        assert response.headers["x-intrasplat-state"] == "done"
        assert response.headers["etag"]


def test_scenes_have_report_curve_and_export_until_they_are_deleted(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    assert service.http.get("/scenes").json()[0]["psnr_tissue_db"] == 36.2
    assert Report.model_validate(service.http.get(f"/scenes/{scene}").json()) == REPORT_OF_A_SCENE
    assert service.http.get(f"/scenes/{scene}/curve").text.startswith("t_train_s")
    exported = service.http.get(f"/scenes/{scene}/export", params={"format": "ply", "t": 0.5})
    assert exported.content == b"ply\n"
    assert f'-{scene[:8]}.ply"' in exported.headers["content-disposition"]
    assert service.http.delete(f"/scenes/{scene}").status_code == 200
    for path in (f"/scenes/{scene}", f"/scenes/{scene}/curve", f"/jobs/{scene}", f"/scenes/{scene}/export"):
        assert service.http.get(path).status_code == 404
    assert [path for path in service.store.data_dir.rglob("*") if scene in path.name] == []


def test_the_right_eye_is_asked_of_the_worker(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    assert service.http.get("/render", params={"scene": scene, "eye": "right"}).status_code == 200
    (asked,) = service.painter.requests
    assert isinstance(asked, RenderRequest)
    assert (asked.eye, asked.pose) == ("right", None)
    assert_problem(service.http.get("/render", params={"scene": scene, "eye": "third"}), 422, "eye")


def test_found_masks_are_there_until_the_scene_is_deleted(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    assert_problem(service.http.get(f"/scenes/{scene}/masks"), 404, "scene_id")
    (service.store.scene_folder(scene, 1) / MASKS).write_bytes(b"PK")
    masks = service.http.get(f"/scenes/{scene}/masks")
    assert masks.content == b"PK"
    assert masks.headers["content-type"] == "application/zip"
    assert f'-{scene[:8]}-masks.zip"' in masks.headers["content-disposition"]
    stranger = bearer(service, "another")
    assert service.http.get(f"/scenes/{scene}/masks", headers=stranger).status_code == 404
    assert service.http.delete(f"/scenes/{scene}").status_code == 200
    assert service.http.get(f"/scenes/{scene}/masks").status_code == 404


@pytest.mark.parametrize("state", ["running", "done"])
def test_cameras_are_told_while_a_job_trains_and_of_its_scene(service: ServiceUnderTest, state: str) -> None:
    job_id = service.running_job() if state == "running" else service.finished_scene()
    cameras = service.http.get(f"/scenes/{job_id}/cameras")
    assert SceneCameras.model_validate(cameras.json()) == CAMERAS
    assert (cameras.headers["x-intrasplat-state"], cameras.headers["cache-control"]) == (state, "no-store")
    attempt = None if state == "running" else 1
    assert service.painter.requests == [CamerasRequest(scene_id=job_id, attempt=attempt)]
    assert service.http.get(f"/scenes/{job_id}/cameras", headers=bearer(service, "another")).status_code == 404


@pytest.mark.parametrize("report", [b"", b"[]", b"\xff", b'{"psnr_tissue_db": NaN}', b'{"psnr_tissue_db": "good"}'])
def test_a_damaged_report_hides_no_other_scene(service: ServiceUnderTest, report: bytes) -> None:
    sound, damaged = service.finished_scene(), service.finished_scene()
    (service.store.scene_folder(damaged, 1) / REPORT).write_bytes(report)
    listed = {scene["id"]: scene for scene in service.http.get("/scenes").json()}
    assert (listed[sound]["psnr_tissue_db"], listed[sound]["error"]) == (36.2, None)
    assert listed[damaged]["psnr_tissue_db"] is None
    assert listed[damaged]["error"]


def answer_badly_then_well(socket: zmq.Socket[bytes]) -> None:
    """Two answers that cannot be read, one to each of two requests, then a sound one to the third."""
    good = WorkerReply(media_type="image/png", t=0.5).model_dump_json().encode()
    for head in (b"{", b'{"error": 5}', good):
        caller, request_id, _ = socket.recv_multipart()
        socket.send_multipart([caller, b"one part"])
        socket.send_multipart([caller, request_id, head, b"picture"])
    socket.close()


def test_an_answer_that_cannot_be_read_spoils_no_later_one(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    service.queue.withdraw("worker-1")
    endpoint = f"ipc://{short_socket_path(service.store.run_dir, 'rude.sock')}"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    socket.bind(endpoint)
    rude = threading.Thread(target=answer_badly_then_well, args=(socket,))
    rude.start()
    service.queue.announce(WorkerAddress(name="rude", endpoint=endpoint, device="cpu"))
    for _ in range(2):
        assert "cannot be read" in assert_problem(service.http.get("/render", params={"scene": scene}), 503)["detail"]
    assert service.http.get("/render", params={"scene": scene}).content == b"picture"
    rude.join()
    context.term()
