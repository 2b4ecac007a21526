"""The queue inside one process: the plainest statement of what contract/queue.py promises."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque

from contract.job import TERMINAL_STATES, TRANSITIONS, JobError, JobProgress, JobRecord, JobState
from contract.queue import LISTING_LIMIT, MAX_ATTEMPTS, WORKER_TTL_S, Claim, worker_died
from contract.rendering import WorkerAddress


class MemoryQueue:
    """A Queue; one lock makes each method atomic."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._records: OrderedDict[str, JobRecord] = OrderedDict()
        self._waiting: deque[str] = deque()
        self._workers: dict[str, tuple[float, WorkerAddress]] = {}

    def submit(self, record: JobRecord) -> bool:
        with self._changed:
            if record.job_id in self._records:
                return False
            self._records[record.job_id] = record
            self._waiting.append(record.job_id)
            self._changed.notify()
            return True

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        with self._changed:
            self._hand_back(owner)
            if not self._changed.wait_for(lambda: bool(self._waiting), timeout_s):
                return None
            record = self._records[self._waiting.popleft()]
            now = {"owner": owner, "attempt": record.attempt + 1, "started_at_s": time.time(), "progress": None}
            return self._change(record, JobState.RUNNING, **now)

    def progress(self, claim: Claim, progress: JobProgress) -> bool:
        with self._changed:
            record = self._held(claim)
            if record is None:
                return False
            self._records[claim.job_id] = record.model_copy(update={"progress": progress})
            return not record.cancel_requested

    def finish(self, claim: Claim) -> bool:
        with self._changed:
            record = self._held(claim)
            if record is None or record.cancel_requested:
                return False
            self._change(record, JobState.DONE)
            return True

    def fail(self, claim: Claim, error: JobError) -> bool:
        with self._changed:
            record = self._held(claim)
            if record is None or record.cancel_requested:
                return False
            self._change(record, JobState.FAILED, error=error)
            return True

    def confirm_cancel(self, claim: Claim) -> bool:
        with self._changed:
            record = self._held(claim)
            if record is None or not record.cancel_requested:
                return False
            self._change(record, JobState.CANCELLED)
            return True

    def release(self, claim: Claim) -> bool:
        with self._changed:
            record = self._held(claim)
            if record is None or record.cancel_requested:
                return False
            self._change(record, JobState.QUEUED, released=record.released + 1, progress=None)
            self._waiting.appendleft(record.job_id)
            self._changed.notify()
            return True

    def cancel(self, job_id: str) -> JobRecord | None:
        with self._changed:
            record = self._records.get(job_id)
            if record is None:
                return None
            if record.state is JobState.QUEUED:
                self._waiting.remove(job_id)
                self._change(record, JobState.CANCELLED, cancel_requested=True)
            elif record.state is JobState.RUNNING:
                self._records[job_id] = record.model_copy(update={"cancel_requested": True})
            return self._records[job_id]

    def get(self, job_id: str) -> JobRecord | None:
        with self._changed:
            return self._records.get(job_id)

    def records(self, limit: int = LISTING_LIMIT) -> list[JobRecord]:
        with self._changed:
            newest_first = sorted(self._records.values(), key=lambda record: record.created_at_s, reverse=True)
            return newest_first[:limit]

    def forget(self, job_id: str) -> bool:
        with self._changed:
            record = self._records.get(job_id)
            if record is None or record.state not in TERMINAL_STATES:
                return False
            del self._records[job_id]
            return True

    def announce(self, address: WorkerAddress) -> None:
        with self._changed:
            self._workers[address.name] = (time.monotonic() + WORKER_TTL_S, address)

    def withdraw(self, name: str) -> None:
        with self._changed:
            self._workers.pop(name, None)

    def workers(self) -> list[WorkerAddress]:
        with self._changed:
            now = time.monotonic()
            return [address for name, (until, address) in sorted(self._workers.items()) if until > now]

    def ping(self) -> None:
        return None

    def close(self) -> None:
        return None

    def _held(self, claim: Claim) -> JobRecord | None:
        """The running record `claim` still holds."""
        record = self._records.get(claim.job_id)
        if record is None or record.state is not JobState.RUNNING:
            return None
        return record if (record.attempt, record.owner) == (claim.attempt, claim.owner) else None

    def _hand_back(self, owner: str) -> None:
        """Whatever `owner` left running was left by a process that died: queue it again, or give it up."""
        for record in list(self._records.values()):
            if record.state is not JobState.RUNNING or record.owner != owner:
                continue
            if not record.cancel_requested and record.attempt - record.released >= MAX_ATTEMPTS:
                self._change(record, JobState.FAILED, error=worker_died())
            else:
                self._change(record, JobState.QUEUED)
                self._waiting.appendleft(record.job_id)

    def _change(self, record: JobRecord, target: JobState, **update: object) -> JobRecord:
        if target not in TRANSITIONS[record.state]:
            raise AssertionError(f"{record.state} -> {target} is not in TRANSITIONS")
        if target in TERMINAL_STATES:
            update["finished_at_s"] = time.time()
        changed = record.model_copy(update={"state": target, **update})
        self._records[record.job_id] = changed
        return changed
