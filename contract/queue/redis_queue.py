"""The queue on Redis 7+ or Valkey Streams. Only this file, redis_deliveries.py, redis_feeds.py and scripts/ touch keys.

Keys (the braces put all of them in one cluster slot, so that a script may touch several):
    {intrasplat}:jobs:high|standard     stream; an entry has one field, `job` = job id. Group `workers`; an entry stays
                                        pending from its first claim until the job has ended, idle since the last beat
    {intrasplat}:job:<id>               hash; the truth about one job:
        document                        the JobRecord as submitted, JSON; never changes
        state                           a JobState; changes only along TRANSITIONS
        attempt, released, owner        as in JobRecord; with attempt and owner a worker's report must agree
        cancel                          "1" once a cancel was asked for
        progress, error                 JSON of JobProgress, JobError
        started, finished, queued       UNIX s by the server's clock; queued: since when it waits
        label, metadata                 of its labels; metadata as JSON. They stand in neither document nor events
        callback                        where the webhook goes when the job has ended; absent: nowhere
        tenant, priority                of the document, for the scripts
        trace                           as in JobRecord
        entry, sequence                 its stream entry, and its place among the jobs of its priority
        returned                        "1" while it waits again after a claim: it is claimed before new jobs
        restored                        token of the call that put it back
    {intrasplat}:events:<id>            stream; each entry is what a change left of the hash (EVENT_FIELDS)
    {intrasplat}:deliveries:<id>        hash, JSON of Delivery by event: the webhooks of the job's ends
    {intrasplat}:feed:<id>              hash of a live feed: document (its FeedRecord when it was opened), tenant, wish,
                                        owner, epoch, lease (UNIX s until when it is owned), report and reported
Indexes, written by the same scripts as the hashes:
    {intrasplat}:index                  sorted set of job ids by time of submission; and tenant:<tenant>:index
    {intrasplat}:waiting:high|standard  sorted set of queued jobs by sequence: the order in which they will be claimed
    {intrasplat}:queued                 sorted set of the same jobs by `queued`; and set tenant:<tenant>:waiting
    {intrasplat}:feeds                  sorted set of the live feeds by time of creation; and feeds:<tenant>
    {intrasplat}:held                   hash of the running jobs, by owner
    {intrasplat}:served                 sorted set of tenants, by when each was last given a job; expires after a day
    {intrasplat}:dead                   sorted set of dead letters, by time of failure
    {intrasplat}:ended                  hash, jobs that ever came to each terminal state
    {intrasplat}:durations              list, seconds that the last done jobs ran
    {intrasplat}:rests                  list, those seconds less the seconds of training that the job asked for
    {intrasplat}:owed-by                hash, how many unfinished webhooks each tenant has; their events are, by when
                                        they are due, in sorted set tenant:<tenant>:owed
    {intrasplat}:owed                   sorted set of those events of all tenants, which earlier versions write
    {intrasplat}:delivered              hash, webhooks that ever came to each DeliveryStatus but owed
    {intrasplat}:sequence               counter
    {intrasplat}:workers                set of names that may have a {intrasplat}:worker:<name>
These expire:
    {intrasplat}:worker:<name>          JSON of WorkerAddress
    {intrasplat}:idempotency:<tenant>:<hash>  id of the job submitted under that key
    {intrasplat}:yield:<id>             worker that was ordered to yield to that job
    {intrasplat}:forgotten:<id>         token of the call that removed it
    {intrasplat}:left:<id>              token of the call by which a worker left that feed
    {intrasplat}:lent:<token>           event of the delivery that this call claimed
    {intrasplat}:trying:<event>         while a service tries to deliver it

A user who may do this and nothing else:
    ACL SETUSER intrasplat on >PASSWORD ~{intrasplat}:* resetchannels +@all -@dangerous +bgrewriteaof

Every change of state is one script (contract/queue/scripts/), and every script gives the same answer when it runs
twice, so the client may repeat a command whose answer was lost. Claiming is a script, too; it never blocks. A plain
XREAD waits for new entries and takes none.
"""

from __future__ import annotations

import json
import logging
import time
import uuid
from collections import Counter
from collections.abc import Sequence

import redis

