"""The queue's promises, kept by both implementations: in memory, and on a real Valkey."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from contract.embedded import EmbeddedServer
from contract.errors import UnavailableError
from contract.job import JobError, JobFiles, JobOptions, JobProgress, JobRecord, JobState
from contract.queue import MAX_ATTEMPTS, Claim, Queue
from contract.queue_memory import MemoryQueue
from contract.queue_redis import PREFIX, RedisQueue
from contract.rendering import WorkerAddress
from contract.store import new_job_id

TRAINING = JobProgress(stage="train", fraction=0.5, iteration=10, iterations=20, psnr_db=31.5, seconds_left=4.0)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedServer]:
    server = EmbeddedServer(tmp_path_factory.mktemp("queue"))
    server.start()
    yield server
    server.stop()


@pytest.fixture(params=["memory", "valkey"])
def queue(request: pytest.FixtureRequest) -> Iterator[Queue]:
    if request.param == "memory":
        yield MemoryQueue()
        return
    server: EmbeddedServer = request.getfixturevalue("server")
    cleaner = redis.Redis.from_url(server.url)
    cleaner.flushall()
    cleaner.close()
    queue = RedisQueue(server.url)
    yield queue
    queue.close()


def job(created_at_s: float = 1000.0) -> JobRecord:
    files = JobFiles(clip="clip.mp4", calibration="calibration.json")
    return JobRecord(job_id=new_job_id(), files=files, options=JobOptions(seed=3), created_at_s=created_at_s)


def claimed(queue: Queue, owner: str = "worker-1") -> tuple[JobRecord, Claim]:
    record = queue.claim(owner, 1.0)
    assert record is not None
    return record, Claim(record.job_id, record.attempt, owner)


def state_of(queue: Queue, job_id: str) -> JobState:
    record = queue.get(job_id)
    assert record is not None
    return record.state


def test_a_job_goes_from_queued_through_running_to_done_and_keeps_what_was_submitted(queue: Queue) -> None:
    submitted = job()
    assert queue.submit(submitted)
    assert queue.get(submitted.job_id) == submitted
    record, claim = claimed(queue)
    assert (record.state, record.attempt, record.owner) == (JobState.RUNNING, 1, "worker-1")
    assert (record.options, record.files) == (submitted.options, submitted.files)
    assert queue.progress(claim, TRAINING)
    assert queue.finish(claim)
    finished = queue.get(submitted.job_id)
    assert finished is not None
    assert finished.state is JobState.DONE
    assert finished.progress == TRAINING
    assert finished.finished_at_s is not None
    assert finished.started_at_s is not None
    assert finished.finished_at_s >= finished.started_at_s


def test_submitting_the_same_job_twice_queues_it_once(queue: Queue) -> None:
    submitted = job()
    assert queue.submit(submitted)
    assert not queue.submit(submitted)
    _, claim = claimed(queue)
    assert queue.finish(claim)
    assert queue.claim("worker-1", 0.05) is None


def test_jobs_are_claimed_in_the_order_they_came_and_listed_newest_first(queue: Queue) -> None:
    jobs = [job(created_at_s=1000.0 + i) for i in range(3)]
    for record in jobs:
        queue.submit(record)
    order = []
    for _ in jobs:
        record, claim = claimed(queue)
        order.append(record.job_id)
        queue.finish(claim)
    assert order == [record.job_id for record in jobs]
    assert [record.job_id for record in queue.records()] == order[::-1]
    assert [record.job_id for record in queue.records(limit=1)] == order[:0:-1][:1]


def test_a_failed_job_says_why(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    error = JobError(problem="12 frames left, 11 right.", field="right", remedy="Give both eyes the same length.")
    assert queue.fail(claim, error)
    failed = queue.get(record.job_id)
    assert failed is not None
    assert (failed.state, failed.error) == (JobState.FAILED, error)


def test_cancelling_a_queued_job_ends_it_at_once_and_nobody_gets_it(queue: Queue) -> None:
    submitted = job()
    queue.submit(submitted)
    cancelled = queue.cancel(submitted.job_id)
    assert cancelled is not None
    assert cancelled.state is JobState.CANCELLED
    assert queue.claim("worker-1", 0.05) is None


def test_a_running_job_learns_of_its_cancellation_and_can_no_longer_become_done(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    asked = queue.cancel(record.job_id)
    assert asked is not None
    assert (asked.state, asked.cancel_requested) == (JobState.RUNNING, True)
    assert not queue.progress(claim, TRAINING)
    assert not queue.finish(claim)
    assert queue.confirm_cancel(claim)
    assert state_of(queue, record.job_id) is JobState.CANCELLED


@pytest.mark.parametrize("settle", ["finish", "fail", "confirm_cancel"])
def test_a_terminal_state_never_changes(queue: Queue, settle: str) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    if settle == "confirm_cancel":
        queue.cancel(record.job_id)
    {
        "finish": lambda: queue.finish(claim),
        "fail": lambda: queue.fail(claim, JobError(problem="x")),
        "confirm_cancel": lambda: queue.confirm_cancel(claim),
    }[settle]()
    settled = queue.get(record.job_id)
    assert settled is not None
    queue.cancel(record.job_id)
    queue.progress(claim, TRAINING)
    if settle != "finish":
        assert not queue.finish(claim)
    if settle != "fail":
        assert not queue.fail(claim, JobError(problem="y"))
    assert queue.get(record.job_id) == settled


def test_a_job_left_running_by_a_dead_worker_is_handed_to_the_next_process_of_its_name(queue: Queue) -> None:
    queue.submit(job())
    first, stale = claimed(queue)
    second, current = claimed(queue)
    assert (second.job_id, second.attempt) == (first.job_id, 2)
    assert not queue.progress(stale, TRAINING)
    assert not queue.finish(stale)
    assert queue.finish(current)


def test_a_job_that_kills_its_worker_every_time_fails_after_the_last_attempt(queue: Queue) -> None:
    queue.submit(job())
    record, _ = claimed(queue)
    for _ in range(MAX_ATTEMPTS - 1):
        claimed(queue)
    assert queue.claim("worker-1", 0.05) is None
    failed = queue.get(record.job_id)
    assert failed is not None
    assert failed.state is JobState.FAILED
    assert failed.error is not None
    assert "died 3 times" in failed.error.problem


def test_a_cancelled_job_whose_worker_died_is_handed_out_to_be_cleared_away(queue: Queue) -> None:
    queue.submit(job())
    for _ in range(MAX_ATTEMPTS):
        first, _ = claimed(queue)
    queue.cancel(first.job_id)
    record, claim = claimed(queue)
    assert (record.job_id, record.cancel_requested) == (first.job_id, True)
    assert not queue.finish(claim)
    assert not queue.fail(claim, JobError(problem="x"))
    assert queue.confirm_cancel(claim)
    assert state_of(queue, record.job_id) is JobState.CANCELLED


def test_a_job_that_nobody_cancelled_does_not_end_as_cancelled(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    assert not queue.confirm_cancel(claim)
    assert state_of(queue, record.job_id) is JobState.RUNNING


def test_a_released_job_is_queued_again_and_comes_first_to_its_worker_as_a_new_attempt(queue: Queue) -> None:
    queue.submit(job())
    first, stale = claimed(queue)
    queue.submit(job(created_at_s=1001.0))
    queue.progress(stale, TRAINING)
    assert queue.release(stale)
    waiting = queue.get(first.job_id)
    assert waiting is not None
    assert (waiting.state, waiting.progress, waiting.released) == (JobState.QUEUED, None, 1)
    assert not queue.finish(stale)
    second, current = claimed(queue)
    assert (second.job_id, second.attempt) == (first.job_id, 2)
    assert not queue.release(stale)
    assert queue.finish(current)


def test_polite_ends_are_not_held_against_a_job_and_deaths_are(queue: Queue) -> None:
    queue.submit(job())
    for _ in range(2 * MAX_ATTEMPTS):
        record, claim = claimed(queue)
        assert queue.release(claim)
    for _ in range(MAX_ATTEMPTS):
        claimed(queue)
    assert queue.claim("worker-1", 0.05) is None
    assert state_of(queue, record.job_id) is JobState.FAILED


def test_a_released_job_can_be_cancelled_and_a_cancelled_one_is_not_released(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    assert queue.release(claim)
    queue.cancel(record.job_id)
    assert state_of(queue, record.job_id) is JobState.CANCELLED
    assert queue.claim("worker-1", 0.05) is None
    queue.submit(job())
    record, claim = claimed(queue)
    queue.cancel(record.job_id)
    assert not queue.release(claim)
    assert queue.confirm_cancel(claim)


def test_another_worker_does_not_take_a_running_job(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    assert queue.claim("worker-2", 0.05) is None
    assert not queue.finish(Claim(record.job_id, 1, "worker-2"))
    assert queue.finish(claim)


def test_only_settled_jobs_are_forgotten(queue: Queue) -> None:
    submitted = job()
    queue.submit(submitted)
    assert not queue.forget(submitted.job_id)
    queue.cancel(submitted.job_id)
    assert queue.forget(submitted.job_id)
    assert queue.get(submitted.job_id) is None
    assert queue.records() == []
    assert queue.cancel(submitted.job_id) is None


def test_every_job_goes_to_exactly_one_of_several_workers(queue: Queue) -> None:
    for i in range(24):
        queue.submit(job(created_at_s=1000.0 + i))
    taken: list[str] = []

    def work(owner: str) -> None:
        while (record := queue.claim(owner, 0.05)) is not None:
            taken.append(record.job_id)
            queue.finish(Claim(record.job_id, record.attempt, owner))

    threads = [threading.Thread(target=work, args=(f"worker-{i}",)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(record.job_id for record in queue.records())


def test_live_workers_are_listed_until_they_withdraw(queue: Queue) -> None:
    address = WorkerAddress(name="worker-1", endpoint="ipc:///run/worker-1.sock", device="cpu")
    assert queue.workers() == []
    queue.announce(address)
    queue.announce(address)
    assert queue.workers() == [address]
    queue.withdraw("worker-1")
    assert queue.workers() == []


def test_a_settled_job_leaves_nothing_in_the_stream(server: EmbeddedServer) -> None:
    client = redis.Redis.from_url(server.url)
    client.flushall()
    queue = RedisQueue(server.url)
    for settle in (queue.finish, lambda claim: queue.fail(claim, JobError(problem="x"))):
        queue.submit(job())
        assert settle(claimed(queue)[1])
    queue.submit(job())
    record, claim = claimed(queue)
    queue.cancel(record.job_id)
    assert queue.confirm_cancel(claim)
    cancelled = job()
    queue.submit(cancelled)
    queue.cancel(cancelled.job_id)
    assert client.xlen(PREFIX + "jobs") == 0
    assert client.xpending(PREFIX + "jobs", "workers")["pending"] == 0
    queue.close()
    client.close()


def test_an_unreachable_queue_is_a_typed_error_with_a_remedy(tmp_path: Path) -> None:
    queue = RedisQueue(f"unix://{tmp_path / 'nobody.sock'}")
    with pytest.raises(UnavailableError, match="intrasplat up"):
        queue.ping()
    with pytest.raises(UnavailableError):
        queue.claim("worker-1", 0.0)
    queue.close()
