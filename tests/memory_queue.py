"""A queue in the memory of one process, for tests: contract/queue/interface.py in plain Python."""
# long: the whole interface is stated in one place

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Collection

from contract.queue.deliveries import OWED_FOR_S, ClaimedDelivery
from contract.queue.feeds import FEED_LEASE_S, FeedClaim
from contract.queue.interface import (
    IDEMPOTENCY_S,
    LEASE_S,
    MAX_ATTEMPTS,
    MAX_DURATIONS,
    MAX_EVENTS,
    MAX_LISTED,
    PREEMPT_AFTER_S,
    WORKER_TTL_S,
    YIELD_S,
    Admission,
    Claim,
    Event,
    ListingPosition,
    Order,
    Pace,
    QueueFigures,
    Waiting,
    asked_training_s,
    check_admission,
    claim_order,
    estimate_forecast,
    event_order,
    place_of,
    trainers,
    worker_died,
)
from contract.wire.feeds import FeedRecord, FeedReport, FeedWish
from contract.wire.job import TERMINAL_STATES, TRANSITIONS, Forecast, JobError, JobProgress, JobRecord, JobState
from contract.wire.labels import LabelChange
from contract.wire.rendering import WorkerAddress
from contract.wire.webhooks import Delivery, DeliveryStatus
from tests.memory_deliveries import MemoryDeliveries
from tests.memory_feeds import MemoryFeeds

LEASE_CHECK_S = 0.05
"""How often a waiting claim looks for leases that have run out."""