from contract.queue.feeds import FEED_LEASE_S
from contract.queue.interface import (
    IDEMPOTENCY_S,
    LEASE_S,
    MAX_LISTED,
    PREEMPT_AFTER_S,
    WORKER_TTL_S,
    Admission,
    Claim,
    Event,
    ListingPosition,
    Order,
    Pace,
    QueueFigures,
    Waiting,
    check_admission,
    claim_order,
    estimate_forecast,
    event_order,
    trainers,
)
from contract.queue.lua import UNREADABLE, Scripts
from contract.queue.redis_client import PATIENCE_S, connect, reachable
from contract.queue.redis_deliveries import RedisDeliveries
from contract.queue.redis_feeds import RedisFeeds
from contract.queue.redis_hash import BESIDE_EVENTS, label_fields, new_record, record_of, table_of
from contract.wire.job import TERMINAL_STATES, Forecast, JobError, JobProgress, JobRecord, JobState
from contract.wire.labels import LabelChange
from contract.wire.rendering import WorkerAddress
from contract.wire.webhooks import DeliveryStatus
from intrasplat.errors import UnavailableError

PREFIX = "{intrasplat}:"
INDEX = PREFIX + "index"
HIGH, STANDARD = PREFIX + "jobs:high", PREFIX + "jobs:standard"
HELD = PREFIX + "held"
QUEUED = PREFIX + "queued"
WORKERS = PREFIX + "workers"
OWED = PREFIX + "owed-by"

BLOCK_S = 2.0
"""How long one read may block. The client notices a cut connection within this plus the socket's timeout."""

LEASE_CHECK_S = 0.5
"""The same while jobs run: a lease that expires writes nothing that would end the read."""

logger = logging.getLogger("intrasplat.queue")


