"""Cuts of live feeds over HTTP: a job each, with the calibration of its feed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from contract.wire.rendering import CutRequest
from intrasplat.live.times import FeedTime, FeedTimeKind
from tests.service.feed_worker import BEGAN_S, FeedWorker, following, wait_until
from tests.service.test_feeds import RECTIFIED, actions, followed
from tests.service.under_test import CLIP, ServiceUnderTest, assert_problem, running_service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[ServiceUnderTest]:
    yield from running_service(tmp_path, feed_keep_s=600.0)


@pytest.fixture
def worker(service: ServiceUnderTest) -> Iterator[FeedWorker]:
    with following(service.queue, service.store.run_dir, CLIP) as worker:
        yield worker


def test_a_cut_becomes_a_job_with_the_calibration(service: ServiceUnderTest, worker: FeedWorker) -> None:
    feed_id = followed(service, options='{"layout": "sbs"}')
    wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")
    given = {"from": -30, "to": "2023-11-14T22:14:20Z", "options": {"budget_s": 20}, "label": "the bleeding"}
    response = service.http.post(f"/feeds/{feed_id}/cut", json=given)
    assert response.status_code == 202, response.text
    job = response.json()
    assert response.headers["location"] == f"/jobs/{job['id']}"
    assert (job["state"], job["label"], job["options"]["layout"]) == ("queued", "the bleeding", "sbs")
    assert job["cut"] == {"from_s": BEGAN_S + 30, "to_s": BEGAN_S + 60, "frames": 900, "is_whole": True}
    requests = [each for each in worker.asked if isinstance(each, CutRequest)]
    assert {(each.begins, each.ends) for each in requests} == {(FeedTime.at(BEGAN_S + 30), FeedTime.at(BEGAN_S + 60))}
    assert [each.part for each in requests] == [0, 1, 2]
    folder = service.store.spool_folder(job["id"])
    assert (folder / "clip.mp4").read_bytes() == CLIP
    assert (folder / "calibration.json").read_text() == RECTIFIED
    assert ("feed-cut", feed_id) in actions(service)


def test_a_cut_until_live_ends_with_the_newest_pairs(service: ServiceUnderTest, worker: FeedWorker) -> None:
    feed_id = followed(service)
    wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")
    response = service.http.post(f"/feeds/{feed_id}/cut", json={"from": 20})
    assert response.status_code == 202, response.text
    (asked,) = {(each.begins, each.ends) for each in worker.asked if isinstance(each, CutRequest)}
    assert asked[0] == FeedTime.of_source(20)  # which its worker finds where the clock has jumped, too
    assert asked[1].kind is FeedTimeKind.UNIX
    assert 60 <= asked[1].seconds - BEGAN_S < 65


def test_a_cut_of_too_many_frames_is_refused_with_the_seconds_that_are_possible(tmp_path: Path) -> None:
    running = contextmanager(running_service)(tmp_path, feed_keep_s=600.0, max_frames=600)
    with running as service, following(service.queue, service.store.run_dir, CLIP):
        feed_id = followed(service)
        wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")
        answer = service.http.post(f"/feeds/{feed_id}/cut", json={"from": -30, "to": "2023-11-14T22:14:20Z"})
        assert "at most 17 s" in assert_problem(answer, 413, "from")["remedy"]
        assert not service.spooled()


@pytest.mark.parametrize(
    ("given", "status", "field"),
    [
        ({"from": "then"}, 422, "from"),
        ({"from": None}, 422, "from"),
        ({"from": -10, "to": -20}, 422, "from"),
        ({"from": -10, "to": "then"}, 422, "to"),
        ({"from": 0, "to": "2027-01-01T00:00:00Z"}, 413, "from"),
        ({"from": -100, "to": -1}, 422, "from"),  # before the recording: its worker says so
        ({"from": -10, "to": -1, "options": {"preset": "best"}}, 422, "options.preset"),
        ({"from": -10, "to": -1, "label": "x" * 100}, 422, "label"),
        ({}, 422, "from"),
    ],
)
def test_a_cut_of_nothing_is_refused(
    service: ServiceUnderTest, worker: FeedWorker, given: dict[str, Any], status: int, field: str
) -> None:
    feed_id = followed(service)
    wait_until(lambda: service.http.get(f"/feeds/{feed_id}").json()["state"] == "live")
    assert_problem(service.http.post(f"/feeds/{feed_id}/cut", json=given), status, field)
    assert not service.spooled()