class MemoryQueue:
    """A Queue; one lock makes each method atomic. The arguments are for tests that cannot wait."""

    def __init__(
        self,
        *,
        lease_s: float = LEASE_S,
        preempt_after_s: float = PREEMPT_AFTER_S,
        feed_lease_s: float = FEED_LEASE_S,
    ) -> None:
        self._lease_s = lease_s
        self._preempt_after_s = preempt_after_s
        self._changed = threading.Condition(threading.RLock())
        self._records: dict[str, JobRecord] = {}
        self._places: dict[str, int] = {}
        """Of each job, in the order of submissions and retries: jobs of one priority are claimed in this order."""
        self._next_place = 0
        self._queued_at_s: dict[str, float] = {}
        self._lease_ends_s: dict[str, float] = {}
        self._asked_to_yield: dict[str, tuple[str, float]] = {}
        """By high-priority job: the owner that was told to make way for it, and until when nobody else is told."""
        self._idempotent: dict[tuple[str, str], tuple[str, float]] = {}
        self._events: dict[str, deque[Event]] = {}
        self._event_count = 0
        self._ended: Counter[JobState] = Counter()
        self._durations_s: deque[float] = deque(maxlen=MAX_DURATIONS)
        self._rests_s: deque[float] = deque(maxlen=MAX_DURATIONS)
        self._returned: set[str] = set()
        self._served: Counter[str] = Counter()
        """By tenant: the number of the last claim that gave it a new job."""
        self._workers: dict[str, tuple[WorkerAddress, float]] = {}
        self._deliveries = MemoryDeliveries()
        self.stored_feeds = MemoryFeeds(feed_lease_s)

    def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
        with self._changed:
            known = self._records.get(record.job_id) or self._earlier(record)
            if known is not None:
                return known
            if admission is not None:
                waiting = self._queued()
                of_tenant = sum(other.tenant == record.tenant for other in waiting)
                check_admission(admission, len(waiting), of_tenant)
            self._remember(record, IDEMPOTENCY_S)
            self._enqueue(record)
            return record

    def restore(self, record: JobRecord) -> bool:
        if record.state not in TERMINAL_STATES:
            raise ValueError(f"Job {record.job_id} is {record.state}; only ended jobs are restored.")
        with self._changed:
            if record.job_id in self._records:
                return False
            self._remember(record, record.created_at_s + IDEMPOTENCY_S - time.time())
            self._write(record)
            if (record.finished_at_s or 0.0) > time.time() - OWED_FOR_S:
                self._deliveries.add(record)
            return True

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while (record := self._next(owner)) is None:
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    return None
                self._changed.wait(min(left_s, LEASE_CHECK_S))
            self._renew(record)
            return record

    def beat(self, claim: Claim, progress: JobProgress | None = None) -> Order:
        with self._changed:
            record = self._held(claim)
            if record is None:
                return Order.LOST
            self._renew(record)
            if progress is not None and progress != record.progress:
                self._write(record.model_copy(update={"progress": progress}))
            if record.cancel_requested:
                return Order.CANCEL
            return Order.YIELD if self._must_yield(record) else Order.GO_ON

    def finish(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.DONE)

    def fail(self, claim: Claim, error: JobError) -> bool:
        return self._settle(claim, JobState.FAILED, error=error)

    def confirm_cancel(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.CANCELLED)

    def release(self, claim: Claim, *, died: bool = False) -> bool:
        with self._changed:
            record = self._records.get(claim.job_id)
            if record is None or not _of(record, claim):
                return False
            if record.state is not JobState.RUNNING:  # this is a repetition, because the answer was lost
                return record.state is JobState.QUEUED or (died and record.error == worker_died())
            if record.cancel_requested:
                return False
            if died:
                self._count_death(record)
            else:
                self._change(record, JobState.QUEUED, progress=None, released=record.released + 1)
                self._returned.add(record.job_id)
            return True

    def cancel(self, job_id: str) -> JobRecord | None:
        with self._changed:
            record = self._records.get(job_id)
            if record is None or record.state in TERMINAL_STATES or record.cancel_requested:
                return record
            asked = record.model_copy(update={"cancel_requested": True})
            if record.state is JobState.QUEUED:
                return self._change(asked, JobState.CANCELLED)
            return self._write(asked)

    def retry(self, job_id: str) -> JobRecord | None:
        with self._changed:
            record = self._records.get(job_id)
            if record is None or record.state is not JobState.FAILED:
                return record
            fresh = {"error": None, "progress": None, "started_at_s": None, "finished_at_s": None}
            return self._enqueue(self._moved(record, JobState.QUEUED, released=record.attempt, **fresh))

    def relabel(self, job_id: str, change: LabelChange) -> JobRecord | None:
        with self._changed:
            record = self._records.get(job_id)
            if record is None or record.labels == record.labels.changed(change):
                return record
            return self._write(record.model_copy(update={"labels": record.labels.changed(change)}))

    def get(self, job_id: str) -> JobRecord | None:
        with self._changed:
            return self._records.get(job_id)

    def forecast(self, job_id: str) -> Forecast:
        with self._changed:
            record = self._records.get(job_id)
            if record is None or record.state in TERMINAL_STATES:
                return Forecast(position=None, eta_s=None)
            now_s = time.time()
            ran_s = {each.job_id: now_s - (each.started_at_s or now_s) for each in self._in(JobState.RUNNING)}
            waiting = [other.job_id for other in self._waiting()]
            position = waiting.index(job_id) if job_id in waiting else None
            pace = Pace(list(self._durations_s), list(self._rests_s))
            return estimate_forecast(record, position, pace, ran_s, trainers(self.workers()))

    def records(
        self, tenant: str | None = None, limit: int | None = MAX_LISTED, before: ListingPosition | None = None
    ) -> list[JobRecord]:
        with self._changed:
            chosen = [record for record in self._records.values() if tenant in (None, record.tenant)]
        chosen.sort(key=place_of, reverse=True)
        return [record for record in chosen if before is None or place_of(record) < before][:limit]

    def unreadable(self) -> list[str]:
        return []

    def events(self, job_id: str, after: str = "0") -> list[Event]:
        with self._changed:
            events, record = list(self._events.get(job_id, ())), self._records.get(job_id)
        labels = {"labels": record.labels} if record else {}
        kept = [Event(event.number, event.record.model_copy(update=labels)) for event in events]
        return [event for event in kept if event_order(event.number) > event_order(after)]

    def forget(self, job_id: str) -> bool:
        with self._changed:
            record = self._records.get(job_id)
            if record is None or record.state not in TERMINAL_STATES:
                return False
            del self._records[job_id]
            del self._events[job_id]
            self._deliveries.forget(job_id)
            self._places.pop(job_id, None)
            self._idempotent = {key: held for key, held in self._idempotent.items() if held[0] != job_id}
            return True

    def claim_delivery(self, token: str, skipped: Collection[str] = ()) -> ClaimedDelivery | None:
        with self._changed:
            if (found := self._deliveries.claim(token, skipped)) is None:
                return None
            record = self._records[found[0].job_id]
            return ClaimedDelivery(found[0], record.callback_url or "", record.tenant, found[1], record.trace)

    def record_try(self, claim: ClaimedDelivery, delivery: Delivery, wait_s: float | None) -> bool:
        with self._changed:
            return self._deliveries.record_try(claim, delivery, wait_s)

    def send_again(self, record: JobRecord) -> None:
        with self._changed:
            known = self._records.get(record.job_id)
            if known and (known.attempt, known.state) == (record.attempt, record.state):
                self._deliveries.send_again(known)

    def deliveries(self, job_id: str) -> list[Delivery]:
        with self._changed:
            return self._deliveries.of(job_id)

    def rewrite_log(self) -> bool:
        return True

    def open_feed(self, record: FeedRecord, most: int, most_of_tenant: int) -> FeedRecord:
        with self._changed:
            return self.stored_feeds.open(record, most, most_of_tenant)

    def claim_feed(self, owner: str, *, to_end: bool = False) -> FeedRecord | None:
        with self._changed:
            return self.stored_feeds.claim(owner, to_end=to_end)

    def beat_feed(self, claim: FeedClaim, report: FeedReport) -> FeedWish | None:
        with self._changed:
            return self.stored_feeds.beat(claim, report)

    def release_feed(self, claim: FeedClaim) -> bool:
        with self._changed:
            return self.stored_feeds.leave(claim, has_ended=False)

    def forget_feed(self, claim: FeedClaim) -> bool:
        with self._changed:
            return self.stored_feeds.leave(claim, has_ended=True)

    def wish_feed(self, feed_id: str, wish: FeedWish) -> FeedRecord | None:
        with self._changed:
            return self.stored_feeds.wish(feed_id, wish)

    def feed(self, feed_id: str) -> FeedRecord | None:
        with self._changed:
            return self.stored_feeds.one(feed_id)

    def tenant_of_feed(self, feed_id: str) -> str | None:
        with self._changed:
            return self.stored_feeds.tenant(feed_id)

    def feeds(self, tenant: str | None = None) -> list[FeedRecord]:
        with self._changed:
            return self.stored_feeds.all(tenant)

    def announce(self, address: WorkerAddress) -> None:
        with self._changed:
            self._workers[address.name] = (address, time.monotonic() + WORKER_TTL_S)

    def withdraw(self, name: str) -> None:
        with self._changed:
            self._workers.pop(name, None)

    def workers(self) -> list[WorkerAddress]:
        with self._changed:
            now_s = time.monotonic()
            return [address for _, (address, until_s) in sorted(self._workers.items()) if until_s > now_s]

    def figures(self) -> QueueFigures:
        with self._changed:
            waiting = self._waiting()
            now_s = time.time()
            ages_s = [now_s - self._queued_at_s[record.job_id] for record in waiting]
            ended = {state: self._ended[state] for state in TERMINAL_STATES}
            running = len(self._in(JobState.RUNNING))
            webhooks = {**self._deliveries.ended, DeliveryStatus.OWED: self._deliveries.owed}
            return QueueFigures(len(waiting), running, max([0.0, *ages_s]), ended, webhooks)

    def ping(self) -> None:
        return None

    def close(self) -> None:
        return None

    def _in(self, state: JobState) -> list[JobRecord]:
        return [record for record in self._records.values() if record.state is state]

    def _queued(self) -> list[JobRecord]:
        """Queued jobs, oldest first."""
        return sorted(self._in(JobState.QUEUED), key=lambda record: self._places[record.job_id])

    def _waiting(self) -> list[JobRecord]:
        """Queued jobs in the order in which they will be claimed."""
        queued = self._queued()
        running = Counter(record.tenant for record in self._in(JobState.RUNNING))
        order: list[str] = []
        for priority in ("high", "standard"):
            chosen = [each for each in queued if each.options.priority == priority]
            waiting = [Waiting(each.job_id, each.tenant, each.job_id in self._returned) for each in chosen]
            order += claim_order(waiting, running, self._served)
        return [self._records[job_id] for job_id in order]

    def _next(self, owner: str) -> JobRecord | None:
        """The job that `owner` holds already, else the first in line, now running."""
        for record in self._in(JobState.RUNNING):
            if record.owner == owner:
                return record
        for record in self._in(JobState.RUNNING):
            if self._lease_ends_s[record.job_id] <= time.monotonic():
                self._count_death(record)
        for record in self._waiting():
            if record.job_id not in self._returned:
                self._served[record.tenant] = max(self._served.values(), default=0) + 1
            update = {"owner": owner, "attempt": record.attempt + 1, "started_at_s": time.time(), "progress": None}
            return self._change(record, JobState.RUNNING, **update)
        return None

    def _count_death(self, record: JobRecord) -> None:
        """The worker that ran the job is dead: queue the job again, or fail it after too many deaths."""
        if record.cancel_requested:
            self._change(record, JobState.CANCELLED)
        elif record.attempt - record.released >= MAX_ATTEMPTS:
            self._change(record, JobState.FAILED, error=worker_died())
        else:
            self._change(record, JobState.QUEUED, progress=None)
            self._returned.add(record.job_id)

    def _settle(self, claim: Claim, target: JobState, **update: object) -> bool:
        """End the job. If a cancel was requested, only CANCELLED is accepted; otherwise anything but CANCELLED."""
        with self._changed:
            record = self._records.get(claim.job_id)
            if record is None or not _of(record, claim):
                return False
            if record.state is not JobState.RUNNING:  # this is a repetition, because the answer was lost
                return record.state is target
            if record.cancel_requested is not (target is JobState.CANCELLED):
                return False
            self._change(record, target, **update)
            return True

    def _held(self, claim: Claim) -> JobRecord | None:
        """The running record that `claim` still holds."""
        record = self._records.get(claim.job_id)
        return record if record and record.state is JobState.RUNNING and _of(record, claim) else None

    def _renew(self, record: JobRecord) -> None:
        self._lease_ends_s[record.job_id] = time.monotonic() + self._lease_s

    def _must_yield(self, record: JobRecord) -> bool:
        """Whether a high-priority job has waited long enough, and no other worker was told to make way for it."""
        if record.options.priority == "high":
            return False
        for waiting in self._queued():
            if waiting.options.priority != "high":
                continue
            if time.time() - self._queued_at_s[waiting.job_id] < self._preempt_after_s:
                continue
            asked, until_s = self._asked_to_yield.get(waiting.job_id, ("", 0.0))
            if until_s <= time.monotonic():
                self._asked_to_yield[waiting.job_id] = (record.owner or "", time.monotonic() + YIELD_S)
                return True
            if asked == record.owner:
                return True
        return False

    def _earlier(self, record: JobRecord) -> JobRecord | None:
        """The job submitted under the same idempotency key."""
        job_id, until_s = self._idempotent.get((record.tenant, record.idempotency_key or ""), ("", 0.0))
        return self._records.get(job_id) if until_s > time.monotonic() else None

    def _remember(self, record: JobRecord, seconds: float) -> None:
        if record.idempotency_key is not None:
            held = (record.job_id, time.monotonic() + seconds)
            self._idempotent.setdefault((record.tenant, record.idempotency_key), held)

    def _enqueue(self, record: JobRecord) -> JobRecord:
        """Write a queued record in the last place of its priority."""
        self._places[record.job_id] = self._next_place
        self._next_place += 1
        self._queued_at_s[record.job_id] = time.time()
        return self._write(record)

    def _moved(self, record: JobRecord, target: JobState, **update: object) -> JobRecord:
        """The record in another state, which TRANSITIONS must allow."""
        if target not in TRANSITIONS[record.state]:
            raise AssertionError(f"{record.state} -> {target} is not in TRANSITIONS")
        return record.model_copy(update={"state": target, **update})

    def _change(self, record: JobRecord, target: JobState, **update: object) -> JobRecord:
        now_s = time.time()
        if target is JobState.QUEUED:
            self._queued_at_s[record.job_id] = now_s
        if target is not JobState.QUEUED:
            self._returned.discard(record.job_id)
        if target is JobState.RUNNING:
            self._asked_to_yield.pop(record.job_id, None)
        if target in TERMINAL_STATES:
            update["finished_at_s"] = now_s
            self._ended[target] += 1
        if target is JobState.DONE and record.started_at_s is not None and record.imported is None:
            self._durations_s.append(now_s - record.started_at_s)
            asked_s = asked_training_s(record.options)
            if asked_s is not None:
                self._rests_s.append(now_s - record.started_at_s - asked_s)
        changed = self._write(self._moved(record, target, **update))
        if target in TERMINAL_STATES:
            self._deliveries.add(changed)
        return changed

    def _write(self, record: JobRecord) -> JobRecord:
        """Store a changed record, add its event, and wake the claims that wait for a job."""
        self._records[record.job_id] = record
        self._event_count += 1
        kept = self._events.setdefault(record.job_id, deque(maxlen=MAX_EVENTS))
        kept.append(Event(f"{self._event_count}-0", record))
        self._changed.notify_all()
        return record


def _of(record: JobRecord, claim: Claim) -> bool:
    """Whether the record's last claim is this one."""
    return (record.attempt, record.owner) == (claim.attempt, claim.owner)
