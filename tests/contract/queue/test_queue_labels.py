"""What stands beside a record in the queue, its labels and its trace, and records page by page."""

from __future__ import annotations

from contract.queue.interface import Queue, place_of
from contract.wire.labels import LabelChange, Labels
from tests.contract.queues import claimed, job, known


def test_labels_change_in_every_state_and_earlier_events_have_the_new_ones(queue: Queue) -> None:
    submitted = job().model_copy(update={"labels": Labels(label="a", metadata={"b": "c"})})
    assert queue.submit(submitted).labels == submitted.labels
    record, claim = claimed(queue)
    assert record.labels == submitted.labels
    changed = queue.relabel(record.job_id, LabelChange(label=None))
    assert changed is not None
    assert changed.labels == Labels(metadata={"b": "c"})
    queue.finish(claim)
    queue.relabel(record.job_id, LabelChange(metadata={"d": "e"}))
    assert known(queue, record.job_id).labels == Labels(metadata={"d": "e"})
    events = queue.events(record.job_id)
    assert [event.record.labels for event in events] == [Labels(metadata={"d": "e"})] * 5
    assert queue.relabel("0" * 32, LabelChange(label="x")) is None


def test_a_page_of_records_begins_after_a_place_and_ties_are_ordered(queue: Queue) -> None:
    for i in range(6):
        queue.submit(job(1000.0 + i // 2))
    every = queue.records()
    assert [record for record in every if place_of(record) < place_of(every[1])] == every[2:]
    assert queue.records("ward-1", 3, place_of(every[1])) == every[2:5]
    assert queue.records(None, None, place_of(every[2])) == every[3:]
    assert queue.records("ward-1", 3, place_of(every[-1])) == []


def test_whoever_claims_a_job_gets_the_trace_of_the_request_that_submitted_it(queue: Queue) -> None:
    trace = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
    queue.submit(job().model_copy(update={"trace": trace}))
    record, claim = claimed(queue)
    assert record.trace == trace
    assert queue.release(claim)
    assert claimed(queue)[0].trace == trace
