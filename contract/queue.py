"""The queue, as everyone sees it: the service submits and cancels, a worker claims, reports and settles.

Two implementations obey this file and pass the same tests: contract/queue_redis.py, which deployments use, and
contract/queue_memory.py, for tests and for a worker inside one process.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from contract.job import JobError, JobProgress, JobRecord
from contract.rendering import WorkerAddress

MAX_ATTEMPTS = 3
"""A job whose worker died this often is taken for the cause of it and fails."""

WORKER_TTL_S = 10.0
"""A worker that has not announced itself for this long is not live."""

ANNOUNCE_PERIOD_S = 3.0

LISTING_LIMIT = 200
"""GET /jobs shows the newest this many."""


@dataclass(frozen=True)
class Claim:
    """A worker's hold on one attempt of a job; all its reports carry it, and a stale one changes nothing."""

    job_id: str
    attempt: int
    owner: str


class Queue(Protocol):
    """Every method is atomic; those that change a job return whether, or to what, it changed.

    All raise UnavailableError when the queue cannot be reached.
    """

    def submit(self, record: JobRecord) -> bool:
        """Enqueue a job; False if one of that id is there already (so that a submit may be repeated)."""
        ...

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        """The next job, now running and owned; None after timeout_s.

        A job that an earlier process of the same name left running or released is handed out first, as a new attempt;
        after MAX_ATTEMPTS deaths it fails instead. One with cancel_requested is handed out to be cleared away.
        """
        ...

    def progress(self, claim: Claim, progress: JobProgress) -> bool:
        """Record progress; True while the claim stands and nobody asked to cancel."""
        ...

    def finish(self, claim: Claim) -> bool:
        """running -> done; False if the claim no longer stands or a cancel was asked for."""
        ...

    def fail(self, claim: Claim, error: JobError) -> bool:
        """running -> failed; False if the claim no longer stands or a cancel was asked for."""
        ...

    def confirm_cancel(self, claim: Claim) -> bool:
        """running -> cancelled, by the worker that has stopped; False if nobody asked for it."""
        ...

    def release(self, claim: Claim) -> bool:
        """running -> queued, by a worker that is to end; the attempt is not held against the job.

        False if the claim no longer stands or a cancel was asked for.
        """
        ...

    def cancel(self, job_id: str) -> JobRecord | None:
        """queued -> cancelled at once; running: ask its worker. The record afterwards; None if there is none."""
        ...

    def get(self, job_id: str) -> JobRecord | None:
        """The job's record."""
        ...

    def records(self, limit: int = LISTING_LIMIT) -> list[JobRecord]:
        """The newest jobs, newest first."""
        ...

    def forget(self, job_id: str) -> bool:
        """Remove the record of a job in a terminal state; False if it is missing or still live."""
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
