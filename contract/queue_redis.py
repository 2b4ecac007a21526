"""The queue on Redis or Valkey Streams. This is the one file that touches keys.

Keys (the braces put all of them in one cluster slot, so that a script may touch several):
    {intrasplat}:jobs          stream; an entry has one field, `job` = job id. Group `workers`, consumer = worker name
    {intrasplat}:job:<id>      hash; the truth about one job:
        document               the JobRecord as submitted, JSON; never changes
        state                  a JobState; changes only by the scripts below, along TRANSITIONS
        attempt                how often it was claimed; with `owner` it is what a worker's report must match
        released               how many of those attempts were given back by a worker that was told to end
        owner                  name of the worker that holds, or last held, it
        entry                  id of its stream entry
        cancel                 "1" once a cancel was asked for
        progress, error        JSON of JobProgress, JobError
        started, finished      UNIX s by the server's clock
    {intrasplat}:index         sorted set of job ids by time of submission
    {intrasplat}:worker:<name> JSON of WorkerAddress; expires unless announced again
    {intrasplat}:workers       set of names that may have such a key

Every change of state is one script, and every script gives the same answer when it is run twice, so the client may
repeat a command whose reply was lost. Only the blocking read is never repeated: what it took and nobody heard of
stays pending for this consumer and is found by the next claim.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import redis
from redis.backoff import ExponentialBackoff, NoBackoff
from redis.retry import Retry

from contract.errors import UnavailableError
from contract.job import TERMINAL_STATES, JobError, JobProgress, JobRecord, JobState, sources_of
from contract.queue import LISTING_LIMIT, MAX_ATTEMPTS, WORKER_TTL_S, Claim, worker_died
from contract.rendering import WorkerAddress

PREFIX = "{intrasplat}:"
JOBS = PREFIX + "jobs"
INDEX = PREFIX + "index"
WORKERS = PREFIX + "workers"
GROUP = "workers"

Model = TypeVar("Model", JobProgress, JobError)

BLOCK_S = 2.0
"""Longest single blocking read: a cut connection is noticed within this and the socket's timeout."""

SOCKET_TIMEOUT_S = 5.0
CONNECT_TIMEOUT_S = 2.0
CONTROL_RETRIES = 3

SUBMIT = """
-- KEYS jobs, job, index; ARGV id, document, state, created
if redis.call('EXISTS', KEYS[2]) == 1 then return 0 end
local entry = redis.call('XADD', KEYS[1], '*', 'job', ARGV[1])
redis.call('HSET', KEYS[2], 'document', ARGV[2], 'state', ARGV[3], 'attempt', 0, 'entry', entry)
redis.call('ZADD', KEYS[3], ARGV[4], ARGV[1])
return 1
"""

CLAIM = """
-- KEYS jobs, job; ARGV group, entry, owner, max attempts, error, sources of running, of failed
-- 1: claimed. 0: the entry is of no use, and is gone.
local function among(state, list) return string.find(list, ',' .. state .. ',', 1, true) end
local function drop() redis.call('XACK', KEYS[1], ARGV[1], ARGV[2]); redis.call('XDEL', KEYS[1], ARGV[2]) end
local record = redis.call('HMGET', KEYS[2], 'state', 'owner', 'attempt', 'cancel', 'released')
local state, attempt = record[1], tonumber(record[3] or 0)
local deaths = attempt - tonumber(record[5] or 0)
local clock = redis.call('TIME')
local now = clock[1] .. '.' .. string.format('%06d', clock[2])
if state == 'running' and record[2] == ARGV[3] then
  -- Left by an earlier process of this name: it goes back to the queue, and from there as any other.
  if not record[4] and deaths >= tonumber(ARGV[4]) and among(state, ARGV[7]) then
    redis.call('HSET', KEYS[2], 'state', 'failed', 'finished', now, 'error', ARGV[5])
    drop()
    return 0
  end
  state = 'queued'
end
if not state or not among(state, ARGV[6]) then drop(); return 0 end
redis.call('HSET', KEYS[2], 'state', 'running', 'owner', ARGV[3], 'attempt', attempt + 1, 'started', now)
redis.call('HDEL', KEYS[2], 'progress')
return 1
"""

PROGRESS = """
-- KEYS job; ARGV owner, attempt, progress. 1: go on. 0: not yours any more, or cancel.
local record = redis.call('HMGET', KEYS[1], 'state', 'owner', 'attempt', 'cancel')
if record[1] ~= 'running' or record[2] ~= ARGV[1] or record[3] ~= ARGV[2] then return 0 end
redis.call('HSET', KEYS[1], 'progress', ARGV[3])
if record[4] then return 0 end
return 1
"""

