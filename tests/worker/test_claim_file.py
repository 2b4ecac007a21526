"""What a worker held when it was killed is given back by the next one of its name, once and to nobody's harm."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.queue.interface import Claim
from contract.store.store import Store
from contract.wire.job import JobState
from intrasplat.errors import UnavailableError
from tests.memory_queue import MemoryQueue
from tests.worker.jobs import Jobs
from worker.claim_file import ClaimFile

OWNER = "worker-1.a"


@pytest.fixture
def jobs(tmp_path: Path) -> Jobs:
    return Jobs(MemoryQueue(), Store(tmp_path))


def claimed(jobs: Jobs) -> Claim:
    jobs.submit("publish")
    record = jobs.queue.claim(OWNER, 0.0)
    assert record is not None
    return Claim(record.job_id, record.attempt, OWNER)


def test_a_killed_workers_claim_is_given_back_once_as_a_death(jobs: Jobs, tmp_path: Path) -> None:
    claim = claimed(jobs)
    ClaimFile(tmp_path / "claim").note(claim)
    assert ClaimFile(tmp_path / "claim").give_back(jobs.queue)
    assert jobs.state(claim.job_id) is JobState.QUEUED
    assert not ClaimFile(tmp_path / "claim").give_back(jobs.queue)
    again = jobs.queue.claim("worker-1.b", 0.0)
    assert again is not None
    assert (again.job_id, again.attempt) == (claim.job_id, 2)


def test_a_job_that_another_worker_has_taken_meanwhile_is_left_to_it(jobs: Jobs, tmp_path: Path) -> None:
    held, claim = ClaimFile(tmp_path / "claim"), claimed(jobs)
    held.note(claim)
    jobs.queue.release(claim)
    assert jobs.queue.claim("worker-2.a", 0.0) is not None
    assert not held.give_back(jobs.queue)
    record = jobs.record(claim.job_id)
    assert (record.state, record.owner) == (JobState.RUNNING, "worker-2.a")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"job_id": 1}'])
def test_a_file_that_holds_no_claim_is_passed_over(content: str, jobs: Jobs, tmp_path: Path) -> None:
    claim = claimed(jobs)
    (tmp_path / "claim").write_text(content)
    assert not ClaimFile(tmp_path / "claim").give_back(jobs.queue)
    assert jobs.state(claim.job_id) is JobState.RUNNING


def test_a_queue_that_is_away_leaves_the_claim_to_its_lease(
    jobs: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, claim = ClaimFile(tmp_path / "claim"), claimed(jobs)
    held.note(claim)

    def away(*arguments: object, **named: object) -> bool:
        raise UnavailableError("It is away.", "Wait.")

    monkeypatch.setattr(jobs.queue, "release", away)
    assert not held.give_back(jobs.queue)
    assert jobs.state(claim.job_id) is JobState.RUNNING


def test_a_note_that_cannot_be_removed_does_not_end_the_worker(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "claim").mkdir()  # unlink() refuses a folder
    ClaimFile(tmp_path / "claim").forget()
    assert "was not removed" in caplog.text