class RedisQueue(RedisDeliveries, RedisFeeds):
    """A Queue on a Redis 7+ or Valkey server (`redis://`, `rediss://` or `unix://`); safe to share among threads.

    patience_s: how long, in total, a call waits for a server that does not answer. A claim needs more than BLOCK_S for
    each of the client's attempts; the default allows that.
    lease_s, preempt_after_s and feed_lease_s are for tests that cannot wait. All clients of one queue must agree on
    them.
    """

    def __init__(
        self,
        url: str,
        *,
        patience_s: float = PATIENCE_S,
        lease_s: float = LEASE_S,
        preempt_after_s: float = PREEMPT_AFTER_S,
        feed_lease_s: float = FEED_LEASE_S,
    ) -> None:
        client = connect(url, patience_s)
        scripts = Scripts(client, PREFIX, lease_s, preempt_after_s)
        RedisDeliveries.__init__(self, client, scripts, PREFIX)
        RedisFeeds.__init__(self, client, scripts, PREFIX, feed_lease_s)

    def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
        limits = (admission.queued, admission.queued_per_tenant) if admission else ("", "")
        answer = self._scripts.run("submit", *new_record(record), IDEMPOTENCY_S * 1000, *limits)
        if answer[0] == "full" and admission is not None:
            check_admission(admission, *answer[1:])
        known = record_of(answer[1], table_of(answer[2]))
        if known is None:
            problem = f"The queue's record of job {answer[1]} cannot be read."
            raise UnavailableError(problem, "Submit again under a new idempotency key.")
        return known

    def restore(self, record: JobRecord) -> bool:
        if record.state not in TERMINAL_STATES:
            raise ValueError(f"Job {record.job_id} is {record.state}; only ended jobs are restored.")
        remaining_s = record.created_at_s + IDEMPOTENCY_S - time.time()
        return bool(self._scripts.run("restore", *new_record(record), round(remaining_s * 1000), uuid.uuid4().hex))

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        deadline = time.monotonic() + timeout_s
        while True:
            found, *answer = self._scripts.run("claim", owner)
            if found:
                record = self._usable(owner, *answer)
                if record is not None:
                    return record
                continue
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                return None
            last_high, last_standard, pending = answer
            block_s = min(left_s, LEASE_CHECK_S if pending else BLOCK_S)
            with reachable():
                self._client.xread({HIGH: last_high, STANDARD: last_standard}, 1, max(1, round(block_s * 1000)))

    def beat(self, claim: Claim, progress: JobProgress | None = None) -> Order:
        document = progress.model_dump_json() if progress else ""
        return Order(self._scripts.run("beat", claim.job_id, claim.owner, claim.attempt, document))

    def finish(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.DONE)

    def fail(self, claim: Claim, error: JobError) -> bool:
        return self._settle(claim, JobState.FAILED, error.model_dump_json())

    def confirm_cancel(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.CANCELLED)

    def release(self, claim: Claim, *, died: bool = False) -> bool:
        return bool(self._scripts.run("release", claim.job_id, claim.owner, claim.attempt, "1" if died else ""))

    def cancel(self, job_id: str) -> JobRecord | None:
        return record_of(job_id, table_of(self._scripts.run("cancel", job_id)))

    def retry(self, job_id: str) -> JobRecord | None:
        record = self.get(job_id)
        return record and record_of(job_id, table_of(self._scripts.run("retry", job_id, record.attempt)))

    def relabel(self, job_id: str, change: LabelChange) -> JobRecord | None:
        return record_of(job_id, table_of(self._scripts.run("relabel", job_id, json.dumps(label_fields(change)))))

    def get(self, job_id: str) -> JobRecord | None:
        return self._get_all([job_id]).get(job_id)

    def forecast(self, job_id: str) -> Forecast:
        record = self.get(job_id)
        if record is None or record.state in TERMINAL_STATES:
            return Forecast(position=None, eta_s=None)
        with reachable(), self._client.pipeline(transaction=True) as batch:
            batch.zrange(f"{PREFIX}waiting:{record.options.priority}", 0, -1)
            batch.zcard(f"{PREFIX}waiting:high")
            batch.hvals(HELD)
            batch.lrange(f"{PREFIX}durations", 0, -1)
            batch.time()
            batch.zrange(f"{PREFIX}served", 0, -1, withscores=True)
            batch.lrange(f"{PREFIX}rests", 0, -1)
            waiting, high, held, durations, (clock_s, _), served, rests = batch.execute()
        running = self._get_all(held)
        position = None
        if job_id in waiting:
            tenants = Counter(each.tenant for each in running.values())
            position = claim_order(self._waiting(waiting), tenants, dict(served)).index(job_id)
            position += high if record.options.priority == "standard" else 0
        ran_s = {other: clock_s - (of.started_at_s or clock_s) for other, of in running.items()}
        pace = Pace([float(each) for each in durations], [float(each) for each in rests])
        return estimate_forecast(record, position, pace, ran_s, trainers(self.workers()))

    def records(
        self, tenant: str | None = None, limit: int | None = MAX_LISTED, before: ListingPosition | None = None
    ) -> list[JobRecord]:
        index = INDEX if tenant is None else f"{PREFIX}tenant:{tenant}:index"
        while places := self._places(index, limit, before):
            if found := self._get_all([each.job_id for each in places]):
                return list(found.values())
            before = places[-1]  # none of them can be read
        return []

    def unreadable(self) -> list[str]:
        hashes = self._hashes([each.job_id for each in self._places(INDEX, None, None)])
        return [job_id for job_id, fields in hashes.items() if fields and record_of(job_id, fields) is None]

    def events(self, job_id: str, after: str = "0") -> list[Event]:
        milliseconds, count = event_order(after)
        with reachable(), self._client.pipeline(transaction=True) as batch:
            batch.hmget(_job_key(job_id), *BESIDE_EVENTS)
            batch.xrange(f"{PREFIX}events:{job_id}", min=f"({milliseconds}-{count}")
            of_all, entries = batch.execute()
        shared = {name: text for name, text in zip(BESIDE_EVENTS, of_all, strict=True) if text}
        found = ((number, record_of(job_id, {**fields, **shared})) for number, fields in entries)
        return [Event(number, record) for number, record in found if record is not None]

    def forget(self, job_id: str) -> bool:
        record = self.get(job_id)
        terminal = json.dumps(dict.fromkeys(sorted(TERMINAL_STATES), True))
        idempotency_key = (record and record.idempotency_key) or ""
        return bool(self._scripts.run("forget", job_id, terminal, idempotency_key, uuid.uuid4().hex))

    def rewrite_log(self) -> bool:
        try:
            with reachable():
                self._client.bgrewriteaof()
        except (UnavailableError, redis.ResponseError):  # the server rewrites its log already, or this user may not ask
            return False
        return True

    def announce(self, address: WorkerAddress) -> None:
        self._scripts.run("announce", address.name, address.model_dump_json(), round(WORKER_TTL_S * 1000))

    def withdraw(self, name: str) -> None:
        with reachable():
            self._client.delete(_worker_key(name))

    def workers(self) -> list[WorkerAddress]:
        with reachable():
            names = sorted(self._client.smembers(WORKERS))
            documents = self._client.mget([_worker_key(name) for name in names]) if names else []
        found = [_address(name, document) for name, document in zip(names, documents, strict=True) if document]
        return [address for address in found if address is not None]

    def figures(self) -> QueueFigures:
        with reachable(), self._client.pipeline(transaction=True) as batch:
            batch.zcard(QUEUED)
            batch.zrange(QUEUED, 0, 0, withscores=True)
            batch.hlen(HELD)
            batch.hgetall(f"{PREFIX}ended")
            batch.hvals(OWED)
            batch.hgetall(f"{PREFIX}delivered")
            batch.time()
            queued, oldest, running, ended, owed, delivered, (seconds, microseconds) = batch.execute()
        since_s = oldest[0][1] if oldest else float("inf")
        counts = {state: int(ended.get(state, 0)) for state in TERMINAL_STATES}
        webhooks = {DeliveryStatus(status): int(count) for status, count in delivered.items()}
        oldest_s = max(0.0, seconds + microseconds / 1e6 - since_s)
        return QueueFigures(queued, running, oldest_s, counts, webhooks | {DeliveryStatus.OWED: sum(map(int, owed))})

    def ping(self) -> None:
        with reachable():
            self._client.ping()

    def close(self) -> None:
        self._client.close()

    def _places(self, index: str, limit: int | None, before: ListingPosition | None) -> list[ListingPosition]:
        """At most `limit` positions of an index, newest first, that follow `before`."""
        if limit == 0:
            return []
        most = -1 if limit is None else limit
        with reachable(), self._client.pipeline(transaction=True) as batch:
            if before is None:
                batch.zrevrange(index, 0, -1 if limit is None else limit - 1, withscores=True)
            else:
                at = repr(before.created_at_s)
                batch.zrevrangebyscore(index, at, at, withscores=True)
                batch.zrevrangebyscore(index, f"({at}", "-inf", start=0, num=most, withscores=True)
            found = [ListingPosition(score, job_id) for answer in batch.execute() for job_id, score in answer]
        return [place for place in found if before is None or place < before][:limit]

    def _settle(self, claim: Claim, target: JobState, error: str = "") -> bool:
        return bool(self._scripts.run("settle", claim.job_id, claim.owner, claim.attempt, target.value, error))

    def _waiting(self, job_ids: list[str]) -> list[Waiting]:
        """These queued jobs with what decides the order of their claims."""
        with reachable(), self._client.pipeline(transaction=False) as batch:
            for job_id in job_ids:
                batch.hmget(_job_key(job_id), "tenant", "returned")
            answers = batch.execute(raise_on_error=False)
        found = [("", None) if isinstance(answer, redis.RedisError) else answer for answer in answers]
        return [Waiting(each, tenant or "", bool(back)) for each, (tenant, back) in zip(job_ids, found, strict=True)]

    def _usable(self, owner: str, job_id: str, answer: Sequence[str]) -> JobRecord | None:
        """The claimed record. A job whose record cannot be read fails, so that it does not block the queue."""
        fields = table_of(answer)
        record = record_of(job_id, fields)
        if record is None:
            claim = Claim(job_id, int(fields["attempt"]), owner)
            if not self.fail(claim, UNREADABLE):
                self.confirm_cancel(claim)
        return record

    def _get_all(self, job_ids: list[str]) -> dict[str, JobRecord]:
        """The records that exist and can be read, in the order of job_ids."""
        found = {job_id: record_of(job_id, fields) for job_id, fields in self._hashes(job_ids).items()}
        return {job_id: record for job_id, record in found.items() if record is not None}

    def _hashes(self, job_ids: list[str]) -> dict[str, dict[str, str]]:
        """The hashes of these jobs; empty where there is none."""
        with reachable():
            batch = self._client.pipeline(transaction=False)
            for job_id in job_ids:
                batch.hgetall(_job_key(job_id))
            answers = batch.execute(raise_on_error=False)
            for i, answer in enumerate(answers):
                if isinstance(answer, redis.RedisError):
                    if not str(answer).startswith("WRONGTYPE"):
                        raise answer
                    answers[i] = {"document": "something that is not a hash"}
        return dict(zip(job_ids, answers, strict=True))


def _address(name: str, document: str) -> WorkerAddress | None:
    """The address that a worker announced; None if it cannot be read, which is logged."""
    try:
        return WorkerAddress.model_validate_json(document)
    except ValueError as error:
        logger.error("A worker's address cannot be read.", extra={"worker": name, "error": type(error).__name__})
        return None


def _job_key(job_id: str) -> str:
    return f"{PREFIX}job:{job_id}"


def _worker_key(name: str) -> str:
    return f"{PREFIX}worker:{name}"