SETTLE = """
-- KEYS jobs, job; ARGV group, owner, attempt, target, sources of target, error or ''
-- A job whose cancellation was asked for ends as cancelled, and no other does.
local record = redis.call('HMGET', KEYS[2], 'state', 'owner', 'attempt', 'cancel', 'entry')
if record[2] ~= ARGV[2] or record[3] ~= ARGV[3] then return 0 end
if record[1] == ARGV[4] then return 1 end
if not string.find(ARGV[5], ',' .. record[1] .. ',', 1, true) then return 0 end
if (ARGV[4] == 'cancelled') ~= (record[4] == '1') then return 0 end
local clock = redis.call('TIME')
redis.call('HSET', KEYS[2], 'state', ARGV[4], 'finished', clock[1] .. '.' .. string.format('%06d', clock[2]))
if ARGV[6] ~= '' then redis.call('HSET', KEYS[2], 'error', ARGV[6]) end
redis.call('XACK', KEYS[1], ARGV[1], record[5])
redis.call('XDEL', KEYS[1], record[5])
return 1
"""

RELEASE = """
-- KEYS job; ARGV owner, attempt, sources of queued. The stream's entry stays pending for the owner, whose next claim
-- finds it before all others.
local record = redis.call('HMGET', KEYS[1], 'state', 'owner', 'attempt', 'cancel')
if record[2] ~= ARGV[1] or record[3] ~= ARGV[2] then return 0 end
if record[1] == 'queued' then return 1 end
if record[4] or not string.find(ARGV[3], ',' .. record[1] .. ',', 1, true) then return 0 end
redis.call('HSET', KEYS[1], 'state', 'queued')
redis.call('HINCRBY', KEYS[1], 'released', 1)
redis.call('HDEL', KEYS[1], 'progress')
return 1
"""

CANCEL = """
-- KEYS jobs, job; ARGV group, sources of cancelled
local record = redis.call('HMGET', KEYS[2], 'state', 'entry')
local state = record[1]
if not state then return 0 end
if not string.find(ARGV[2], ',' .. state .. ',', 1, true) then return 1 end
redis.call('HSET', KEYS[2], 'cancel', '1')
if state == 'queued' then
  local clock = redis.call('TIME')
  redis.call('HSET', KEYS[2], 'state', 'cancelled', 'finished', clock[1] .. '.' .. string.format('%06d', clock[2]))
  redis.call('XACK', KEYS[1], ARGV[1], record[2])
  redis.call('XDEL', KEYS[1], record[2])
end
return 1
"""

FORGET = """
-- KEYS job, index; ARGV id, terminal states
local state = redis.call('HGET', KEYS[1], 'state')
if not state or not string.find(ARGV[2], ',' .. state .. ',', 1, true) then return 0 end
redis.call('DEL', KEYS[1])
redis.call('ZREM', KEYS[2], ARGV[1])
return 1
"""


