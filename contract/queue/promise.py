"""The queue, as everyone sees it: the service submits, cancels and retries, a worker claims, beats and settles.

Two implementations obey this file and pass the same tests: contract/queue/redis_queue.py, which deployments use, and
contract/queue/memory.py, for tests and for a worker inside one process.

A claim is a lease by liveness: it stands as long as its worker beats. After LEASE_S without a beat the job is
anybody's again, as a new attempt; every report carries the attempt, so what a worker says that was thought dead
changes nothing (the attempt is the fence).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from statistics import median
from typing import Protocol

from contract.wire.errors import UnavailableError
from contract.wire.job import JobError, JobProgress, JobRecord, JobState, Standing
from contract.wire.rendering import WorkerAddress

MAX_ATTEMPTS = 3
"""A job whose worker died this often is taken for the cause of it and fails."""

BEAT_PERIOD_S = 2.0
LEASE_S = 8.0
"""Three beats may be late or lost."""

PREEMPT_AFTER_S = 1.0
"""A high-priority job that nobody has claimed for so long takes the place of a standard one."""

YIELD_S = 20.0
"""How long the worker that was told to make way may take before another is told too."""

WORKER_TTL_S = 10.0
"""A worker that has not announced itself for this long is not live."""

ANNOUNCE_PERIOD_S = 2.0

IDEMPOTENCY_S = 24 * 3600
"""How long a submission may be repeated under its idempotency key."""

DURATIONS_KEPT = 20
"""Done jobs from whose durations the next ones' are estimated."""

LISTING_LIMIT = 200
"""GET /jobs shows the newest this many."""

EVENTS_KEPT = 200
"""Of each job, for callers that come back and ask for what they missed."""

EVENT_NUMBER = re.compile(r"(\d{1,19})(?:-(\d{1,19}))?", re.ASCII)
"""Milliseconds, and a count within them."""


class Order(StrEnum):
    """What a beat is answered with."""

    GO_ON = "go-on"
    CANCEL = "cancel"
    """Stop, remove, confirm_cancel."""
    YIELD = "yield"
    """Stop, keep the state, release: a high-priority job waits and nobody is free."""
    LOST = "lost"
    """The claim no longer stands: stop, and touch nothing but this attempt's own folder."""


@dataclass(frozen=True)
class Claim:
    """A worker's hold on one attempt of a job; all its reports carry it, and a stale one changes nothing."""

    job_id: str
    attempt: int
    owner: str


@dataclass(frozen=True)
class Admission:
    """How many jobs may wait: of all callers, and of one tenant."""

    queued: int
    queued_per_tenant: int


@dataclass(frozen=True)
class Event:
    """A change of a job: its number, which only grows, and the record as the change left it."""

    number: str
    record: JobRecord


@dataclass(frozen=True)
class QueueFigures:
    """For metrics. ended: jobs that came to each terminal state since the queue was made."""

    queued: int
    running: int
    oldest_queued_s: float
    ended: dict[JobState, int]


class QueueFullError(UnavailableError):
    """Too many jobs wait; `tenant` says whether the caller's own share is used up (HTTP 429, else 503)."""

    def __init__(self, problem: str, remedy: str, *, tenant: bool) -> None:
        super().__init__(problem, remedy)
        self.tenant = tenant


