"""A worker waits for room on the disk, and a job that found none is handed back."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from contract.store.store import Store
from contract.wire.job import JobState
from intrasplat.errors import ErrorCode
from tests.worker.test_consume import JobLoop
from worker.disk_space import MAX_SHORTAGES, SPARE_BYTES, FreeSpace

MIN_FREE_BYTES = 400 * 2**20


@pytest.fixture
def free_bytes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """What the disk says it has free; change its only entry."""
    free = [2**40]
    monkeypatch.setattr(Store, "free_bytes", lambda store: free[0])
    return free


@pytest.fixture
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.disk_space.PAUSE_S", 0.0)


def test_after_a_shortage_jobs_pause_until_more_is_free(
    tmp_path: Path, free_bytes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    free_space = FreeSpace(Store(tmp_path), MIN_FREE_BYTES)
    free_bytes[0] = 2 * MIN_FREE_BYTES
    free_space.begins()
    assert free_space.ran_out("a")
    assert free_space.is_short()
    free_bytes[0] += SPARE_BYTES + 1
    assert not free_space.is_short()
    monkeypatch.setattr("worker.disk_space.PAUSE_S", 0.0)
    free_space.begins()
    assert free_space.ran_out("a")
    assert not free_space.is_short()


def test_jobs_begin_while_a_quarter_of_what_stays_free_is_there(tmp_path: Path, free_bytes: list[int]) -> None:
    free_space = FreeSpace(Store(tmp_path), MIN_FREE_BYTES)
    for free, is_short in ((MIN_FREE_BYTES, False), (MIN_FREE_BYTES // 4, False), (MIN_FREE_BYTES // 4 - 1, True)):
        free_bytes[0] = free
        assert free_space.is_short() is is_short


def test_after_a_shortage_no_job_begins_before_there_is_all_that_stays_free(
    tmp_path: Path, free_bytes: list[int]
) -> None:
    free_space = FreeSpace(Store(tmp_path), MIN_FREE_BYTES)
    free_bytes[0] = MIN_FREE_BYTES // 2
    free_space.begins()
    assert all(free_space.ran_out("a") for _ in range(2 * MAX_SHORTAGES))  # it never had enough
    assert free_space.is_short()
    free_bytes[0] = MIN_FREE_BYTES
    assert not free_space.is_short()
    free_space.sufficed("a")
    free_bytes[0] = MIN_FREE_BYTES // 2
    assert not free_space.is_short()


def test_a_job_that_finds_the_disk_full_although_it_had_enough_is_given_up_at_last(
    tmp_path: Path, free_bytes: list[int]
) -> None:
    free_space = FreeSpace(Store(tmp_path), MIN_FREE_BYTES)
    free_space.begins()
    assert [free_space.ran_out("a") for _ in range(MAX_SHORTAGES)] == [True] * (MAX_SHORTAGES - 1) + [False]
    assert free_space.ran_out("b")


def test_a_worker_claims_nothing_while_the_disk_is_short_and_goes_on_by_itself(
    tmp_path: Path, free_bytes: list[int]
) -> None:
    bench = JobLoop(tmp_path)
    free_bytes[0] = 0
    job_id = bench.submit("publish")
    bench.start()
    bench.child_id()
    time.sleep(0.5)
    waiting = bench.queue.get(job_id)
    free_bytes[0] = 2**40
    ended = bench.wait_for_end(job_id)
    bench.stop()
    bench.keeper.stop()
    assert waiting is not None
    assert (waiting.state, waiting.attempt) == (JobState.QUEUED, 0)
    assert (ended.state, ended.attempt) == (JobState.DONE, 1)


def test_a_job_that_finds_the_disk_full_runs_again_and_no_death_is_counted(tmp_path: Path, no_pause: None) -> None:
    bench = JobLoop(tmp_path)
    record = bench.outcome("full publish")
    bench.stop()
    bench.keeper.stop()
    assert (record.state, record.attempt, record.released) == (JobState.DONE, 2, 1)


def test_a_job_that_is_larger_than_the_disk_fails_as_such(tmp_path: Path, no_pause: None) -> None:
    bench = JobLoop(tmp_path)
    record = bench.outcome("full")
    bench.stop()
    bench.keeper.stop()
    assert (record.state, record.attempt) == (JobState.FAILED, MAX_SHORTAGES)
    assert record.error is not None
    assert record.error.code is ErrorCode.STORE_FULL
    assert "MiB were free when the job began" in record.error.problem
    assert "INTRASPLAT_MIN_FREE_BYTES" in str(record.error.remedy)


def test_a_job_that_is_retried_after_it_was_given_up_begins_anew(tmp_path: Path, free_bytes: list[int]) -> None:
    free_space = FreeSpace(Store(tmp_path), MIN_FREE_BYTES)
    free_space.begins()
    assert [free_space.ran_out("a") for _ in range(MAX_SHORTAGES)][-1] is False
    assert free_space.ran_out("a")
