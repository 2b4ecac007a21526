"""Live feeds: one worker follows each, a later one takes over, and nothing that an earlier one says counts then."""

from __future__ import annotations

import pytest
import redis

from contract.queue.feeds import FeedClaim, FeedsFullError
from contract.queue.interface import Queue
from contract.queue.redis_queue import PREFIX, RedisQueue
from contract.store.shelf import new_job_id
from contract.wire.feeds import FeedOptions, FeedRecord, FeedReport, FeedWish
from intrasplat.live.state import FeedReason, FeedState
from tests.contract.conftest import MakeQueue

LIVE = FeedReport(state=FeedState.LIVE, since_s=5.0, received_fps=30.0, used_fps=5.2, begins_s=4.0, ends_s=9.0)


def feed(created_at_s: float = 1000.0, tenant: str = "ward-1") -> FeedRecord:
    return FeedRecord(
        feed_id=new_job_id(),
        tenant=tenant,
        options=FeedOptions(source="rtsp://user:secret@camera/1", label="room 4"),
        calibration="{}",
        calibration_name="calibration.json",
        created_at_s=created_at_s,
    )


def opened(queue: Queue, record: FeedRecord | None = None) -> FeedRecord:
    return queue.open_feed(record or feed(), 8, 8)


def claimed(queue: Queue, owner: str = "worker-1.a") -> FeedClaim:
    record = queue.claim_feed(owner)
    assert record is not None
    assert record.owner == owner
    return FeedClaim(record.feed_id, record.epoch, owner)


def test_an_opened_feed_is_listed_with_what_was_asked_for(queue: Queue) -> None:
    first, second = opened(queue, feed(1000.0)), opened(queue, feed(2000.0, "ward-2"))
    assert queue.feeds() == [second, first]
    assert queue.feeds("ward-1") == [first]
    assert queue.feed(first.feed_id) == first
    assert (first.owner, first.epoch, first.wish, first.report) == (None, 0, FeedWish.RUN, None)
    assert queue.feed(new_job_id()) is None


def test_opening_it_again_changes_nothing(queue: Queue) -> None:
    record = opened(queue)
    claim = claimed(queue)
    again = queue.open_feed(record, 1, 1)
    assert (again.owner, again.epoch) == (claim.owner, 1)
    assert len(queue.feeds()) == 1


def test_no_more_feeds_are_open_than_allowed(queue: Queue) -> None:
    opened(queue)
    with pytest.raises(FeedsFullError) as of_tenant:
        queue.open_feed(feed(), 8, 1)
    with pytest.raises(FeedsFullError) as of_all:
        queue.open_feed(feed(tenant="ward-2"), 1, 1)
    assert (of_tenant.value.tenant, of_all.value.tenant) == (True, False)
    assert len(queue.feeds()) == 1


def test_each_feed_has_one_worker_and_the_oldest_is_claimed_first(queue: Queue) -> None:
    newer, older = opened(queue, feed(2000.0)), opened(queue, feed(1000.0))
    assert claimed(queue).feed_id == older.feed_id
    assert claimed(queue).feed_id == newer.feed_id
    assert queue.claim_feed("worker-2.b") is None


def test_a_beat_stores_the_report_and_answers_the_wish(queue: Queue) -> None:
    record = opened(queue)
    claim = claimed(queue)
    assert queue.beat_feed(claim, LIVE) is FeedWish.RUN
    queue.wish_feed(record.feed_id, FeedWish.PAUSE)
    assert queue.beat_feed(claim, LIVE) is FeedWish.PAUSE
    found = queue.feed(record.feed_id)
    assert found is not None
    assert found.report == LIVE
    assert found.reported_at_s is not None


def test_a_released_feed_is_claimed_by_another_worker(queue: Queue) -> None:
    opened(queue)
    claim = claimed(queue)
    assert queue.release_feed(claim)
    assert queue.release_feed(claim)  # the answer was lost
    other = claimed(queue, "worker-2.b")
    assert other.epoch == 2
    assert queue.beat_feed(claim, LIVE) is None
    assert not queue.forget_feed(claim)
    assert queue.beat_feed(other, LIVE) is FeedWish.RUN


def test_a_restarted_worker_takes_its_feed_over_at_once(queue: Queue) -> None:
    opened(queue)
    claim = claimed(queue, "worker-1.a")
    assert queue.claim_feed("worker-2.b") is None
    assert claimed(queue, "worker-1.c").epoch == 2
    assert queue.beat_feed(claim, LIVE) is None


def test_an_expired_lease_lets_others_claim_and_a_late_beat_is_accepted_before(queues: MakeQueue) -> None:
    queue = queues(feed_lease_s=0.0)
    record = opened(queue)
    claim = claimed(queue)
    found = queue.feed(record.feed_id)
    assert found is not None
    assert found.owner is None
    assert queue.beat_feed(claim, LIVE) is FeedWish.RUN
    assert claimed(queue, "worker-2.b").epoch == 2
    assert queue.beat_feed(claim, LIVE) is None


def test_an_end_is_final_and_its_worker_removes_the_feed(queue: Queue) -> None:
    record = opened(queue)
    claim = claimed(queue)
    assert not queue.forget_feed(claim)
    queue.wish_feed(record.feed_id, FeedWish.END)
    ended = queue.wish_feed(record.feed_id, FeedWish.RUN)
    assert ended is not None
    assert ended.wish is FeedWish.END
    assert queue.forget_feed(claim)
    assert queue.forget_feed(claim)  # the answer was lost
    assert queue.feed(record.feed_id) is None
    assert queue.feeds() == []
    assert queue.wish_feed(record.feed_id, FeedWish.RUN) is None


def test_a_feed_that_no_worker_ever_claimed_ends_at_once(queue: Queue) -> None:
    record = opened(queue)
    assert queue.wish_feed(record.feed_id, FeedWish.END) is None
    assert queue.feeds() == []
    assert queue.claim_feed("worker-1.a") is None
    assert opened(queue, record).epoch == 0


def test_a_feed_that_is_opened_again_under_its_id_is_another_one(queue: Queue) -> None:
    record = feed()
    for _ in range(2):
        opened(queue, record)
        claim = claimed(queue)
        queue.wish_feed(record.feed_id, FeedWish.END)
        assert queue.forget_feed(claim)
        assert queue.tenant_of_feed(record.feed_id) is None


def test_a_record_that_cannot_be_read_is_there(served: RedisQueue, client: redis.Redis) -> None:
    record = opened(served)
    client.hset(f"{PREFIX}feed:{record.feed_id}", "report", '{"state": "of a later version", "since_s": 1}')
    assert served.feed(record.feed_id) is None
    assert served.tenant_of_feed(record.feed_id) == "ward-1"


def test_a_worker_without_a_free_place_claims_what_is_to_end_alone(queue: Queue) -> None:
    _, second = opened(queue, feed(1000.0)), opened(queue, feed(2000.0))
    for claim in [claimed(queue), claimed(queue)]:
        assert queue.release_feed(claim)
    assert queue.claim_feed("worker-2.b", to_end=True) is None
    queue.wish_feed(second.feed_id, FeedWish.END)
    found = queue.claim_feed("worker-2.b", to_end=True)
    assert found is not None
    assert found.feed_id == second.feed_id


def test_a_reason_of_a_later_version_can_be_read(queue: Queue) -> None:
    document = LIVE.model_dump(mode="json") | {"reason": "solar_flare", "flares": 3}
    assert FeedReport.model_validate(document).reason is FeedReason.UNCLASSIFIED
