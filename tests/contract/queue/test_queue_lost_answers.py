"""A queue's answer that is lost on the way: the call is made again, and has no second effect."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import redis

from contract.queue.interface import Admission, Claim, Order, Queue
from contract.queue.redis_queue import PREFIX, RedisQueue
from contract.wire.job import JobRecord, JobState
from contract.wire.labels import LabelChange
from contract.wire.webhooks import DeliveryStatus, DeliveryTry
from tests.contract.queues import ERROR, TRAINING, LossyProxy, RunningServer, claimed, job, known, state_of

Act = Callable[[Queue], object]
Lost = Callable[[Queue], tuple[Act, str]]


def _submit(queue: Queue) -> tuple[Act, str]:
    record = job(idempotency_key="a" * 64)
    return lambda lossy: lossy.submit(record, Admission(1, 1)), record.job_id


def _claim(queue: Queue) -> tuple[Act, str]:
    record = queue.submit(job())
    queue.submit(job())
    return lambda lossy: lossy.claim("worker-1", 0.0), record.job_id


def _report(report: Callable[[Queue, Claim], object]) -> Lost:
    def given(queue: Queue) -> tuple[Act, str]:
        queue.submit(job())
        record, claim = claimed(queue)
        return lambda lossy: report(lossy, claim), record.job_id

    return given


def _yield(queue: Queue) -> tuple[Act, str]:
    queue.submit(job())
    record, claim = claimed(queue)
    queue.submit(job(priority="high"))
    return lambda lossy: lossy.beat(claim), record.job_id


def _confirm_cancel(queue: Queue) -> tuple[Act, str]:
    queue.submit(job())
    record, claim = claimed(queue)
    queue.cancel(record.job_id)
    return lambda lossy: lossy.confirm_cancel(claim), record.job_id


def _cancel(queue: Queue) -> tuple[Act, str]:
    record = queue.submit(job())
    return lambda lossy: lossy.cancel(record.job_id), record.job_id


def _retry(queue: Queue) -> tuple[Act, str]:
    queue.submit(job())
    record, claim = claimed(queue)
    queue.fail(claim, ERROR)
    return lambda lossy: lossy.retry(record.job_id), record.job_id


def _relabel(queue: Queue) -> tuple[Act, str]:
    record = queue.submit(job())
    return lambda lossy: lossy.relabel(record.job_id, LabelChange(label="b")), record.job_id


def _restore(queue: Queue) -> tuple[Act, str]:
    record = job().model_copy(update={"state": JobState.DONE, "attempt": 1, "finished_at_s": 1060.0})
    return lambda lossy: lossy.restore(record), record.job_id


def _claim_delivery(queue: Queue) -> tuple[Act, str]:
    """Of two deliveries that are due, a repeated call claims one."""
    records = [queue.submit(job(callback_url="https://his.example/done")) for _ in range(2)]
    for record in records:
        queue.cancel(record.job_id)

    def claim(lossy: Queue) -> object:
        first, second = lossy.claim_delivery("a" * 32), queue.claim_delivery("b" * 32)
        return sorted(claim.delivery.job_id for claim in (first, second) if claim) == sorted(r.job_id for r in records)

    return claim, records[0].job_id


def _note(queue: Queue) -> tuple[Act, str]:
    record = queue.submit(job(callback_url="https://his.example/done"))
    queue.cancel(record.job_id)
    claim = queue.claim_delivery("a" * 32)
    assert claim is not None
    noted = claim.delivery.model_copy(update={"status": DeliveryStatus.DELIVERED, "tries": (DeliveryTry(at_s=1.0),)})
    return lambda lossy: lossy.record_try(claim, noted, None), record.job_id


def _again(queue: Queue) -> tuple[Act, str]:
    """A repeated call makes one delivery due, which is claimed once."""
    record = queue.submit(job(callback_url="https://his.example/done"))
    queue.cancel(record.job_id)
    claim = queue.claim_delivery("a" * 32)
    assert claim is not None
    queue.record_try(claim, claim.delivery.model_copy(update={"status": DeliveryStatus.FAILED}), None)

    def again(lossy: Queue) -> object:
        lossy.send_again(known(queue, record.job_id))
        return [queue.claim_delivery(token * 32) is not None for token in "bc"]

    return again, record.job_id


def _forget(queue: Queue) -> tuple[Act, str]:
    record = queue.submit(job())
    queue.cancel(record.job_id)
    return lambda lossy: lossy.forget(record.job_id), record.job_id


LOST_ANSWERS: dict[str, tuple[Lost, object, int]] = {
    # how the job comes to be, what the call answers, how many events the job has afterwards
    "submit": (_submit, JobRecord, 1),
    "claim": (_claim, JobRecord, 2),
    "beat": (_report(lambda queue, claim: queue.beat(claim, TRAINING)), Order.GO_ON, 3),
    "beat that is told to yield": (_yield, Order.YIELD, 2),
    "finish": (_report(lambda queue, claim: queue.finish(claim)), True, 3),
    "fail": (_report(lambda queue, claim: queue.fail(claim, ERROR)), True, 3),
    "release": (_report(lambda queue, claim: queue.release(claim)), True, 3),
    "release after a death": (_report(lambda queue, claim: queue.release(claim, died=True)), True, 3),
    "confirm_cancel": (_confirm_cancel, True, 4),
    "cancel": (_cancel, JobRecord, 2),
    "retry": (_retry, JobRecord, 4),
    "relabel": (_relabel, JobRecord, 2),
    "restore": (_restore, True, 1),
    "claim_delivery": (_claim_delivery, True, 2),
    "record_try": (_note, True, 2),
    "again": (_again, [True, False], 2),
    "forget": (_forget, True, 0),
}


@pytest.mark.parametrize("call", LOST_ANSWERS)
def test_a_call_whose_answer_is_lost_is_repeated_without_a_second_effect(
    own: RunningServer, tmp_path: Path, call: str
) -> None:
    proxy = LossyProxy(own.socket, tmp_path)
    queue, lossy = RedisQueue(own.url, preempt_after_s=0.0), RedisQueue(proxy.url, preempt_after_s=0.0)
    given, answer, events = LOST_ANSWERS[call]
    act, job_id = given(queue)
    proxy.lossy = True
    got = act(lossy)
    proxy.lossy = False
    assert proxy.lost == 2  # the first answer was lost, the second came through
    assert isinstance(got, JobRecord) if answer is JobRecord else got == answer
    assert got.job_id == job_id if isinstance(got, JobRecord) else True
    assert len(queue.events(job_id)) == events
    assert sum(map(len, map(own.client().xrange, (PREFIX + "jobs:high", PREFIX + "jobs:standard")))) == len(
        [record for record in queue.records() if record.state in (JobState.QUEUED, JobState.RUNNING)]
    )
    for each in (queue, lossy):
        each.close()
    proxy.close()


def test_a_job_retried_claimed_and_failed_again_is_not_retried_by_a_late_repetition(
    served: RedisQueue, client: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    served.submit(job())
    record, claim = claimed(served)
    served.fail(claim, ERROR)
    before = known(served, record.job_id)
    served.retry(record.job_id)
    served.fail(claimed(served)[1], ERROR)
    monkeypatch.setattr(served, "get", lambda job_id: before)  # what the repetition goes by
    served.retry(record.job_id)
    monkeypatch.undo()
    assert state_of(served, record.job_id) is JobState.FAILED
