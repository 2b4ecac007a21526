"""A clip that was accepted reaches the queue, whatever died or was away in between."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from contract.queue.interface import MAX_ATTEMPTS, Admission, Claim
from contract.store.store import Store
from contract.wire.job import JobRecord, JobState
from intrasplat.errors import UnavailableError
from intrasplat.names import MANIFEST, RESUME, SUBMISSION
from service.sweep import Sweep
from tests.memory_queue import MemoryQueue
from tests.service.under_test import ServiceUnderTest, assert_problem, running_service

PATIENCE_S = 10.0


class AbsentQueue(MemoryQueue):
    """Can be away; `loses` says that it does what it is told and its answer is lost."""

    is_away = False
    loses = False

    def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
        if self.is_away and not self.loses:
            raise UnavailableError("The queue does not answer.", "Start it.")
        standing = super().submit(record, admission)
        if self.is_away:
            raise UnavailableError("The queue does not answer.", "Start it.")
        return standing


def is_in(queue: MemoryQueue, job_id: str, state: JobState) -> bool:
    record = queue.get(job_id)
    return record is not None and record.state is state


def wait_until(is_so: Callable[..., bool], *arguments: object) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not is_so(*arguments):
        assert time.monotonic() < deadline, "the sweep did not do it"
        time.sleep(0.02)


@pytest.mark.parametrize("loses", [False, True])
def test_a_clip_accepted_while_the_queue_is_away_is_queued_once_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loses: bool
) -> None:
    monkeypatch.setattr("service.sweep.SWEEP_PERIOD_S", 0.05)
    queue = AbsentQueue()
    for service in running_service(tmp_path, queue):
        queue.is_away, queue.loses = True, loses
        refused = service.upload()
        problem = assert_problem(refused, 503, "queue")
        assert refused.headers["retry-after"]
        assert service.store.submission(problem["job_id"]) is not None
        queue.is_away = False
        wait_until(is_in, queue, problem["job_id"], JobState.QUEUED)
        assert len(queue.records()) == 1


def test_a_repeat_under_the_same_key_finds_the_job_that_the_sweep_queued(tmp_path: Path) -> None:
    queue = AbsentQueue()
    for service in running_service(tmp_path, queue):
        queue.is_away = True
        job_id = service.upload(headers={"Idempotency-Key": "k"}).json()["job_id"]
        queue.is_away = False
        Sweep(queue, service.store).settle()
        assert service.upload(headers={"Idempotency-Key": "k"}).json()["id"] == job_id
        assert service.store.spooled_ids() == [job_id]


def test_of_two_clips_under_one_key_the_sweep_keeps_one(tmp_path: Path) -> None:
    queue = AbsentQueue()
    for service in running_service(tmp_path, queue):
        queue.is_away = True
        for _ in range(2):
            service.upload(headers={"Idempotency-Key": "k"})
        assert len(service.store.spooled_ids()) == 2
        queue.is_away = False
        Sweep(queue, service.store).settle()
        (record,) = queue.records()
        assert service.store.spooled_ids() == [record.job_id]


def test_a_service_that_starts_queues_what_an_earlier_one_left(tmp_path: Path) -> None:
    for service in running_service(tmp_path):
        job_id = service.upload().json()["id"]
    emptied = MemoryQueue()
    for _ in running_service(tmp_path, emptied):
        wait_until(is_in, emptied, job_id, JobState.QUEUED)


def test_a_finished_scene_whose_record_was_lost_is_restored_and_not_run_again(tmp_path: Path) -> None:
    for service in running_service(tmp_path):
        scene = service.finished_scene()
    emptied, store = MemoryQueue(), Store(tmp_path)
    Sweep(emptied, store).settle()
    record = emptied.get(scene)
    assert record is not None
    assert (record.state, record.attempt) == (JobState.DONE, 1)
    assert (store.scene_folder(scene, record.attempt) / MANIFEST).is_file()


def test_the_sweep_may_run_as_often_as_it_likes(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    before = service.queue.get(job_id)
    for _ in range(3):
        Sweep(service.queue, service.store).settle()
    assert service.queue.get(job_id) == before


def test_the_clip_of_a_cancelled_job_goes_even_if_its_canceller_died(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    service.queue.cancel(job_id)
    Sweep(service.queue, service.store).settle()
    assert service.store.spooled_ids() == []


def test_a_submission_that_cannot_be_read_stops_no_other(tmp_path: Path) -> None:
    for service in running_service(tmp_path):
        ids = [service.upload().json()["id"] for _ in range(3)]
    (Store(tmp_path).spool_folder(ids[1]) / SUBMISSION).write_text("{")
    queue = MemoryQueue()
    Sweep(queue, Store(tmp_path)).settle()
    assert {record.job_id for record in queue.records()} == {ids[0], ids[2]}


def test_a_job_that_a_request_is_submitting_is_let_be(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    emptied = MemoryQueue()
    sweep = Sweep(emptied, service.store)
    with sweep.in_hand(job_id):
        sweep.settle()
        assert emptied.records() == []
    sweep.settle()
    assert [record.job_id for record in emptied.records()] == [job_id]


class WithdrawingQueue(MemoryQueue):
    """Its clip goes while a job is being submitted."""

    def __init__(self, store: Store) -> None:
        super().__init__()
        self._store = store

    def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
        self._store.purge(record.job_id)
        return super().submit(record, admission)


def test_a_job_whose_clip_was_withdrawn_meanwhile_is_taken_back(service: ServiceUnderTest) -> None:
    service.upload()
    queue = WithdrawingQueue(service.store)
    Sweep(queue, service.store).settle()
    assert queue.records() == []


def no_files_left(service: ServiceUnderTest, job_id: str) -> bool:
    """Neither the clip nor the attempts at a scene; they go one after the other."""
    return service.store.submission(job_id) is None and not service.store.scene_attempts(job_id)


def is_gone(path: Path) -> bool:
    return not path.exists()


def test_the_files_of_a_cancelled_job_go_even_if_its_worker_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.sweep.SWEEP_PERIOD_S", 0.05)
    queue = MemoryQueue(lease_s=0.0)
    for service in running_service(tmp_path, queue):
        job_id = service.upload().json()["id"]
        record = queue.claim("worker-1.dead", 0.0)
        assert record is not None
        (service.store.work_folder(job_id, record.attempt) / MANIFEST).write_text("{}")
        service.store.publish_scene(job_id, record.attempt)
        queue.cancel(job_id)
        assert queue.claim("worker-2", 0.0) is None  # which finds the lease run out
        assert is_in(queue, job_id, JobState.CANCELLED)
        wait_until(no_files_left, service, job_id)


def test_the_work_of_a_job_that_deaths_of_whole_workers_failed_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.sweep.SWEEP_PERIOD_S", 0.05)
    queue = MemoryQueue(lease_s=0.0)
    for service in running_service(tmp_path, queue):
        job_id = service.upload().json()["id"]
        for attempt in range(1, MAX_ATTEMPTS + 1):
            record = queue.claim(f"worker-{attempt}.dead", 0.0)  # which finds the lease of the one before run out
            assert record is not None
            kept = service.store.resume_folder(job_id, record.attempt)
            (kept / RESUME).write_text("x")
        assert queue.claim("worker-9", 0.0) is None
        assert is_in(queue, job_id, JobState.FAILED)
        wait_until(is_gone, kept)
        assert service.store.submission(job_id) is not None, "it may be retried"


def test_what_led_to_a_scene_goes_though_its_worker_died_when_the_job_was_done(tmp_path: Path) -> None:
    queue = MemoryQueue()
    for service in running_service(tmp_path, queue):
        job_id = service.upload().json()["id"]
        record = queue.claim("worker-1.dead", 60.0)
        assert record is not None
        assert record.owner is not None
        kept = service.store.resume_folder(job_id, record.attempt)
        (kept / RESUME).write_text("x")
        (service.store.work_folder(job_id, record.attempt) / MANIFEST).write_text("{}")
        service.store.publish_scene(job_id, record.attempt)
        assert queue.finish(Claim(job_id, record.attempt, record.owner))
        Sweep(queue, service.store).settle()
        assert not kept.exists()
        assert service.store.has_scene(job_id, record.attempt)


def test_a_job_that_cannot_be_queued_is_not_in_the_way_of_others(tmp_path: Path) -> None:
    class PickyQueue(MemoryQueue):
        refused = ""

        def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
            if record.job_id == self.refused:
                raise UnavailableError("The queue's record of this job cannot be read.", "Submit it anew.")
            return super().submit(record, admission)

    queue = PickyQueue()
    for service in running_service(tmp_path, queue):
        jobs = [service.upload().json()["id"] for _ in range(3)]
        for job_id in jobs:
            queue.cancel(job_id)
            queue.forget(job_id)
        queue.refused = jobs[1]
        Sweep(queue, service.store).settle()
        assert {record.job_id for record in queue.records()} == {jobs[0], jobs[2]}
        assert service.store.submission(jobs[1]) is not None
