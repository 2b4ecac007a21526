"""What a queue takes in: no job twice, and no more than may wait. In memory, on Valkey and on Redis."""

from __future__ import annotations

import pytest

from contract.queue.interface import Admission, Queue, QueueFullError
from contract.wire.job import JobState
from tests.contract.queues import claimed, job

# The same submission again


def test_a_second_submission_under_an_idempotency_key_is_answered_with_the_first(queue: Queue) -> None:
    first = queue.submit(job(idempotency_key="a" * 64))
    assert queue.submit(job(idempotency_key="a" * 64)) == first
    record, claim = claimed(queue)
    assert queue.submit(job(idempotency_key="a" * 64)) == record
    queue.finish(claim)
    assert queue.submit(job(idempotency_key="a" * 64)).state is JobState.DONE
    assert queue.claim("worker-1", 0.0) is None
    assert len(queue.records()) == 1


def test_idempotency_keys_of_other_tenants_other_keys_and_none_are_no_obstacle(queue: Queue) -> None:
    queue.submit(job(idempotency_key="a" * 64))
    others = [job(idempotency_key="a" * 64, tenant="ward-2"), job(idempotency_key="b" * 64), job(), job()]
    assert [queue.submit(other) for other in others] == others


def test_a_forgotten_job_frees_its_idempotency_key(queue: Queue) -> None:
    first = queue.submit(job(idempotency_key="a" * 64))
    queue.cancel(first.job_id)
    assert queue.forget(first.job_id)
    again = job(idempotency_key="a" * 64)
    assert queue.submit(again) == again


# Admission


def test_a_tenant_may_have_only_its_share_of_jobs_waiting(queue: Queue) -> None:
    admission = Admission(queued=10, queued_per_tenant=2)
    for _ in range(2):
        queue.submit(job(tenant="ward-1"), admission)
    refused = job(tenant="ward-1")
    with pytest.raises(QueueFullError) as raised:
        queue.submit(refused, admission)
    assert raised.value.tenant
    assert queue.get(refused.job_id) is None
    queue.submit(job(tenant="ward-2"), admission)
    claimed(queue)
    assert queue.submit(refused, admission) == refused


def test_all_tenants_together_may_have_only_so_many_jobs_waiting(queue: Queue) -> None:
    admission = Admission(queued=2, queued_per_tenant=2)
    first = queue.submit(job(tenant="ward-1", idempotency_key="a" * 64), admission)
    queue.submit(job(tenant="ward-2", priority="high"), admission)
    with pytest.raises(QueueFullError) as raised:
        queue.submit(job(tenant="ward-3"), admission)
    assert not raised.value.tenant
    assert queue.submit(job(tenant="ward-1", idempotency_key="a" * 64), admission) == first
    assert len(queue.records()) == 2
