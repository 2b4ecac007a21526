"""Webhooks that are owed: from the very step in which a job ends, to one service at a time, until it is noted."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count

import pytest
import redis

from contract.queue import redis_deliveries
from contract.queue.deliveries import ClaimedDelivery
from contract.queue.interface import MAX_ATTEMPTS, Claim, Queue
from contract.queue.redis_queue import PREFIX, RedisQueue
from contract.wire.job import JobRecord, JobState
from contract.wire.webhooks import DeliveryStatus, DeliveryTry, TryFailure
from tests import memory_deliveries
from tests.contract.queues import ERROR, claimed, job, known

CALLBACK = "https://his.example/done"
TOKENS = (f"{number:032x}" for number in count())


def claim_due(queue: Queue, *skipped: str) -> ClaimedDelivery | None:
    return queue.claim_delivery(next(TOKENS), skipped)


def tried(queue: Queue, claim: ClaimedDelivery, failure: TryFailure | None, wait_s: float | None) -> bool:
    status = (
        DeliveryStatus.OWED if wait_s is not None else DeliveryStatus.FAILED if failure else DeliveryStatus.DELIVERED
    )
    tries = (*claim.delivery.tries, DeliveryTry(at_s=1.0, failure=failure))
    return queue.record_try(claim, claim.delivery.model_copy(update={"tries": tries, "status": status}), wait_s)


@pytest.fixture
def leases_of_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (memory_deliveries, redis_deliveries):
        monkeypatch.setattr(module, "DELIVERY_LEASE_S", 0.001)


def die(queue: Queue, claim: Claim) -> None:
    queue.release(claim, died=True)
    for _ in range(MAX_ATTEMPTS - 1):
        queue.release(claimed(queue)[1], died=True)


def cancel(queue: Queue, claim: Claim) -> None:
    queue.cancel(claim.job_id)
    queue.confirm_cancel(claim)


ENDS: dict[str, tuple[Callable[[Queue, Claim], object], JobState, str | None]] = {
    "done": (lambda queue, claim: queue.finish(claim), JobState.DONE, None),
    "failed": (lambda queue, claim: queue.fail(claim, ERROR), JobState.FAILED, "unclassified"),
    "failed by deaths": (die, JobState.FAILED, "attempts_exhausted"),
    "cancelled": (cancel, JobState.CANCELLED, None),
}


@pytest.mark.parametrize("end", ENDS)
def test_a_job_with_a_callback_owes_a_webhook_as_soon_as_it_has_ended_and_not_before(queue: Queue, end: str) -> None:
    act, state, code = ENDS[end]
    submitted = queue.submit(job(callback_url=CALLBACK))
    record, claim = claimed(queue)
    assert record.callback_url == submitted.callback_url == CALLBACK
    assert claim_due(queue) is None
    assert queue.deliveries(record.job_id) == []
    act(queue, claim)
    due = claim_due(queue)
    assert due is not None
    assert (due.url, due.tenant, due.delivery.job_id) == (CALLBACK, "ward-1", record.job_id)
    assert (due.delivery.state, due.delivery.error_code) == (state, code)
    assert claim_due(queue) is None


def test_a_queued_job_that_is_cancelled_owes_one_and_a_job_without_a_callback_owes_none(queue: Queue) -> None:
    first, second = queue.submit(job(callback_url=CALLBACK)), queue.submit(job())
    for record in (second, first):
        queue.cancel(record.job_id)
    claim = claim_due(queue)
    assert claim is not None
    assert claim.delivery.job_id == first.job_id
    assert claim_due(queue) is None
    assert queue.deliveries(second.job_id) == []


@pytest.mark.parametrize("damage", [{"priority": "low"}, {"state": "paused"}, {"document": "{"}])
def test_a_job_that_is_set_aside_because_its_record_is_damaged_owes_a_webhook(
    served: RedisQueue, client: redis.Redis, damage: dict[str, str]
) -> None:
    job_id = served.submit(job(callback_url=CALLBACK)).job_id
    client.hset(f"{PREFIX}job:{job_id}", mapping=damage)
    assert served.claim("worker-1", 0.0) is None
    claim = claim_due(served)
    assert claim is not None
    assert (claim.url, claim.tenant, claim.delivery.job_id) == (CALLBACK, "ward-1", job_id)
    assert (claim.delivery.state, claim.delivery.error_code) == (JobState.FAILED, "record_unreadable")
    assert claim.delivery.ended_at_s == pytest.approx(time.time(), abs=60.0)
    assert tried(served, claim, None, None)
    assert [each.status for each in served.deliveries(job_id)] == [DeliveryStatus.DELIVERED]
    assert served.forget(job_id)


def test_deliveries_that_cannot_be_read_are_given_up_at_once_and_logged_once_each(
    served: RedisQueue, client: redis.Redis, caplog: pytest.LogCaptureFixture
) -> None:
    damaged = [served.submit(job(callback_url=CALLBACK)).job_id for _ in range(3)]
    whole = served.submit(job(callback_url=CALLBACK)).job_id
    for job_id in (*damaged, whole):
        served.cancel(job_id)
    for job_id in damaged:
        client.hset(f"{PREFIX}deliveries:{job_id}", f"{job_id}.0.cancelled", '{"of": "a later version"}')
    claim = claim_due(served)
    assert claim is not None
    assert claim.delivery.job_id == whole
    assert [each.__dict__["job_id"] for each in caplog.records] == damaged
    assert claim_due(served) is None
    assert served.figures().webhooks == {DeliveryStatus.OWED: 1, DeliveryStatus.FAILED: 3}
    assert served.deliveries(damaged[0]) == []
    assert len(caplog.records) == len(damaged)


def test_what_earlier_workers_owe_in_one_set_of_all_tenants_is_claimed(served: RedisQueue, client: redis.Redis) -> None:
    owed = [served.submit(job(callback_url=CALLBACK, tenant=each)).job_id for each in ("a", "b")]
    for job_id, tenant in zip(owed, "ab", strict=True):
        served.cancel(job_id)
        client.rename(f"{PREFIX}tenant:{tenant}:owed", f"{PREFIX}own")
        client.zunionstore(f"{PREFIX}owed", [f"{PREFIX}owed", f"{PREFIX}own"])
        client.hdel(f"{PREFIX}owed-by", tenant)
    client.zadd(f"{PREFIX}owed", {"gone.1.done": 1.0})
    assert served.figures().webhooks == {DeliveryStatus.OWED: 0}
    claims = [claim for claim in (claim_due(served), claim_due(served)) if claim]
    assert [(claim.delivery.job_id, claim.tenant) for claim in claims] == list(zip(owed, "ab", strict=True))
    assert all(tried(served, claim, None, None) for claim in claims)
    assert not client.exists(f"{PREFIX}owed", f"{PREFIX}owed-by")


def test_a_failed_delivery_is_claimed_again_when_it_is_due_and_a_delivered_one_never(queue: Queue) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.cancel(job_id)
    first = claim_due(queue)
    assert first is not None
    assert tried(queue, first, TryFailure.TIMEOUT, 0.0)
    second = claim_due(queue)
    assert second is not None
    assert second.delivery.event_id == first.delivery.event_id
    assert [each.failure for each in second.delivery.tries] == [TryFailure.TIMEOUT]
    assert tried(queue, second, TryFailure.STATUS, 60.0)
    assert claim_due(queue) is None
    (delivery,) = queue.deliveries(job_id)
    assert len(delivery.tries) == 2
    assert delivery.next_try_at_s is not None
    assert queue.figures().webhooks == {DeliveryStatus.OWED: 1}


def test_a_delivery_that_is_claimed_has_no_next_try_until_the_claim_ends(queue: Queue) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.cancel(job_id)
    assert queue.deliveries(job_id)[0].next_try_at_s is not None
    claim = claim_due(queue)
    assert claim is not None
    assert [(each.status, each.next_try_at_s) for each in queue.deliveries(job_id)] == [(DeliveryStatus.OWED, None)]
    assert tried(queue, claim, TryFailure.TIMEOUT, 60.0)
    assert queue.deliveries(job_id)[0].next_try_at_s is not None


def test_tenants_that_are_skipped_wait_and_the_others_deliveries_are_claimed(queue: Queue) -> None:
    first, second, third = (queue.submit(job(callback_url=CALLBACK, tenant=each)) for each in ("a", "a", "b"))
    for record in (first, second, third):
        queue.cancel(record.job_id)
    assert queue.figures().webhooks == {DeliveryStatus.OWED: 3}
    claim = claim_due(queue, "a", "c")
    assert claim is not None
    assert claim.delivery.job_id == third.job_id
    assert claim_due(queue, "a") is None
    assert [claim.delivery.job_id for claim in (claim_due(queue), claim_due(queue, "b")) if claim] == [
        first.job_id,
        second.job_id,
    ]
    assert queue.forget(first.job_id)
    assert queue.figures().webhooks == {DeliveryStatus.OWED: 2}


def test_a_delivered_and_a_given_up_webhook_are_counted_and_stay_in_the_log(queue: Queue) -> None:
    for failure in (None, TryFailure.STATUS):
        job_id = queue.submit(job(callback_url=CALLBACK)).job_id
        queue.cancel(job_id)
        claim = claim_due(queue)
        assert claim is not None
        assert tried(queue, claim, failure, None)
        (delivery,) = queue.deliveries(job_id)
        assert delivery.next_try_at_s is None
    assert claim_due(queue) is None
    counted = {DeliveryStatus.OWED: 0, DeliveryStatus.DELIVERED: 1, DeliveryStatus.FAILED: 1}
    assert queue.figures().webhooks == counted


@pytest.mark.usefixtures("leases_of_no_time")
def test_a_claim_that_has_expired_goes_to_another_and_what_the_first_notes_does_not_count(queue: Queue) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.cancel(job_id)
    first = second = claim_due(queue)
    while second is None or second == first:
        second = claim_due(queue)
    assert first is not None
    assert first.delivery == second.delivery
    assert not tried(queue, first, TryFailure.TIMEOUT, 60.0)
    assert tried(queue, second, None, None)
    assert [each.status for each in queue.deliveries(job_id)] == [DeliveryStatus.DELIVERED]


def test_a_job_that_fails_is_retried_and_is_done_owes_two_webhooks(queue: Queue) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.fail(claimed(queue)[1], ERROR)
    queue.retry(job_id)
    queue.finish(claimed(queue)[1])
    states = [claim.delivery.state for claim in (claim_due(queue), claim_due(queue)) if claim]
    assert states == [JobState.FAILED, JobState.DONE]
    assert [each.state for each in queue.deliveries(job_id)] == states


def test_a_job_that_is_forgotten_owes_nothing(queue: Queue) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.cancel(job_id)
    claim = claim_due(queue)
    assert claim is not None
    queue.forget(job_id)
    assert not tried(queue, claim, TryFailure.TIMEOUT, 0.0)
    assert claim_due(queue) is None
    assert queue.deliveries(job_id) == []
    assert queue.figures().webhooks == {DeliveryStatus.OWED: 0}


def test_a_job_that_the_queue_had_lost_owes_its_webhook_again_unless_it_ended_long_ago(queue: Queue) -> None:
    ended_at_s = round(time.time()) - 60.0
    ended = {"state": JobState.DONE, "attempt": 2, "finished_at_s": ended_at_s}
    record = job(callback_url=CALLBACK).model_copy(update=ended)
    assert queue.restore(record)
    assert queue.restore(job(callback_url=CALLBACK).model_copy(update=ended | {"finished_at_s": 2000.0}))
    claim = claim_due(queue)
    assert claim is not None
    assert claim.delivery.event_id == f"{record.job_id}.2.done"
    assert claim.delivery.ended_at_s == ended_at_s
    assert claim_due(queue) is None


def given_up(queue: Queue) -> JobRecord:
    """A job whose webhook was given up after one try."""
    record = queue.submit(job(callback_url=CALLBACK))
    queue.cancel(record.job_id)
    claim = claim_due(queue)
    assert claim is not None
    assert tried(queue, claim, TryFailure.STATUS, None)
    return known(queue, record.job_id)


@pytest.mark.parametrize("failure", [None, TryFailure.TIMEOUT])
def test_a_webhook_that_was_given_up_or_delivered_is_due_once_more_under_its_id_with_its_tries_forgiven(
    queue: Queue, failure: TryFailure | None
) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.cancel(job_id)
    first = claim_due(queue)
    assert first is not None
    assert tried(queue, first, failure, None)
    for _ in range(2):
        queue.send_again(known(queue, job_id))
    (delivery,) = queue.deliveries(job_id)
    assert (delivery.status, len(delivery.tries), delivery.forgiven_tries) == (DeliveryStatus.OWED, 1, 1)
    assert delivery.next_try_at_s is not None
    assert queue.figures().webhooks[DeliveryStatus.OWED] == 1
    second = claim_due(queue)
    assert second is not None
    assert second.delivery.event_id == first.delivery.event_id
    assert tried(queue, second, None, None)
    assert claim_due(queue) is None
    assert [len(each.tries) for each in queue.deliveries(job_id)] == [2]


def test_a_webhook_that_waits_for_its_next_try_is_due_at_once_and_one_that_is_claimed_stays_claimed(
    queue: Queue,
) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.cancel(job_id)
    first = claim_due(queue)
    assert first is not None
    queue.send_again(known(queue, job_id))
    assert claim_due(queue) is None
    assert tried(queue, first, TryFailure.TIMEOUT, 3600.0)
    assert claim_due(queue) is None
    queue.send_again(known(queue, job_id))
    second = claim_due(queue)
    assert second is not None
    assert (len(second.delivery.tries), second.delivery.forgiven_tries) == (1, 1)
    assert claim_due(queue) is None


def test_only_the_last_end_is_sent_again_and_none_of_a_job_that_went_on_or_has_gone(queue: Queue) -> None:
    job_id = queue.submit(job(callback_url=CALLBACK)).job_id
    queue.fail(claimed(queue)[1], ERROR)
    failed = known(queue, job_id)
    queue.retry(job_id)
    while claim := claim_due(queue):
        assert tried(queue, claim, None, None)
    queue.send_again(failed)
    assert claim_due(queue) is None
    queue.finish(claimed(queue)[1])
    while claim := claim_due(queue):
        assert tried(queue, claim, None, None)
    queue.send_again(failed)
    assert claim_due(queue) is None
    queue.send_again(known(queue, job_id))
    again = claim_due(queue)
    assert again is not None
    assert again.delivery.state is JobState.DONE
    done = known(queue, job_id)
    assert queue.forget(job_id)
    queue.send_again(done)
    assert queue.deliveries(job_id) == []


def test_a_webhook_that_a_lost_queue_no_longer_knows_is_sent_again(queue: Queue) -> None:
    ended = {"state": JobState.DONE, "attempt": 1, "finished_at_s": 2000.0}
    record = job(callback_url=CALLBACK).model_copy(update=ended)
    assert queue.restore(record)
    assert queue.deliveries(record.job_id) == []
    queue.send_again(known(queue, record.job_id))
    claim = claim_due(queue)
    assert claim is not None
    assert (claim.delivery.event_id, claim.delivery.ended_at_s) == (f"{record.job_id}.1.done", 2000.0)


def test_a_webhook_that_could_not_be_read_is_written_anew_and_sent_again(
    served: RedisQueue, client: redis.Redis
) -> None:
    record = given_up(served)
    client.hset(f"{PREFIX}deliveries:{record.job_id}", f"{record.job_id}.0.cancelled", '{"of": "a later version"}')
    served.send_again(record)
    claim = claim_due(served)
    assert claim is not None
    assert (claim.delivery.job_id, claim.delivery.tries) == (record.job_id, ())


def test_a_late_repetition_does_not_send_again_what_was_tried_since(
    served: RedisQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    record, calls, run = given_up(served), [], served._scripts.run

    def noting(name: str, *arguments: object) -> object:
        calls.append((name, *arguments))
        return run(name, *arguments)

    monkeypatch.setattr(served._scripts, "run", noting)
    served.send_again(record)
    (repetition,) = calls
    claim = claim_due(served)
    assert claim is not None
    run(*repetition)
    assert tried(served, claim, None, None)
    run(*repetition)
    assert claim_due(served) is None
    assert [each.status for each in served.deliveries(record.job_id)] == [DeliveryStatus.DELIVERED]
