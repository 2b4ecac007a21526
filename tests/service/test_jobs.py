"""Where a job stands, and how it is cancelled."""

from __future__ import annotations

from contract.job import JobError, JobProgress
from tests.service.house import House, assert_problem


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
