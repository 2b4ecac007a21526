"""Pictures and scenes: asked of the worker, described truthfully, gone when deleted."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Collection
from pathlib import Path

import pytest
import zmq

from contract.access.keys import DEFAULT_SCOPES, KeyFile, KeyScope
from contract.queue.embedded import short_socket_path
from contract.queue.memory import MemoryQueue
from contract.queue.promise import Claim
from contract.wire.errors import UnavailableError
from contract.wire.job import JobRecord
from contract.wire.names import MANIFEST, REPORT
from contract.wire.rendering import RenderRequest, WorkerAddress, WorkerReply
from tests.service.house import IDENTITY, House, assert_problem, make_house


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


def test_format_and_quality_reach_the_worker(house: House) -> None:
    scene = house.finished_scene()
    response = house.http.get("/render", params={"scene": scene, "format": "webp", "quality": "35"})
    assert response.headers["content-type"] == "image/webp"
    (request,) = house.painter.requests
    assert isinstance(request, RenderRequest)
    assert (request.attempt, request.format, request.quality) == (1, "webp", 35)
    assert_problem(house.http.get("/render", params={"scene": scene, "quality": "0"}), 422, "quality")


def test_an_answer_says_how_long_it_took(house: House) -> None:
    timing = house.http.get("/render", params={"scene": house.finished_scene()}).headers["server-timing"]
    figures = re.fullmatch(r"render;dur=(\d+\.\d), total;dur=(\d+\.\d)", timing)
    assert figures is not None
    assert float(figures[1]) <= float(figures[2])


def test_who_has_the_picture_is_told_so_without_asking_the_worker(house: House) -> None:
    query = {"scene": house.finished_scene(), "t": "0.5", "pose": "orbit:10,0,1"}
    first = house.http.get("/render", params=query)
    assert first.headers["cache-control"] == "private, no-cache"
    for given in (first.headers["etag"], f'"other", {first.headers["etag"]}', "*"):
        again = house.http.get("/render", params=query, headers={"If-None-Match": given})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", first.headers["etag"])
    assert len(house.painter.requests) == 1
    another = house.http.get("/render", params=query | {"t": "0.6"}, headers={"If-None-Match": first.headers["etag"]})
    assert another.status_code == 200
    assert another.headers["etag"] != first.headers["etag"]


def test_who_has_the_picture_of_a_purged_scene_is_not_told_that_it_is_still_right(house: House) -> None:
    query = {"scene": house.finished_scene()}
    tag = house.http.get("/render", params=query).headers["etag"]
    assert house.http.delete(f"/scenes/{query['scene']}").status_code == 200
    assert_problem(house.http.get("/render", params=query, headers={"If-None-Match": tag}), 404, "scene")


def test_a_running_job_is_shown_by_its_newest_snapshot_which_nobody_may_keep(house: House) -> None:
    job_id = house.running_job()
    response = house.http.get("/render", params={"scene": job_id}, headers={"If-None-Match": "*"})
    assert response.status_code == 200, response.text
    assert response.headers["x-intrasplat-state"] == "running"
    assert response.headers["x-intrasplat-iteration"] == "7"
    assert response.headers["cache-control"] == "no-store"
    assert "etag" not in response.headers
    (request,) = house.painter.requests
    assert request.attempt is None


def test_a_running_job_that_no_worker_shows_yet_is_to_be_asked_for_again_in_a_second(house: House) -> None:
    house.upload()
    record, _ = house.claimed()
    response = house.http.get("/render", params={"scene": record.job_id})
    assert_problem(response, 503, "scene")
    assert response.headers["retry-after"] == "1"


def test_a_job_that_has_nothing_to_show_says_where_it_stands(house: House) -> None:
    job_id = house.upload().json()["id"]
    assert "queued" in assert_problem(house.http.get("/render", params={"scene": job_id}), 409, "scene")["detail"]
    house.queue.cancel(job_id)
    assert "cancelled" in assert_problem(house.http.get("/render", params={"scene": job_id}), 409, "scene")["detail"]


def test_a_tenant_sees_and_counts_only_its_own_scenes(tmp_path: Path) -> None:
    for house in make_house(tmp_path, host="0.0.0.0", hosts=("127.0.0.1",)):
        own, other = (bearer(house, tenant) for tenant in ("ward-3", "ward-4"))
        scene, job = house.finished_scene(own), house.running_job(other)
        assert house.http.get("/render", headers=own).headers["x-intrasplat-scene"] == scene
        assert_problem(house.http.get("/render", headers=other), 400, "scene")
        unknown = assert_problem(house.http.get("/render", params={"scene": "0" * 32}, headers=own), 404, "scene")
        for headers, foreign in ((own, job), (other, scene)):
            refused = assert_problem(
                house.http.get("/render", params={"scene": foreign}, headers=headers), 404, "scene"
            )
            assert refused | {"detail": ""} == unknown | {"detail": ""}
        assert_problem(house.http.get("/render", params={"scene": scene}), 401, "Authorization")
        blind = bearer(house, "ward-3", {KeyScope.RECONSTRUCT})
        assert_problem(house.http.get("/render", params={"scene": scene}, headers=blind), 403, "Authorization")


def bearer(house: House, tenant: str, scopes: Collection[KeyScope] = DEFAULT_SCOPES) -> dict[str, str]:
    _, text = KeyFile(house.store.data_dir).create(tenant, scopes)
    return {"Authorization": f"Bearer {text}"}


class LeavingQueue(MemoryQueue):
    """Goes away when it is told to."""

    is_away = False

    def get(self, job_id: str) -> JobRecord | None:
        self._stay()
        return super().get(job_id)

    def workers(self) -> list[WorkerAddress]:
        self._stay()
        return super().workers()

    def _stay(self) -> None:
        if self.is_away:
            raise UnavailableError("The queue does not answer.", "Start it.")


def test_what_was_shown_before_is_shown_while_the_queue_is_away_but_not_if_it_was_purged(tmp_path: Path) -> None:
    queue = LeavingQueue()
    for house in make_house(tmp_path, queue):
        kept, purged, unknown = (house.finished_scene() for _ in range(3))
        for scene in (kept, purged):
            assert house.http.get("/render", params={"scene": scene}).status_code == 200
        queue.is_away = True
        house.store.purge(purged)
        assert house.http.get("/render", params={"scene": kept, "t": "0.3"}).status_code == 200
        for path in (f"/scenes/{kept}", f"/scenes/{kept}/curve", f"/scenes/{kept}/export"):
            assert house.http.get(path).status_code == 200, path
        assert_problem(house.http.get("/render", params={"scene": purged}), 404, "scene")
        assert_problem(house.http.get("/render", params={"scene": unknown}), 503)


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
    for house in make_house(tmp_path, queue):
        house.upload()
        record, claim = house.claimed()

        def finish(house: House = house, claim: Claim = claim) -> None:
            (house.store.work_folder(claim.job_id, claim.attempt) / MANIFEST).write_text("{}")
            house.store.publish_scene(claim.job_id, claim.attempt)
            assert house.queue.finish(claim)

        queue.finish_next = finish
        response = house.http.get("/render", params={"scene": record.job_id})
        assert response.status_code == 200, response.text
        assert response.headers["x-intrasplat-state"] == "done"
        assert response.headers["etag"]


def test_scenes_have_report_curve_and_export_until_they_are_deleted(house: House) -> None:
    scene = house.finished_scene()
    assert house.http.get("/scenes").json()[0]["psnr_tissue_db"] == 36.2
    assert house.http.get(f"/scenes/{scene}").json()["warnings"] == []
    assert house.http.get(f"/scenes/{scene}/curve").text.startswith("t_train_s")
    exported = house.http.get(f"/scenes/{scene}/export", params={"format": "ply", "t": 0.5})
    assert exported.content == b"ply\n"
    assert f'filename="{scene}.ply"' in exported.headers["content-disposition"]
    assert house.http.delete(f"/scenes/{scene}").status_code == 200
    for path in (f"/scenes/{scene}", f"/scenes/{scene}/curve", f"/jobs/{scene}", f"/scenes/{scene}/export"):
        assert house.http.get(path).status_code == 404
    assert [path for path in house.store.data_dir.rglob("*") if scene in path.name] == []


@pytest.mark.parametrize("report", [b"", b"[]", b"\xff", b'{"psnr_tissue_db": NaN}', b'{"psnr_tissue_db": "good"}'])
def test_a_damaged_report_hides_no_other_scene(house: House, report: bytes) -> None:
    sound, damaged = house.finished_scene(), house.finished_scene()
    (house.store.scene_folder(damaged, 1) / REPORT).write_bytes(report)
    listed = {scene["id"]: scene for scene in house.http.get("/scenes").json()}
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


def test_an_answer_that_cannot_be_read_spoils_no_later_one(house: House) -> None:
    scene = house.finished_scene()
    house.queue.withdraw("worker-1")
    endpoint = f"ipc://{short_socket_path(house.store.run_dir, 'rude.sock')}"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    socket.bind(endpoint)
    rude = threading.Thread(target=answer_badly_then_well, args=(socket,))
    rude.start()
    house.queue.announce(WorkerAddress(name="rude", endpoint=endpoint, device="cpu"))
    for _ in range(2):
        assert "cannot be read" in assert_problem(house.http.get("/render", params={"scene": scene}), 503)["detail"]
    assert house.http.get("/render", params={"scene": scene}).content == b"picture"
    rude.join()
    context.term()