class Queue(Protocol):
    """Every method is atomic and may be repeated when its answer was lost; those that change a job say what came of it.

    All raise UnavailableError when the queue cannot be reached or its memory is full.
    """

    def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
        """Enqueue a job; the record that stands in the queue afterwards.

        That is another one if the tenant submitted a job under the same idempotency key within IDEMPOTENCY_S, and the
        job itself, unchanged, if its id is there already.

        Raises:
            QueueFullError: admission leaves no room; nothing was changed.
        """
        ...

    def restore(self, record: JobRecord) -> bool:
        """Put back the record of an ended job that the queue has lost; False if it knows the job."""
        ...

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        """The next job, now running and owned; None after timeout_s.

        High priority before standard, so that a job that made way waits for the one it made way for; within each,
        jobs that were released or whose lease has run out before new ones. An owner holds one job at a time: while it
        holds one (because the answer to its claim was lost), it is given that one again, as the same attempt. A job
        whose workers died MAX_ATTEMPTS times fails instead; one with cancel_requested ends as cancelled instead.
        """
        ...

    def beat(self, claim: Claim, progress: JobProgress | None = None) -> Order:
        """Renew the lease, record progress if there is any, and hear what to do."""
        ...

    def finish(self, claim: Claim) -> bool:
        """running -> done; False if the claim no longer stands or a cancel was asked for."""
        ...

    def fail(self, claim: Claim, error: JobError) -> bool:
        """running -> failed, a dead letter; False if the claim no longer stands or a cancel was asked for."""
        ...

    def confirm_cancel(self, claim: Claim) -> bool:
        """running -> cancelled, by the worker that has stopped; False if nobody asked for it."""
        ...

    def release(self, claim: Claim, *, died: bool = False) -> bool:
        """running -> queued, first in line; False if the claim no longer stands or a cancel was asked for.

        died: the attempt is held against the job, and after MAX_ATTEMPTS of them it is failed, a dead letter.
        """
        ...

    def cancel(self, job_id: str) -> JobRecord | None:
        """queued -> cancelled at once; running: ask its worker. The record afterwards; None if there is none."""
        ...

    def retry(self, job_id: str) -> JobRecord | None:
        """failed -> queued, earlier deaths forgiven. The record afterwards; None if there is none."""
        ...

    def get(self, job_id: str) -> JobRecord | None:
        """The job's record."""
        ...

    def standing(self, job_id: str) -> Standing:
        """Position in the queue and when the job may be done, from the duration of the last ones."""
        ...

    def records(self, tenant: str | None = None, limit: int | None = LISTING_LIMIT) -> list[JobRecord]:
        """The newest jobs of a tenant, or of all, newest first."""
        ...

    def events(self, job_id: str, after: str = "0") -> list[Event]:
        """What has happened to the job after the event of that number, oldest first; at once, without waiting."""
        ...

    def forget(self, job_id: str) -> bool:
        """Remove record, events and idempotency key of a job in a terminal state; False if missing or still live."""
        ...

    def rewrite_log(self) -> bool:
        """Drop from the server's log on disk what it still holds of forgotten jobs; False if it cannot just now."""
        ...

    def announce(self, address: WorkerAddress) -> None:
        """Say that a worker is live, for WORKER_TTL_S."""
        ...

    def withdraw(self, name: str) -> None:
        """Say that a worker has stopped."""
        ...

    def workers(self) -> list[WorkerAddress]:
        """The live workers, by name."""
        ...

    def figures(self) -> QueueFigures:
        """How much waits, runs and has ended."""
        ...

    def ping(self) -> None:
        """Return if the queue answers."""
        ...

    def close(self) -> None:
        """Let go of connections."""
        ...


def worker_died() -> JobError:
    """The error of a job that took MAX_ATTEMPTS workers down with it."""
    problem = f"The worker died {MAX_ATTEMPTS} times while it ran this job."
    return JobError(problem=problem, remedy="Try a shorter or smaller clip, and look at the worker's log.")


def check_admission(admission: Admission, queued: int, queued_of_tenant: int) -> None:
    """Refuse one job more when so many wait.

    Raises:
        QueueFullError: the tenant's share or the whole queue is used up.
    """
    if queued_of_tenant >= admission.queued_per_tenant:
        problem = f"{queued_of_tenant} jobs of yours wait already; {admission.queued_per_tenant} may."
        raise QueueFullError(problem, "Submit again when one of them has been started.", tenant=True)
    if queued >= admission.queued:
        raise QueueFullError(
            f"{queued} jobs wait already; {admission.queued} may.", "Submit again later.", tenant=False
        )


def estimate_end_s(
    durations_s: list[float], position: int | None, own_s: float, running_s: list[float], workers: int
) -> float | None:
    """Seconds until a job is done, if it and all before it take as long as the median of the last ones; None: unknown.

    position: how many jobs wait before it, None while it runs itself, since own_s; running_s: how long each running
    job has run; workers: how many are live and share the work.
    """
    if not durations_s:
        return None
    usual_s = median(durations_s)
    if position is None:
        return max(0.0, usual_s - own_s)
    if workers == 0:
        return None
    left_s = sum(max(0.0, usual_s - ran_s) for ran_s in running_s)
    return (left_s + position * usual_s) / workers + usual_s


def correct_end_s(record: JobRecord, estimated_s: float | None) -> float | None:
    """The estimate from other jobs, put right by what this one says: what is left of it, or the budget it was given."""
    progress = record.progress
    if progress is not None and progress.seconds_left is not None:
        return progress.seconds_left
    if estimated_s is not None and progress is None and record.options.budget_s is not None:
        return max(estimated_s, record.options.budget_s)
    return estimated_s


def event_order(number: str) -> tuple[int, int]:
    """What event numbers are compared by; a number that no event can have comes before all."""
    parts = EVENT_NUMBER.fullmatch(number)
    return (int(parts[1]), int(parts[2] or 0)) if parts else (0, 0)
