"""The queue on Redis 7+ or Valkey Streams. This file and contract/queue_scripts.py are all that touches keys.

Keys (the braces put all of them in one cluster slot, so that a script may touch several):
    {intrasplat}:jobs:high      stream; an entry has one field, `job` = job id. Group `workers`, consumer = owner
    {intrasplat}:jobs:standard  the same for the other priority
    {intrasplat}:job:<id>       hash; the truth about one job:
        document                the JobRecord as submitted, JSON; never changes
        state                   a JobState; changes only along TRANSITIONS
        attempt                 how often it was claimed; with `owner` it is what a worker's report must match
        released                how many of those attempts are not held against the job
        owner                   who holds, or last held, it
        entry, priority, tenant, once   its stream entry, and what the indexes below are made from
        since                   ms at which it began to wait
        cancel                  "1" once a cancel was asked for
        progress, error         JSON of JobProgress, JobError
        started, finished       UNIX s by the server's clock
    {intrasplat}:events:<id>    stream of what every change left of the hash
    {intrasplat}:index[:<tenant>]    sorted sets of job ids by time of submission
    {intrasplat}:waiting[:<tenant>]  sorted sets of queued jobs in the order in which they will be claimed
    {intrasplat}:running        set of running jobs;  {intrasplat}:held  hash owner -> job
    {intrasplat}:dead           sorted set of failed jobs by ms;  {intrasplat}:ended  hash state -> how many ever
    {intrasplat}:durations      list of the last done jobs' seconds;  {intrasplat}:arrivals  counter
    {intrasplat}:bell           stream that wakes claimers when a job was handed back
    {intrasplat}:once:<tenant>:<hash>  job id submitted under that idempotency key; expires
    {intrasplat}:yields:<id>    somebody makes way for that job; expires
    {intrasplat}:worker:<name>  JSON of WorkerAddress; expires unless announced again
    {intrasplat}:workers        set of names that may have such a key

A user for this needs: ACL SETUSER intrasplat on >PASSWORD ~{intrasplat}:* +@all -@dangerous -@admin +info

Every change of state is one script, and every script gives the same answer when it is run twice, so the client may
repeat a command whose reply was lost. Claiming, too, is one script; what blocks is a plain XREAD that takes nothing.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import redis
from pydantic import ValidationError
from redis.backoff import ExponentialBackoff, NoBackoff
from redis.retry import Retry

from contract import queue_scripts as scripts
from contract.errors import UnavailableError
from contract.job import TERMINAL_STATES, TRANSITIONS, JobError, JobProgress, JobRecord, JobState, Standing
from contract.queue import (
    DURATIONS_KEPT,
    IDEMPOTENCY_S,
    LISTING_LIMIT,
    WORKER_TTL_S,
    Admission,
    Claim,
    Event,
    Order,
    QueueFigures,
    QueueFullError,
    estimate,
    worker_died,
)
from contract.rendering import WorkerAddress

PREFIX = "{intrasplat}:"
STREAMS = (PREFIX + "jobs:high", PREFIX + "jobs:standard", PREFIX + "bell")

Model = TypeVar("Model", JobProgress, JobError)

BLOCK_S = 0.5
"""Longest single blocking read: leases that run out make no sound, so the claim is tried again after it."""

SOCKET_TIMEOUT_S = 5.0
CONNECT_TIMEOUT_S = 2.0
CONTROL_RETRIES = 3

logger = logging.getLogger("intrasplat.queue")


class RedisQueue:
    """A Queue on a Redis 7+ or Valkey server (`redis://`, `rediss://` or `unix://`); safe to share among threads."""

    def __init__(self, url: str) -> None:
        self._control: Any = _connect(url, Retry(ExponentialBackoff(cap=0.5, base=0.05), CONTROL_RETRIES))
        self._reader: Any = _connect(url, Retry(NoBackoff(), 0))
        self._transitions = json.dumps({state: sorted(following) for state, following in TRANSITIONS.items()})
        self._submit = self._script(scripts.SUBMIT, when_full=False)
        self._restore = self._script(scripts.RESTORE, when_full=False)
        self._claim = self._script(scripts.CLAIM, when_full=True)
        self._beat = self._script(scripts.BEAT, when_full=True)
        self._settle_job = self._script(scripts.SETTLE, when_full=True)
        self._release = self._script(scripts.RELEASE, when_full=True)
        self._cancel = self._script(scripts.CANCEL, when_full=True)
        self._retry = self._script(scripts.RETRY, when_full=False)
        self._forget = self._script(scripts.FORGET, when_full=True)

    def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
        most = (admission.queued, admission.queued_per_tenant) if admission else ("", "")
        kind, value = self._submit(
            record.job_id,
            record.model_dump_json(),
            record.tenant,
            record.options.priority,
            record.idempotency_key or "",
            IDEMPOTENCY_S * 1000,
            repr(record.created_at_s),
            *most,
        )
        if kind == "tenant":
            raise QueueFullError.for_tenant(int(value))
        if kind == "all":
            raise QueueFullError.for_all(int(value))
        return record if value == record.job_id and self._is_new(record) else self.get(value) or record

    def restore(self, record: JobRecord) -> bool:
        return bool(
            self._restore(
                record.job_id,
                record.model_dump_json(),
                record.tenant,
                record.options.priority,
                repr(record.created_at_s),
                record.state.value,
                record.attempt,
                repr(record.finished_at_s or record.created_at_s),
            )
        )

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        deadline_s = time.monotonic() + timeout_s
        while True:
            job_id, *last_ids = self._claim(owner, worker_died().model_dump_json())
            if job_id:
                record = self.get(job_id)
                if record is not None:
                    return record
                self._reject(job_id, owner)
                continue
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                return None
            block_ms = max(1, round(1000 * min(BLOCK_S, left_s)))
            with _reachable():
                self._reader.xread(dict(zip(STREAMS, last_ids, strict=True)), count=1, block=block_ms)

    def beat(self, claim: Claim, progress: JobProgress | None = None) -> Order:
        document = progress.model_dump_json() if progress else ""
        return Order(self._beat(claim.job_id, claim.owner, claim.attempt, document))

    def finish(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.DONE)

    def fail(self, claim: Claim, error: JobError) -> bool:
        return self._settle(claim, JobState.FAILED, error.model_dump_json())

    def confirm_cancel(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.CANCELLED)

    def release(self, claim: Claim, *, died: bool = False) -> bool:
        error = worker_died().model_dump_json()
        return bool(self._release(claim.job_id, claim.owner, claim.attempt, "1" if died else "", error))

    def cancel(self, job_id: str) -> JobRecord | None:
        self._cancel(job_id)
        return self.get(job_id)

    def retry(self, job_id: str) -> JobRecord | None:
        self._retry(job_id)
        return self.get(job_id)

    def get(self, job_id: str) -> JobRecord | None:
        with _reachable():
            return _record(job_id, self._control.hgetall(_job_key(job_id)))

    def standing(self, job_id: str) -> Standing:
        with _reachable():
            batch = self._control.pipeline(transaction=True)
            batch.hgetall(_job_key(job_id))
            batch.zrank(PREFIX + "waiting", job_id)
            batch.lrange(PREFIX + "durations", 0, -1)
            fields, position, durations = batch.execute()
            record = _record(job_id, fields)
        if record is None or record.state in TERMINAL_STATES:
            return Standing(position=None, eta_s=None)
        position = None if record.state is JobState.RUNNING else position
        return estimate(record, position, len(self.workers()), [float(duration) for duration in durations])

    def records(self, tenant: str | None = None, limit: int | None = LISTING_LIMIT) -> list[JobRecord]:
        index = PREFIX + "index" + (f":{tenant}" if tenant else "")
        with _reachable():
            job_ids = self._control.zrevrange(index, 0, -1 if limit is None else limit - 1)
            batch = self._control.pipeline(transaction=False)
            for job_id in job_ids:
                batch.hgetall(_job_key(job_id))
            found = [_record(job_id, fields) for job_id, fields in zip(job_ids, batch.execute(), strict=True)]
        return [record for record in found if record is not None]

    def events(self, job_id: str, after: str = "0") -> list[Event]:
        with _reachable():
            batch = self._control.pipeline(transaction=True)
            batch.hget(_job_key(job_id), "document")
            batch.xrange(f"{PREFIX}events:{job_id}", min=f"({after}" if after != "0" else "-")
            document, entries = batch.execute()
        found = [(number, _record(job_id, {"document": document or "", **fields})) for number, fields in entries]
        return [Event(number, record) for number, record in found if record is not None]

    def forget(self, job_id: str) -> bool:
        return bool(self._forget(job_id, json.dumps(sorted(TERMINAL_STATES))))

    def announce(self, address: WorkerAddress) -> None:
        with _reachable():
            batch = self._control.pipeline(transaction=True)
            batch.set(_worker_key(address.name), address.model_dump_json(), px=round(WORKER_TTL_S * 1000))
            batch.sadd(PREFIX + "workers", address.name)
            batch.execute()

    def withdraw(self, name: str) -> None:
        with _reachable():
            batch = self._control.pipeline(transaction=True)
            batch.delete(_worker_key(name))
            batch.srem(PREFIX + "workers", name)
            batch.execute()

    def workers(self) -> list[WorkerAddress]:
        with _reachable():
            names = sorted(self._control.smembers(PREFIX + "workers"))
            documents = self._control.mget([_worker_key(name) for name in names]) if names else []
        return [WorkerAddress.model_validate_json(document) for document in documents if document]

    def figures(self) -> QueueFigures:
        with _reachable():
            batch = self._control.pipeline(transaction=True)
            batch.zrange(PREFIX + "waiting", 0, -1)
            batch.scard(PREFIX + "running")
            batch.hgetall(PREFIX + "ended")
            batch.time()
            waiting, running, ended, (seconds, _) = batch.execute()
            batch = self._control.pipeline(transaction=False)
            for job_id in waiting:
                batch.hget(_job_key(job_id), "since")
            since_ms = [float(since) for since in batch.execute() if since]
        oldest_s = max(0.0, seconds - min(since_ms) / 1000) if since_ms else 0.0
        counts = {state: int(ended.get(state, 0)) for state in sorted(TERMINAL_STATES)}
        return QueueFigures(len(waiting), running, oldest_s, counts)

    def ping(self) -> None:
        with _reachable():
            self._control.ping()

    def close(self) -> None:
        self._control.close()
        self._reader.close()

    def _script(self, body: str, *, when_full: bool) -> Callable[..., Any]:
        run: Any = self._control.register_script(scripts.script_text(body, when_full=when_full))

        def call(*arguments: Any) -> Any:
            with _reachable():
                return run(keys=[STREAMS[0]], args=[self._transitions, *arguments])

        return call

    def _is_new(self, record: JobRecord) -> bool:
        """Whether the record is the queue's own: nothing else can have happened to a job not submitted before."""
        known = self.get(record.job_id)
        return known is None or (known.state is JobState.QUEUED and known.attempt == 0)

    def _settle(self, claim: Claim, target: JobState, error: str = "") -> bool:
        return bool(self._settle_job(claim.job_id, claim.owner, claim.attempt, target.value, error, DURATIONS_KEPT))

    def _reject(self, job_id: str, owner: str) -> None:
        """End a job whose record cannot be read, so that nobody claims it again."""
        with _reachable():
            attempt = self._control.hget(_job_key(job_id), "attempt")
        problem = "The queue holds a record of this job that this version cannot read."
        error = JobError(problem=problem, remedy="Send the clip again, or run one version everywhere.")
        self._settle_job(job_id, owner, attempt, JobState.FAILED.value, error.model_dump_json(), DURATIONS_KEPT)


