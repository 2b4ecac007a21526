"""Live feeds over HTTP: opened, shown, paused, cut and ended; for their own tenant, and with the scope alone."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from contract.access.audit import AUDIT_FILE
from contract.access.keys import DEFAULT_SCOPES, KeyScope
from contract.wire.feeds import FeedWish
from contract.wire.rendering import ExportRequest, MeasureRequest, RecordedRequest, RenderRequest
from intrasplat.live.state import FeedState
from intrasplat.live.times import LIVE, FeedTime
from tests.memory_queue import MemoryQueue
from tests.service.feed_worker import BEGAN_S, FeedWorker, following, wait_until
from tests.service.under_test import CLIP, ServiceUnderTest, assert_problem, bearer, running_service

CAMERA = {"width": 64, "height": 48, "fx_px": 80, "fy_px": 80, "cx_px": 32, "cy_px": 24, "baseline_mm": 4}
RECTIFIED = json.dumps({"model": "rectified", **CAMERA})
MAY_ALL = {*DEFAULT_SCOPES, KeyScope.FEEDS}


@pytest.fixture
def service(tmp_path: Path) -> Iterator[ServiceUnderTest]:
    hosts = ("rtsp://camera.example.org",)
    yield from running_service(tmp_path, feed_hosts=hosts, feed_devices=("/dev/video0",), feed_keep_s=600.0)


@pytest.fixture
def worker(service: ServiceUnderTest) -> Iterator[FeedWorker]:
    with following(service.queue, service.store.run_dir, CLIP) as worker:
        yield worker


def posted(service: ServiceUnderTest, options: str = "{}", **arguments: Any) -> httpx.Response:
    files = {"calibration": arguments.pop("calibration", ("endoscope.json", RECTIFIED.encode()))}
    return service.http.post("/feeds", files=files, data={"options": options}, **arguments)


def opened(service: ServiceUnderTest, options: str = "{}", **arguments: Any) -> str:
    response = posted(service, options, **arguments)
    assert response.status_code == 201, response.text
    assert response.headers["location"] == f"/feeds/{response.json()['id']}"
    return str(response.json()["id"])


def followed(service: ServiceUnderTest, **arguments: Any) -> str:
    """A feed that a worker follows."""
    feed_id = opened(service, **arguments)
    wait_until(lambda: any(each.feed_id == feed_id for each in service.queue.workers()))
    return feed_id


def actions(service: ServiceUnderTest) -> list[tuple[str, str]]:
    lines = (service.store.data_dir / AUDIT_FILE).read_text().splitlines()
    return [(each["action"], each["job_id"]) for each in map(json.loads, lines) if each["action"].startswith("feed-")]


def test_an_opened_feed_is_shown_without_its_password(service: ServiceUnderTest) -> None:
    options = '{"source": "rtsp://user:secret@camera.example.org/1", "label": "room 4", "keep_s": 120, "layout": "sbs"}'
    feed_id = opened(service, options)
    response = service.http.get(f"/feeds/{feed_id}")
    feed = response.json()
    assert (feed["id"], feed["label"], feed["wish"]) == (feed_id, "room 4", "run")
    assert (feed["state"], feed["reason"]) == ("connecting", "no_worker")
    assert feed["options"]["source"] == "rtsp://camera.example.org/1"
    assert feed["options"]["keep_s"] == 120
    assert "secret" not in response.text
    assert feed["links"]["render"] == f"/render?scene={feed_id}"
    assert service.http.get("/feeds").json() == [feed]
    record = service.queue.feed(feed_id)
    assert record is not None
    assert record.options.source == "rtsp://user:secret@camera.example.org/1"
    assert (record.calibration, record.calibration_name) == (RECTIFIED, "calibration.json")
    assert not service.spooled()
    assert actions(service) == [("feed-opened", feed_id)]


def test_a_feed_shows_what_its_worker_says(service: ServiceUnderTest, worker: FeedWorker) -> None:
    feed_id = followed(service)
    wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")
    feed = service.http.get(f"/feeds/{feed_id}").json()
    assert (feed["received_fps"], feed["used_fps"], feed["dropped"], feed["stored_bytes"]) == (30.0, 5.0, 7, 12345)
    assert feed["model_age_s"] >= 0.4
    assert feed["links"]["video"] == f"/feeds/{feed_id}/video"


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ('{"source": "rtsp://other.example.org/1"}', "options.source"),
        ('{"source": "camera"}', "options.source"),
        ('{"source": "/etc/passwd"}', "options.source"),
        ('{"source": "v4l2:///dev/video1"}', "options.source"),
        ('{"keep_s": 601}', "options.keep_s"),
        ('{"keep_s": 0}', "options.keep_s"),
        ('{"layout": "round"}', "options.layout"),
        ('{"sauce": "rtsp://camera.example.org/1"}', "options.sauce"),
    ],
)
def test_options_that_cannot_be_used_are_refused(service: ServiceUnderTest, options: str, field: str) -> None:
    problem = assert_problem(posted(service, options), 422, field)
    assert (problem.get("code") == "not_listed") == (field == "options.source")
    assert service.http.get("/feeds").json() == []


@pytest.mark.parametrize(
    "calibration",
    [
        *(("a.json", b"{}"), ("a.json", b"not json"), ("a.json", b"\0\1\2"), ("a.yaml", b"<!DOCTYPE x>")),
        *(("a.exe", b"{}"), ("a.xml", RECTIFIED.encode())),
    ],
)
def test_a_calibration_that_is_none_is_refused(service: ServiceUnderTest, calibration: tuple[str, bytes]) -> None:
    assert_problem(posted(service, calibration=calibration), 422, "calibration")


def test_a_feed_needs_a_calibration_and_nothing_else_belongs_to_it(service: ServiceUnderTest) -> None:
    only_options = service.http.post("/feeds", files={"options": (None, b"{}")})
    assert_problem(only_options, 422, "calibration")
    files = {"calibration": ("a.json", RECTIFIED.encode()), "clip": ("a.mp4", CLIP)}
    assert_problem(service.http.post("/feeds", files=files), 422, "clip")


def test_the_past_is_no_longer_than_the_installation_allows(tmp_path: Path) -> None:
    for service in running_service(tmp_path, feed_keep_s=60.0):
        assert service.http.get(f"/feeds/{opened(service)}").json()["options"]["keep_s"] == 60


def test_as_many_feeds_as_allowed_are_open(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_feeds=2, feeds_of_tenant=1):
        for tenant in ("ward-1", "ward-2"):
            key = bearer(service, tenant, MAY_ALL)
            opened(service, headers=key)
        assert_problem(posted(service, headers=key), 429, "feeds")
        assert_problem(posted(service, headers=bearer(service, "ward-3", MAY_ALL)), 503, "feeds")


def test_the_same_key_opens_the_same_feed(service: ServiceUnderTest) -> None:
    key = {"Idempotency-Key": "room-4"}
    feed_id = opened(service, headers=key)
    assert opened(service, headers=key) == feed_id
    assert_problem(posted(service, '{"width": 320}', headers=key), 422, "Idempotency-Key")
    another = opened(service, headers=key | bearer(service, "ward-2", MAY_ALL))
    assert another != feed_id


def test_changes_need_the_scope_and_another_tenants_feed_does_not_exist(
    service: ServiceUnderTest, worker: FeedWorker
) -> None:
    own, other = bearer(service, "ward-1", MAY_ALL), bearer(service, "ward-2", MAY_ALL)
    feed_id = followed(service, headers=own)
    viewer = bearer(service, "ward-1")
    assert service.http.get(f"/feeds/{feed_id}", headers=viewer).status_code == 200
    assert service.http.get("/render", params={"scene": feed_id}, headers=viewer).status_code == 200
    for method, path in [("POST", "/pause"), ("POST", "/resume"), ("POST", "/cut"), ("PUT", "/video"), ("DELETE", "")]:
        assert_problem(service.http.request(method, f"/feeds/{feed_id}{path}", headers=viewer), 403, "Authorization")
    for scopes in ({KeyScope.FEEDS}, {KeyScope.RECONSTRUCT}):  # a cut changes a feed and makes a job
        some = bearer(service, "ward-1", scopes)
        assert_problem(service.http.post(f"/feeds/{feed_id}/cut", headers=some), 403, "Authorization")
    assert_problem(posted(service, headers=viewer), 403, "Authorization")
    assert_problem(service.http.get(f"/feeds/{feed_id}", headers=other), 404, "feed_id")
    assert_problem(service.http.post(f"/feeds/{feed_id}/pause", headers=other), 404, "feed_id")
    assert_problem(service.http.request("DELETE", f"/feeds/{feed_id}", headers=other), 404, "feed_id")
    assert_problem(service.http.get("/render", params={"scene": feed_id}, headers=other), 404, "scene")
    assert service.http.get("/feeds", headers=other).json() == []
    record = service.queue.feed(feed_id)
    assert record is not None
    assert record.wish == "run"


def test_a_feed_is_paused_and_goes_on(service: ServiceUnderTest, worker: FeedWorker) -> None:
    feed_id = followed(service)
    paused = service.http.post(f"/feeds/{feed_id}/pause")
    assert (paused.status_code, paused.json()["state"], paused.json()["wish"]) == (200, "paused", "pause")
    resumed = service.http.post(f"/feeds/{feed_id}/resume")
    assert (resumed.status_code, resumed.json()["state"]) == (200, "live")
    assert actions(service)[1:] == [("feed-paused", feed_id), ("feed-resumed", feed_id)]


def test_a_pause_that_no_worker_has_done_says_so(
    service: ServiceUnderTest, worker: FeedWorker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.feeds.FOLLOWED_WITHIN_S", 0.05)
    worker.obeys = False
    feed_id = followed(service)
    paused = service.http.post(f"/feeds/{feed_id}/pause")
    assert (paused.status_code, paused.json()["state"], paused.json()["wish"]) == (202, "live", "pause")
    ended = service.http.delete(f"/feeds/{feed_id}")
    assert (ended.status_code, ended.json()["record"], ended.json()["verified"]) == (202, False, False)
    assert service.http.get(f"/feeds/{feed_id}").json()["wish"] == "end"


def test_a_feed_that_no_worker_follows_is_not_said_to_go_on(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.feeds.FOLLOWED_WITHIN_S", 0.05)
    resumed = service.http.post(f"/feeds/{opened(service)}/resume")
    assert (resumed.status_code, resumed.json()["reason"], resumed.json()["wish"]) == (202, "no_worker", "run")


def test_an_ended_feed_leaves_nothing_and_a_receipt_says_so(service: ServiceUnderTest, worker: FeedWorker) -> None:
    feed_id = followed(service)
    wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")
    assert service.http.get("/render", params={"scene": feed_id}).status_code == 200
    response = service.http.delete(f"/feeds/{feed_id}")
    receipt = response.json()
    assert response.status_code == 200
    assert (receipt["feed_id"], receipt["bytes"], receipt["record"], receipt["verified"]) == (
        feed_id,
        12345,
        True,
        True,
    )
    assert_problem(service.http.get(f"/feeds/{feed_id}"), 404, "feed_id")
    assert_problem(service.http.delete(f"/feeds/{feed_id}"), 404, "feed_id")
    assert_problem(service.http.get("/render", params={"scene": feed_id}), 404, "scene")
    assert actions(service)[-1] == ("feed-ended", feed_id)


def test_files_that_are_left_are_not_denied(service: ServiceUnderTest) -> None:
    feed_id = opened(service)
    (service.store.data_dir / "feeds" / feed_id).mkdir(parents=True)
    receipt = service.http.delete(f"/feeds/{feed_id}").json()
    assert (receipt["record"], receipt["verified"]) == (True, False)


def test_a_feed_whose_record_cannot_be_read_is_not_said_to_be_gone(
    service: ServiceUnderTest, worker: FeedWorker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.feeds.FOLLOWED_WITHIN_S", 0.05)
    worker.obeys = False
    feed_id, queue = followed(service), service.queue
    assert isinstance(queue, MemoryQueue)
    wished = queue.wish_feed

    def wish_and_spoil(feed_id: str, wish: FeedWish) -> None:
        wished(feed_id, wish)
        queue.stored_feeds.unreadable.add(feed_id)

    monkeypatch.setattr(queue, "wish_feed", wish_and_spoil)
    ended = service.http.delete(f"/feeds/{feed_id}")
    assert (ended.status_code, ended.json()["record"], ended.json()["verified"]) == (202, False, False)
    for method in ("GET", "DELETE"):
        assert "cannot be read" in assert_problem(service.http.request(method, f"/feeds/{feed_id}"), 503)["detail"]
    other = bearer(service, "ward-2", MAY_ALL)
    assert_problem(service.http.request("DELETE", f"/feeds/{feed_id}", headers=other), 404, "feed_id")


@pytest.mark.parametrize(
    ("t", "moment", "shown_s"),
    [
        (None, LIVE, 60),
        ("live", LIVE, 60),
        ("-12.5", FeedTime.before_live(12.5), 47.5),
        ("31.4", FeedTime.of_source(31.4), 31.4),
        ("2023-11-14T22:13:30Z", FeedTime.at(BEGAN_S + 10), 10),
    ],
)
def test_a_render_shows_a_moment_and_how_fresh_it_is(
    service: ServiceUnderTest, worker: FeedWorker, t: str | None, moment: FeedTime, shown_s: float
) -> None:
    feed_id = followed(service)
    response = service.http.get("/render", params={"scene": feed_id} | ({} if t is None else {"t": t}))
    assert response.status_code == 200, response.text
    assert response.content == b"picture"
    assert response.headers["x-intrasplat-state"] == worker.state
    assert float(response.headers["x-intrasplat-source-s"]) == pytest.approx(shown_s)
    assert float(response.headers["x-intrasplat-age-s"]) == pytest.approx(60.5 - shown_s)
    assert response.headers["x-intrasplat-captured-at"].startswith("2023-11-14T22:1")
    assert response.headers["cache-control"] == "no-store"
    assert "etag" not in response.headers
    (request,) = worker.asked
    assert isinstance(request, RenderRequest)
    assert (request.moment, request.attempt, request.newer_than_s) == (moment, None, None)


def test_all_of_a_feed_is_asked_of_its_own_worker_and_scenes_of_the_others(
    service: ServiceUnderTest, worker: FeedWorker
) -> None:
    scene, feed_id = service.finished_scene(), followed(service)
    for path in ("recorded", "measure", "export"):
        query = {"t": "-1", **({"points": "10,20"} if path == "measure" else {})}
        response = service.http.get(f"/scenes/{feed_id}/{path}", params=query)
        assert response.status_code == 200, response.text
    assert [type(each) for each in worker.asked] == [RecordedRequest, MeasureRequest, ExportRequest]
    assert {each.moment for each in worker.asked} == {FeedTime.before_live(1.0)}
    assert service.http.get("/render", params={"scene": scene, "t": "0.5"}).content == b"png"
    assert len(worker.asked) == 3
    assert len(service.painter.requests) == 1


@pytest.mark.parametrize(
    ("path", "query"),
    [
        ("/render?scene={scene}", "t=live"),
        ("/render?scene={scene}", "t=-1"),
        ("/scenes/{scene}/recorded?", "t=-1"),
        ("/scenes/{scene}/measure?points=1,2", "t=live"),
        ("/scenes/{scene}/export?", "t=2026-05-04T10:20:30Z"),
    ],
)
def test_a_scene_has_no_moments(service: ServiceUnderTest, path: str, query: str) -> None:
    answer = service.http.get(f"{path.format(scene=service.finished_scene())}&{query}")
    problem = assert_problem(answer, 422, "t")
    assert "first frame" in problem["remedy"]


@pytest.mark.parametrize("t", ["soon", "-700000", "2026-05-04T10:20:30", "-61"])
def test_what_is_no_moment_of_a_feed_is_refused(service: ServiceUnderTest, worker: FeedWorker, t: str) -> None:
    assert_problem(service.http.get("/render", params={"scene": followed(service), "t": t}), 422, "t")


def test_a_feed_that_nobody_follows_shows_nothing_yet(service: ServiceUnderTest) -> None:
    response = service.http.get("/render", params={"scene": opened(service)})
    assert_problem(response, 503, "scene")
    assert response.headers["retry-after"] == "1"
    assert not service.painter.requests


def test_a_feed_is_no_scene_of_the_lists_and_no_trainer(service: ServiceUnderTest, worker: FeedWorker) -> None:
    feed_id = followed(service)
    assert service.http.get("/scenes").json() == []
    assert_problem(service.http.get(f"/scenes/{feed_id}"), 404, "scene")
    for stored in ("scene", "html"):
        answer = service.http.get(f"/scenes/{feed_id}/export", params={"format": stored})
        assert "A live feed has no export" in assert_problem(answer, 404, "scene")["detail"]
    assert_problem(service.http.get(f"/scenes/{feed_id}/cameras"), 404, "scene")
    assert service.http.get("/readyz").json()["workers"] == ["worker-1"]
    service.queue.withdraw("worker-1")
    assert "No worker is ready" in assert_problem(service.http.get("/readyz"), 503, "worker")["detail"]


def test_the_events_of_a_feed_are_its_states_until_its_end(
    service: ServiceUnderTest, worker: FeedWorker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.events.POLL_PERIOD_S", 0.01)
    feed_id = followed(service)
    wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")

    def change() -> None:
        for state in (FeedState.STALLED, FeedState.LIVE):
            time.sleep(0.3)
            worker.state = state
        time.sleep(0.3)
        service.queue.wish_feed(feed_id, FeedWish.END)

    changing = threading.Thread(target=change)
    changing.start()
    response = service.http.get(f"/feeds/{feed_id}/events")
    changing.join()
    assert response.headers["content-type"].startswith("text/event-stream")
    events = [json.loads(line[6:]) for line in response.text.splitlines() if line.startswith("data: ")]
    assert "event: feed" in response.text
    states = [each["state"] for each in events]
    assert [state for at, state in enumerate(states) if at == 0 or states[at - 1] != state] == [
        "live",
        "stalled",
        "live",
    ]
    assert {each["id"] for each in events} == {feed_id}
    assert_problem(service.http.get(f"/feeds/{feed_id}/events"), 404, "feed_id")


def test_the_metrics_tell_of_feeds_without_their_labels(service: ServiceUnderTest, worker: FeedWorker) -> None:
    feed_id = followed(service, options='{"label": "patient Smith"}')
    wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")
    text = service.http.get("/metrics").text
    for line in (
        'intrasplat_feeds{state="live"} 1.0',
        f'intrasplat_feed_used_fps{{feed="{feed_id}"}} 5.0',
        f'intrasplat_feed_dropped_total{{feed="{feed_id}"}} 7.0',
        'intrasplat_workers{device="cpu",trains="yes"} 1.0',
    ):
        assert line in text
    assert "intrasplat_feed_reason{" not in text
    service.http.post(f"/feeds/{feed_id}/pause")
    paused = f'intrasplat_feed_reason{{feed="{feed_id}",reason="by_hand"}} 1.0'
    wait_until(lambda: paused in service.http.get("/metrics").text)
    assert "Smith" not in text
    assert 'trains="no"' not in text
