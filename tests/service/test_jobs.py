"""Where a job stands, and how it is cancelled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from contract.wire.job import JobError, JobProgress
from tests.service.under_test import ServiceUnderTest, another_clip, assert_problem, running_service


def test_a_running_job_shows_stage_decibels_and_seconds_left(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    _, claim = service.claimed()
    service.queue.beat(claim, JobProgress(stage="train", fraction=0.4, psnr_db=33.1, seconds_left=20.0))
    job = service.http.get(f"/jobs/{job_id}").json()
    assert (job["state"], job["stage"], job["psnr_db"], job["seconds_left"]) == ("running", "train", 33.1, 20.0)
    assert [each["id"] for each in service.http.get("/jobs").json()] == [job_id]


def test_a_failed_job_tells_code_field_and_remedy(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    _, claim = service.claimed()
    service.queue.beat(claim, JobProgress(stage="train", fraction=0.4, seconds_left=20.0))
    error = {"code": "input", "problem": "no depth.", "field": "calibration", "remedy": "Check the baseline."}
    service.queue.fail(claim, JobError.model_validate(error))
    job = service.http.get(f"/jobs/{job_id}").json()
    assert (job["state"], job["fraction"], job["seconds_left"]) == ("failed", 0.4, None)
    assert job["error"] == error
    assert_problem(service.http.get("/render", params={"scene": job_id}), 409, "scene")
    assert_problem(service.http.delete(f"/jobs/{job_id}"), 409, "job_id")
    assert service.http.delete(f"/scenes/{job_id}").status_code == 200
    assert service.spooled() == []


def test_cancelling_ends_a_queued_job_and_removes_its_clip(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    assert service.http.delete(f"/jobs/{job_id}").json()["state"] == "cancelled"
    assert service.http.delete(f"/jobs/{job_id}").json()["state"] == "cancelled"
    assert service.spooled() == []


def test_cancelling_a_running_job_only_asks_its_worker(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    service.claimed()
    job = service.http.delete(f"/jobs/{job_id}").json()
    assert (job["state"], job["cancel_requested"]) == ("running", True)
    assert service.spooled() != []


def test_a_queued_job_shows_how_many_are_before_it(service: ServiceUnderTest) -> None:
    positions = [service.upload().json()["position"] for _ in range(3)]
    assert positions == [0, 1, 2]
    last = service.http.get("/jobs").json()[0]["id"]
    assert service.http.get(f"/jobs/{last}").json()["position"] == 2


def test_jobs_are_listed_by_state_newest_first_and_no_more_than_asked_for(service: ServiceUnderTest) -> None:
    ids = [service.upload().json()["id"] for _ in range(4)]
    service.claimed()
    running = [job["id"] for job in service.http.get("/jobs", params={"state": "running"}).json()]
    queued = [job["id"] for job in service.http.get("/jobs", params={"state": "queued", "limit": 2}).json()]
    assert running == ids[:1]
    assert queued == [ids[3], ids[2]]
    assert_problem(service.http.get("/jobs", params={"state": "lost"}), 422, "state")
    assert_problem(service.http.get("/jobs", params={"limit": 0}), 422, "limit")


def test_a_list_that_has_not_changed_is_not_sent_again(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    known = {"If-None-Match": service.http.get("/jobs").headers["etag"]}
    same = service.http.get("/jobs", headers=known)
    assert (same.status_code, same.content) == (304, b"")
    service.claimed()
    changed = service.http.get("/jobs", headers=known)
    assert [job["state"] for job in changed.json() if job["id"] == job_id] == ["running"]


def test_a_failed_job_is_tried_again_when_asked_and_no_other_is(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    assert_problem(service.http.post(f"/jobs/{job_id}/retry"), 409, "job_id")
    _, claim = service.claimed()
    service.queue.fail(claim, JobError(problem="no depth."))
    assert service.http.get(f"/jobs/{job_id}").json()["links"]["retry"] == f"/jobs/{job_id}/retry"
    retried = service.http.post(f"/jobs/{job_id}/retry")
    assert (retried.status_code, retried.json()["state"], retried.json()["error"]) == (202, "queued", None)
    assert service.claimed()[0].job_id == job_id
    assert_problem(service.http.post(f"/jobs/{'0' * 32}/retry"), 404, "job_id")


def test_a_job_whose_clip_is_gone_cannot_be_tried_again(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    _, claim = service.claimed()
    service.queue.fail(claim, JobError(problem="no depth."))
    service.store.purge(job_id)
    assert_problem(service.http.post(f"/jobs/{job_id}/retry"), 409, "job_id")


def test_the_same_idempotency_key_is_the_same_job_and_leaves_one_clip(service: ServiceUnderTest) -> None:
    key = {"Idempotency-Key": "Smith-1"}
    first, again = service.upload(headers=key), service.upload(headers=key)
    assert again.status_code == 202
    assert again.json()["id"] == first.json()["id"]
    assert again.headers["location"] == first.headers["location"]
    assert service.store.spooled_ids() == [first.json()["id"]]
    assert "Smith" not in "".join(path.read_text(errors="replace") for path in service.store.data_dir.rglob("*.json"))


def test_the_same_idempotency_key_with_anything_else_is_refused(service: ServiceUnderTest) -> None:
    key = {"Idempotency-Key": "k"}
    job_id = service.upload(headers=key).json()["id"]
    assert_problem(service.upload('{"seed": 1}', headers=key), 422, "Idempotency-Key")
    assert_problem(
        service.upload(parts={"clip": ("a.mp4", another_clip(b"another"))}, headers=key), 422, "Idempotency-Key"
    )
    assert service.store.spooled_ids() == [job_id]
    assert_problem(service.upload(headers={"Idempotency-Key": "k" * 201}), 422, "idempotency-key")


@pytest.mark.parametrize(("limits", "status"), [({"max_queued_per_tenant": 2}, 429), ({"max_queued": 2}, 503)])
def test_a_queue_that_is_full_says_when_to_come_again_and_keeps_no_clip(
    tmp_path: Path, limits: dict[str, Any], status: int
) -> None:
    for service in running_service(tmp_path, **limits):
        accepted = [service.upload().json()["id"] for _ in range(2)]
        refused = service.upload()
        assert_problem(refused, status, "queue")
        assert int(refused.headers["retry-after"]) > 0
        assert service.store.spooled_ids() == sorted(accepted)
