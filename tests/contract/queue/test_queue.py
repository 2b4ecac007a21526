"""The queue's promises, kept in memory, on Valkey and on Redis."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from contract.queue.interface import (
    MAX_ATTEMPTS,
    MAX_EVENTS,
    Claim,
    Order,
    Queue,
)
from contract.store.shelf import new_job_id
from contract.wire.job import JobRecord, JobState
from contract.wire.rendering import WorkerAddress
from intrasplat.options import JobOptions
from tests.contract.queues import ERROR, TRAINING, claimed, job, known, state_of

# From submission to the end


def test_a_job_goes_from_queued_through_running_to_done_and_keeps_what_was_submitted(queue: Queue) -> None:
    submitted = job()
    assert queue.submit(submitted) == submitted
    assert queue.get(submitted.job_id) == submitted
    record, claim = claimed(queue)
    assert (record.state, record.attempt, record.owner) == (JobState.RUNNING, 1, "worker-1")
    assert (record.options, record.files, record.tenant) == (submitted.options, submitted.files, submitted.tenant)
    assert queue.get(record.job_id) == record
    assert queue.beat(claim, TRAINING) is Order.GO_ON
    assert queue.finish(claim)
    finished = known(queue, submitted.job_id)
    assert (finished.state, finished.progress) == (JobState.DONE, TRAINING)
    assert finished.finished_at_s is not None
    assert finished.started_at_s is not None
    assert finished.finished_at_s >= finished.started_at_s


def test_submitting_the_same_job_twice_queues_it_once_and_answers_with_its_record(queue: Queue) -> None:
    submitted = job()
    queue.submit(submitted)
    assert queue.submit(submitted) == submitted
    record, claim = claimed(queue)
    assert queue.submit(submitted) == record
    assert queue.finish(claim)
    assert queue.claim("worker-1", 0.0) is None


def test_a_failed_job_says_why(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    assert queue.fail(claim, ERROR)
    assert (state_of(queue, record.job_id), known(queue, record.job_id).error) == (JobState.FAILED, ERROR)


def test_jobs_are_claimed_in_the_order_they_came_and_listed_newest_first(queue: Queue) -> None:
    jobs = [queue.submit(job(1000.0 + i)).job_id for i in range(3)]
    order = []
    for _ in jobs:
        record, claim = claimed(queue)
        order.append(record.job_id)
        queue.finish(claim)
    assert order == jobs
    assert [record.job_id for record in queue.records()] == jobs[::-1]
    assert [record.job_id for record in queue.records(limit=1)] == jobs[:1:-1]
    assert [record.job_id for record in queue.records(limit=None)] == jobs[::-1]
    assert queue.records(limit=0) == []


def test_a_tenant_lists_its_own_jobs(queue: Queue) -> None:
    mine, other = queue.submit(job(tenant="ward-1")), queue.submit(job(tenant="ward-2"))
    assert queue.records("ward-1") == [mine]
    assert queue.records("ward-2") == [other]
    assert queue.records("ward-3") == []


def test_high_priority_is_claimed_before_standard(queue: Queue) -> None:
    first, second = queue.submit(job()), queue.submit(job())
    urgent = [queue.submit(job(priority="high")) for _ in range(2)]
    expected = [record.job_id for record in [*urgent, first, second]]
    assert [claimed(queue, f"worker-{i}")[0].job_id for i in range(4)] == expected


def test_every_job_goes_to_exactly_one_of_several_workers(queue: Queue) -> None:
    taken: list[str] = []

    def work(owner: str) -> None:
        while (record := queue.claim(owner, 0.5)) is not None:
            taken.append(record.job_id)
            queue.finish(Claim(record.job_id, record.attempt, owner))

    threads = [threading.Thread(target=work, args=(f"worker-{i}",)) for i in range(4)]
    for thread in threads:
        thread.start()
    submitted = [queue.submit(job(1000.0 + i)).job_id for i in range(24)]
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(submitted)


# Cancel, and what never changes


def test_cancelling_a_queued_job_ends_it_at_once_and_nobody_gets_it(queue: Queue) -> None:
    submitted = queue.submit(job())
    cancelled = queue.cancel(submitted.job_id)
    assert cancelled is not None
    assert cancelled.state is JobState.CANCELLED
    assert cancelled.finished_at_s is not None
    assert queue.claim("worker-1", 0.0) is None


def test_a_running_job_learns_of_its_cancellation_and_can_only_end_as_cancelled(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    asked = queue.cancel(record.job_id)
    assert asked is not None
    assert (asked.state, asked.cancel_requested) == (JobState.RUNNING, True)
    assert queue.beat(claim, TRAINING) is Order.CANCEL
    assert not queue.finish(claim)
    assert not queue.fail(claim, ERROR)
    assert not queue.release(claim)
    assert not queue.release(claim, died=True)
    assert queue.confirm_cancel(claim)
    assert state_of(queue, record.job_id) is JobState.CANCELLED


def test_a_job_that_nobody_cancelled_does_not_end_as_cancelled(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    assert not queue.confirm_cancel(claim)
    assert state_of(queue, record.job_id) is JobState.RUNNING


def test_a_released_job_can_be_cancelled(queue: Queue) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    assert queue.release(claim)
    queue.cancel(record.job_id)
    assert state_of(queue, record.job_id) is JobState.CANCELLED
    assert queue.claim("worker-1", 0.0) is None


@pytest.mark.parametrize("settle", ["finish", "fail", "confirm_cancel"])
def test_a_terminal_state_is_confirmed_to_who_brought_it_about_and_never_changes(queue: Queue, settle: str) -> None:
    queue.submit(job())
    record, claim = claimed(queue)
    if settle == "confirm_cancel":
        queue.cancel(record.job_id)
    settles = {
        "finish": lambda: queue.finish(claim),
        "fail": lambda: queue.fail(claim, ERROR),
        "confirm_cancel": lambda: queue.confirm_cancel(claim),
    }
    assert settles[settle]()
    settled, events = known(queue, record.job_id), queue.events(record.job_id)
    queue.cancel(record.job_id)
    assert queue.beat(claim, TRAINING) is Order.LOST
    assert not queue.release(claim)
    assert not queue.release(claim, died=True)
    assert {name: again() for name, again in settles.items()} == {name: name == settle for name in settles}
    assert known(queue, record.job_id) == settled
    assert queue.events(record.job_id) == events


# Again, back and gone


def test_a_failed_job_that_is_retried_is_queued_last_with_its_deaths_forgiven(queue: Queue) -> None:
    queue.submit(job())
    for _ in range(MAX_ATTEMPTS):
        record, claim = claimed(queue)
        queue.release(claim, died=True)
    other = queue.submit(job())
    retried = queue.retry(record.job_id)
    assert retried is not None
    assert (retried.state, retried.error, retried.released) == (JobState.QUEUED, None, MAX_ATTEMPTS)
    assert (retried.started_at_s, retried.finished_at_s) == (None, None)
    assert not queue.finish(claim)
    assert claimed(queue, "worker-2")[0].job_id == other.job_id
    again, claim = claimed(queue, "worker-3")
    assert (again.job_id, again.attempt) == (record.job_id, MAX_ATTEMPTS + 1)
    assert queue.finish(claim)


def test_only_a_failed_job_is_retried(queue: Queue) -> None:
    submitted = queue.submit(job())
    assert queue.retry(submitted.job_id) == submitted
    record, claim = claimed(queue)
    assert queue.retry(record.job_id) == record
    queue.finish(claim)
    assert queue.retry(record.job_id) == known(queue, record.job_id)
    assert state_of(queue, record.job_id) is JobState.DONE
    assert queue.retry(new_job_id()) is None


def test_an_ended_job_that_the_queue_has_lost_is_put_back_once(queue: Queue) -> None:
    ended = {"state": JobState.DONE, "attempt": 2, "released": 1, "owner": "worker-1", "finished_at_s": 1060.5}
    lost = job(idempotency_key="a" * 64).model_copy(update={**ended, "started_at_s": 1000.25, "progress": TRAINING})
    assert queue.restore(lost)
    assert not queue.restore(lost)
    assert queue.get(lost.job_id) == lost
    assert queue.records(lost.tenant) == [lost]
    assert [event.record for event in queue.events(lost.job_id)] == [lost]
    assert queue.submit(lost) == lost
    assert queue.claim("worker-1", 0.0) is None
    assert queue.figures().ended[JobState.DONE] == 0


def test_a_failed_job_that_was_put_back_may_be_retried(queue: Queue) -> None:
    lost = job().model_copy(update={"state": JobState.FAILED, "attempt": 1, "error": ERROR, "finished_at_s": 1060.5})
    assert queue.restore(lost)
    assert queue.retry(lost.job_id) is not None
    record, claim = claimed(queue)
    assert (record.job_id, record.attempt) == (lost.job_id, 2)
    assert queue.finish(claim)


def test_a_job_that_has_not_ended_is_not_put_back(queue: Queue) -> None:
    with pytest.raises(ValueError, match="only ended jobs"):
        queue.restore(job())


def test_only_ended_jobs_are_forgotten_and_leave_nothing(queue: Queue) -> None:
    submitted = queue.submit(job())
    assert not queue.forget(submitted.job_id)
    _, claim = claimed(queue)
    assert not queue.forget(submitted.job_id)
    queue.finish(claim)
    assert queue.forget(submitted.job_id)
    assert not queue.forget(submitted.job_id)
    assert queue.get(submitted.job_id) is None
    assert queue.cancel(submitted.job_id) is None
    assert queue.records() == []
    assert queue.events(submitted.job_id) == []
    assert not queue.finish(claim)


# What is told about jobs, workers and the queue


def test_every_change_of_a_job_is_an_event_and_none_is_told_twice(queue: Queue) -> None:
    submitted = queue.submit(job())
    record, claim = claimed(queue)
    queue.beat(claim)
    queue.beat(claim, TRAINING)
    queue.beat(claim, TRAINING)
    queue.finish(claim)
    events = queue.events(record.job_id)
    assert [event.record.state for event in events] == ["queued", "running", "running", "done"]
    assert [event.record.progress for event in events] == [None, None, TRAINING, TRAINING]
    assert [event.record for event in events[:2]] == [submitted, record]
    assert events[-1].record == known(queue, record.job_id)
    for i, event in enumerate(events):
        assert queue.events(record.job_id, after=event.number) == events[i + 1 :]


@pytest.mark.parametrize("number", ["", "0", "-1", "1-2-3", "nonsense", "9" * 40, "(1", "٣"])
def test_after_a_number_that_no_event_has_all_is_told(queue: Queue, number: str) -> None:
    submitted = queue.submit(job())
    assert [event.record for event in queue.events(submitted.job_id, after=number)] == [submitted]


def test_the_last_events_of_a_job_are_kept(queue: Queue) -> None:
    submitted = queue.submit(job())
    _, claim = claimed(queue)
    for iteration in range(MAX_EVENTS + 5):
        queue.beat(claim, TRAINING.model_copy(update={"iteration": iteration}))
    events = queue.events(submitted.job_id)
    assert len(events) == MAX_EVENTS
    assert events[-1].record.progress is not None
    assert events[-1].record.progress.iteration == MAX_EVENTS + 4


def test_the_position_counts_the_jobs_that_will_be_claimed_before(queue: Queue) -> None:
    first, second = queue.submit(job()), queue.submit(job())
    urgent = queue.submit(job(priority="high"))
    positions = {record.job_id: queue.forecast(record.job_id).position for record in (first, second, urgent)}
    assert positions == {urgent.job_id: 0, first.job_id: 1, second.job_id: 2}
    record, claim = claimed(queue)
    assert queue.forecast(record.job_id).position is None
    assert queue.forecast(second.job_id).position == 1
    queue.finish(claim)
    for unknown in (record.job_id, new_job_id()):
        forecast = queue.forecast(unknown)
        assert (forecast.position, forecast.eta_s) == (None, None)


def test_the_end_of_a_job_is_estimated_from_those_that_were_done(queue: Queue) -> None:
    queue.submit(job())
    waiting = queue.submit(job())
    record, claim = claimed(queue)
    queue.announce(WorkerAddress(name="worker-1", endpoint="ipc:///run/worker-1.sock", device="cpu"))
    assert queue.forecast(record.job_id).eta_s is None
    assert queue.forecast(waiting.job_id).eta_s is None
    time.sleep(0.05)
    queue.finish(claim)
    done = known(queue, record.job_id)
    assert done.finished_at_s is not None
    assert done.started_at_s is not None
    last = queue.submit(job())
    usual_s = done.finished_at_s - done.started_at_s
    assert queue.forecast(waiting.job_id).eta_s == pytest.approx(usual_s, abs=1e-4)
    assert queue.forecast(last.job_id).eta_s == pytest.approx(2 * usual_s, abs=1e-4)
    budget_s = 60.0
    generous = queue.submit(job().model_copy(update={"options": JobOptions(budget_s=budget_s, priority="high")}))
    assert queue.forecast(generous.job_id).eta_s == budget_s
    _, claim = claimed(queue)
    queue.beat(claim, TRAINING)
    assert queue.forecast(generous.job_id).eta_s == TRAINING.seconds_left


def test_a_job_is_estimated_by_what_it_asks_for(queue: Queue) -> None:
    queue.announce(WorkerAddress(name="worker-1", endpoint="ipc:///run/worker-1.sock", device="cpu"))
    queue.submit(with_options(preset="instant"))
    record, claim = claimed(queue)
    time.sleep(0.05)
    assert queue.finish(claim)
    done = known(queue, record.job_id)
    assert done.finished_at_s is not None
    assert done.started_at_s is not None
    took_s = done.finished_at_s - done.started_at_s
    expected_s = {"instant": took_s, "fast": took_s + 54.5, "quality": took_s + 234.5, "paper": took_s}
    for preset, seconds in expected_s.items():
        waiting = queue.submit(with_options(preset=preset))
        assert queue.forecast(waiting.job_id).eta_s == pytest.approx(seconds, abs=1e-3)
        queue.cancel(waiting.job_id)
    counted = queue.submit(with_options(preset="quality", iterations=30))
    assert queue.forecast(counted.job_id).eta_s == pytest.approx(took_s, abs=1e-3)


def with_options(**options: Any) -> JobRecord:
    return job().model_copy(update={"options": JobOptions(**options)})


def test_the_figures_count_what_waits_runs_and_has_ended(queue: Queue) -> None:
    nothing = queue.figures()
    assert (nothing.queued, nothing.running, nothing.oldest_queued_s) == (0, 0, 0.0)
    assert nothing.ended == {JobState.DONE: 0, JobState.FAILED: 0, JobState.CANCELLED: 0}
    for _ in range(5):
        queue.submit(job())
    queue.finish(claimed(queue)[1])
    queue.fail(claimed(queue)[1], ERROR)
    cancelled, claim = claimed(queue)
    queue.cancel(cancelled.job_id)
    queue.confirm_cancel(claim)
    claimed(queue)
    time.sleep(0.01)
    figures = queue.figures()
    assert (figures.queued, figures.running) == (1, 1)
    assert figures.oldest_queued_s > 0.0
    assert figures.ended == {JobState.DONE: 1, JobState.FAILED: 1, JobState.CANCELLED: 1}


def test_live_workers_are_listed_by_name_until_they_withdraw(queue: Queue) -> None:
    addresses = [WorkerAddress(name=f"worker-{i}", endpoint="tcp://host:1", device="cpu") for i in range(2)]
    assert queue.workers() == []
    for address in reversed(addresses):
        queue.announce(address)
    moved = addresses[0].model_copy(update={"job_id": new_job_id(), "scenes": (new_job_id(),)})
    queue.announce(moved)
    assert queue.workers() == [moved, addresses[1]]
    queue.withdraw("worker-0")
    queue.withdraw("worker-0")
    assert queue.workers() == [addresses[1]]


def test_what_is_not_there_is_none(queue: Queue) -> None:
    unknown = new_job_id()
    assert queue.get(unknown) is None
    assert queue.cancel(unknown) is None
    assert queue.events(unknown) == []
    assert not queue.forget(unknown)
    assert queue.beat(Claim(unknown, 1, "worker-1")) is Order.LOST
    queue.ping()