class RedisQueue:
    """A Queue on a Redis 7+ or Valkey server (`redis://`, `rediss://` or `unix://`); safe to share among threads."""

    def __init__(self, url: str) -> None:
        self._control: Any = _connect(url, Retry(ExponentialBackoff(cap=0.5, base=0.05), CONTROL_RETRIES))
        self._reader: Any = _connect(url, Retry(NoBackoff(), 0))
        script: Callable[[str], Any] = self._control.register_script
        self._submit, self._claim, self._progress = script(SUBMIT), script(CLAIM), script(PROGRESS)
        self._settle_script, self._release = script(SETTLE), script(RELEASE)
        self._cancel, self._forget = script(CANCEL), script(FORGET)

    def submit(self, record: JobRecord) -> bool:
        keys = [JOBS, _job_key(record.job_id), INDEX]
        arguments = [record.job_id, record.model_dump_json(), record.state.value, repr(record.created_at_s)]
        with _reachable():
            return bool(self._submit(keys=keys, args=arguments))

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        deadline = time.monotonic() + timeout_s
        with _reachable():
            while (entry := self._read(owner, "0", 0.0)) is not None:
                if (record := self._take(owner, *entry)) is not None:
                    return record
            while True:
                left_s = max(0.0, deadline - time.monotonic())
                entry = self._read(owner, ">", min(BLOCK_S, left_s))
                if entry is not None and (record := self._take(owner, *entry)) is not None:
                    return record
                if time.monotonic() >= deadline:
                    return None

    def progress(self, claim: Claim, progress: JobProgress) -> bool:
        arguments = [claim.owner, claim.attempt, progress.model_dump_json()]
        with _reachable():
            return bool(self._progress(keys=[_job_key(claim.job_id)], args=arguments))

    def finish(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.DONE)

    def fail(self, claim: Claim, error: JobError) -> bool:
        return self._settle(claim, JobState.FAILED, error.model_dump_json())

    def confirm_cancel(self, claim: Claim) -> bool:
        return self._settle(claim, JobState.CANCELLED)

    def release(self, claim: Claim) -> bool:
        arguments = [claim.owner, claim.attempt, _sources(JobState.QUEUED)]
        with _reachable():
            return bool(self._release(keys=[_job_key(claim.job_id)], args=arguments))

    def cancel(self, job_id: str) -> JobRecord | None:
        with _reachable():
            self._cancel(keys=[JOBS, _job_key(job_id)], args=[GROUP, _sources(JobState.CANCELLED)])
        return self.get(job_id)

    def get(self, job_id: str) -> JobRecord | None:
        with _reachable():
            return _record(self._control.hgetall(_job_key(job_id)))

    def records(self, limit: int = LISTING_LIMIT) -> list[JobRecord]:
        with _reachable():
            job_ids = self._control.zrevrange(INDEX, 0, limit - 1)
            batch = self._control.pipeline(transaction=False)
            for job_id in job_ids:
                batch.hgetall(_job_key(job_id))
            found = [_record(fields) for fields in batch.execute()]
        return [record for record in found if record is not None]

    def forget(self, job_id: str) -> bool:
        terminal = f",{','.join(sorted(TERMINAL_STATES))},"
        with _reachable():
            return bool(self._forget(keys=[_job_key(job_id), INDEX], args=[job_id, terminal]))

    def announce(self, address: WorkerAddress) -> None:
        with _reachable():
            batch = self._control.pipeline(transaction=True)
            batch.set(_worker_key(address.name), address.model_dump_json(), px=round(WORKER_TTL_S * 1000))
            batch.sadd(WORKERS, address.name)
            batch.execute()

    def withdraw(self, name: str) -> None:
        with _reachable():
            self._control.delete(_worker_key(name))

    def workers(self) -> list[WorkerAddress]:
        with _reachable():
            names = sorted(self._control.smembers(WORKERS))
            documents = self._control.mget([_worker_key(name) for name in names]) if names else []
        return [WorkerAddress.model_validate_json(document) for document in documents if document]

    def ping(self) -> None:
        with _reachable():
            self._control.ping()

    def close(self) -> None:
        self._control.close()
        self._reader.close()

    def _read(self, owner: str, after: str, block_s: float) -> tuple[str, str | None] | None:
        """The next stream entry as (entry id, job id): after="0" what is pending for owner, ">" what is new."""
        block_ms = max(1, round(block_s * 1000)) if after == ">" else None
        try:
            answer = self._reader.xreadgroup(GROUP, owner, {JOBS: after}, count=1, block=block_ms)
        except redis.ResponseError as error:
            if "NOGROUP" not in str(error):
                raise
            self._make_group()
            return None
        entries = answer[0][1] if answer else []
        if not entries:
            return None
        entry_id, fields = entries[0]
        return entry_id, (fields or {}).get("job")

    def _make_group(self) -> None:
        try:
            self._control.xgroup_create(JOBS, GROUP, id="0", mkstream=True)
        except redis.ResponseError as error:
            if "BUSYGROUP" not in str(error):  # another worker was first
                raise

    def _take(self, owner: str, entry_id: str, job_id: str | None) -> JobRecord | None:
        """Claim the job of a stream entry; None if it turned out to be of no use."""
        if job_id is None:  # the entry was deleted while it was pending
            self._control.xack(JOBS, GROUP, entry_id)
            return None
        arguments = [GROUP, entry_id, owner, MAX_ATTEMPTS, worker_died().model_dump_json()]
        arguments += [_sources(state) for state in (JobState.RUNNING, JobState.FAILED)]
        claimed = self._claim(keys=[JOBS, _job_key(job_id)], args=arguments)
        return self.get(job_id) if claimed else None

    def _settle(self, claim: Claim, target: JobState, error: str = "") -> bool:
        arguments = [GROUP, claim.owner, claim.attempt, target.value, _sources(target), error]
        with _reachable():
            return bool(self._settle_script(keys=[JOBS, _job_key(claim.job_id)], args=arguments))


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
    except (redis.ConnectionError, redis.TimeoutError, redis.exceptions.ReadOnlyError) as error:
        problem = f"The queue does not answer ({type(error).__name__})."
        raise UnavailableError(problem, "Start it with `intrasplat up`, or correct REDIS_URL.") from error
    except redis.exceptions.OutOfMemoryError as error:
        raise UnavailableError("The queue's memory is full.", "Raise its maxmemory or delete old jobs.") from error


def _job_key(job_id: str) -> str:
    return f"{PREFIX}job:{job_id}"


def _worker_key(name: str) -> str:
    return f"{PREFIX}worker:{name}"


def _sources(target: JobState) -> str:
    """The states `target` may be reached from, as the scripts search them: ",queued,running,"."""
    return f",{','.join(sorted(sources_of(target)))},"


def _record(fields: dict[str, str]) -> JobRecord | None:
    """The record a job's hash describes; None if there is no such hash."""
    if "document" not in fields:
        return None
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


def _parsed(model: type[Model], document: str | None) -> Model | None:
    return model.model_validate_json(document) if document else None