def _connect(url: str, retry: Retry) -> Any:
    """A client with every default that has changed between releases of redis-py stated."""
    return redis.Redis.from_url(
        url,
        decode_responses=True,
        protocol=2,
        retry=retry,
        socket_timeout=SOCKET_TIMEOUT_S,
        socket_connect_timeout=CONNECT_TIMEOUT_S,
    )


@contextmanager
def _reachable() -> Iterator[None]:
    """Turn connection trouble into the error that names the remedy."""
    try:
        yield
    except (redis.exceptions.AuthenticationError, redis.exceptions.NoPermissionError) as error:
        raise UnavailableError("The queue refuses this user.", "Correct the user and password in REDIS_URL.") from error
    except (redis.ConnectionError, redis.TimeoutError, redis.exceptions.ReadOnlyError) as error:
        problem = f"The queue does not answer ({type(error).__name__})."
        raise UnavailableError(problem, "Start it with `intrasplat up`, or correct REDIS_URL.") from error
    except redis.exceptions.OutOfMemoryError as error:
        raise UnavailableError("The queue's memory is full.", "Raise its maxmemory or delete old jobs.") from error
    except redis.ResponseError as error:
        kind = str(error).split(" ", 1)[0]
        if kind not in ("READONLY", "OOM", "MISCONF", "LOADING", "MASTERDOWN", "NOREPLICAS", "CLUSTERDOWN"):
            raise
        remedy = "Look at the queue server's log: its disk or memory may be full, or it is a replica."
        raise UnavailableError(f"The queue cannot write now ({kind}).", remedy) from error


def _job_key(job_id: str) -> str:
    return f"{PREFIX}job:{job_id}"


def _worker_key(name: str) -> str:
    return f"{PREFIX}worker:{name}"


def _record(job_id: str, fields: Mapping[str, str]) -> JobRecord | None:
    """The record that a job's hash, or an event, describes; None if there is none, or none that can be read."""
    if not fields.get("document"):
        return None
    try:
        submitted = JobRecord.model_validate_json(fields["document"])
        return submitted.model_copy(
            update={
                "state": JobState(fields["state"]),
                "attempt": int(fields["attempt"]),
                "released": int(fields.get("released", 0)),
                "owner": fields.get("owner"),
                "cancel_requested": "cancel" in fields,
                "progress": _parsed(JobProgress, fields.get("progress")),
                "error": _parsed(JobError, fields.get("error")),
                "started_at_s": float(fields["started"]) if "started" in fields else None,
                "finished_at_s": float(fields["finished"]) if "finished" in fields else None,
            }
        )
    except (ValidationError, ValueError, KeyError) as error:
        logger.error("the record of a job cannot be read (%s)", type(error).__name__, extra={"job_id": job_id})
        return None


def _parsed(model: type[Model], document: str | None) -> Model | None:
    return model.model_validate_json(document) if document else None
