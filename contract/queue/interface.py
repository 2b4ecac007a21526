"""The interface of the queue (`Queue`, a Protocol), and what every implementation guarantees.

contract/queue/redis_queue.py implements it. The tests have a second implementation, tests/memory_queue.py, which states
the interface in plain Python. Both pass the same tests.

A claim is a lease: it is valid as long as its worker beats. After LEASE_S without a beat any worker may claim the job,
as a new attempt. Every report carries the attempt's number, which is the fencing token: a report changes nothing if a
later attempt has started.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from statistics import median
from typing import Protocol

from contract.queue.deliveries import Deliveries
from contract.queue.feeds import Feeds
from contract.wire.job import Forecast, JobError, JobProgress, JobRecord, JobState
from contract.wire.labels import LabelChange
from contract.wire.rendering import WorkerAddress
from contract.wire.webhooks import DeliveryStatus
from intrasplat.errors import ErrorCode, UnavailableError
from intrasplat.names import BUDGETS_S
from intrasplat.options import ReconstructionOptions

MAX_ATTEMPTS = 3
"""A job fails when its workers have died this often: the job is assumed to be the cause."""

BEAT_PERIOD_S = 2.0
LEASE_S = 8.0
"""How long a claim is valid without a beat. Three beats may be late or lost."""

PREEMPT_AFTER_S = 1.0
"""A worker releases its standard job for a high-priority one that has waited this long."""

YIELD_S = 20.0
"""If a worker that was asked to release its job has not done so after this long, another worker is asked."""

WORKER_TTL_S = 10.0
"""How long an announcement of a worker lasts."""

ANNOUNCE_PERIOD_S = 2.0

IDEMPOTENCY_S = 24 * 3600
"""How long an idempotency key stands for the job that was submitted under it."""

MAX_DURATIONS = 20
"""The forecast uses the durations of this many last jobs."""

MAX_LISTED = 200
"""How many jobs one listing may hold."""

MAX_EVENTS = 200
"""Events stored of each job, for callers that reconnect and ask for what they missed."""

EVENT_NUMBER = re.compile(r"(\d{1,19})(?:-(\d{1,19}))?", re.ASCII)
"""The form of an event number: UNIX milliseconds, and a count within the millisecond."""


class Order(StrEnum):
    """The answer to a beat: what the worker has to do."""

    GO_ON = "go-on"
    CANCEL = "cancel"
    """Stop, remove, confirm_cancel."""
    YIELD = "yield"
    """Stop, save the state and release the job: a high-priority job waits and no worker is free."""
    LOST = "lost"
    """The claim is no longer valid: stop, and touch nothing but this attempt's own folder."""


@dataclass(frozen=True)
class Claim:
    """One attempt of a job and the worker that runs it. Every report carries it; a stale one changes nothing."""

    job_id: str
    attempt: int
    owner: str


@dataclass(frozen=True)
class Admission:
    """How many jobs may wait: those of all callers, and those of one tenant."""

    queued: int
    queued_per_tenant: int


@dataclass(frozen=True)
class Event:
    """A change of a job: a number that only increases, and the record after the change."""

    number: str
    record: JobRecord


@dataclass(frozen=True, order=True)
class ListingPosition:
    """A job's position in listings, which are sorted by it in descending order."""

    created_at_s: float
    job_id: str


@dataclass(frozen=True)
class QueueFigures:
    """Figures for metrics. ended: jobs in each terminal state since the queue was created; webhooks: likewise."""

    queued: int
    running: int
    oldest_queued_s: float
    ended: dict[JobState, int]
    webhooks: dict[DeliveryStatus, int]


class QueueFullError(UnavailableError):
    """Too many jobs wait. tenant: the caller's own share is used up (HTTP 429), not the whole queue (503)."""

    code = ErrorCode.QUEUE_FULL

    def __init__(self, problem: str, remedy: str, *, tenant: bool) -> None:
        super().__init__(problem, remedy)
        self.tenant = tenant


class Queue(Deliveries, Feeds, Protocol):
    """Every method is atomic, and may be repeated when its answer was lost.

    All raise UnavailableError when the queue cannot be reached or its memory is full.
    """

    def submit(self, record: JobRecord, admission: Admission | None = None) -> JobRecord:
        """Enqueue a job. Returns the record that the queue has for it.

        That is another job's record if the tenant has submitted one under the same idempotency key within
        IDEMPOTENCY_S, and the unchanged record of the same job if the queue knows its id.

        Raises:
            QueueFullError: as many jobs wait as `admission` allows; nothing was changed.
        """
        ...

    def restore(self, record: JobRecord) -> bool:
        """Put back the record of an ended job that the queue has lost; False if it knows the job."""
        ...

    def claim(self, owner: str, timeout_s: float) -> JobRecord | None:
        """Claim the next job, which is then running and owned by `owner`; None after timeout_s.

        The order is: high priority before standard; within each, jobs that were released or whose lease has expired
        before new ones, and these by tenant (claim_order). An owner has one job at a time. If it has one already
        (because the answer to its claim was lost), it gets the same attempt again. A job whose workers have died
        MAX_ATTEMPTS times fails instead. A job with cancel_requested is cancelled instead.
        """
        ...

    def beat(self, claim: Claim, progress: JobProgress | None = None) -> Order:
        """Renew the lease and record progress. The answer says what the worker has to do."""
        ...

    def finish(self, claim: Claim) -> bool:
        """running -> done; False if the claim is no longer valid or a cancel was requested."""
        ...

    def fail(self, claim: Claim, error: JobError) -> bool:
        """running -> failed, a dead letter; False if the claim is no longer valid or a cancel was requested."""
        ...

    def confirm_cancel(self, claim: Claim) -> bool:
        """running -> cancelled, by the worker that has stopped; False if no cancel was requested."""
        ...

    def release(self, claim: Claim, *, died: bool = False) -> bool:
        """running -> queued, first in line; False if the claim is no longer valid or a cancel was requested.

        died: the attempt counts as a death. After MAX_ATTEMPTS deaths the job fails, a dead letter.
        """
        ...

    def cancel(self, job_id: str) -> JobRecord | None:
        """queued -> cancelled at once; running: ask its worker. Returns the record, None if there is none."""
        ...

    def retry(self, job_id: str) -> JobRecord | None:
        """failed -> queued, with no deaths counted. Returns the record, None if there is none."""
        ...

    def relabel(self, job_id: str, change: LabelChange) -> JobRecord | None:
        """Change a job's labels, in any state. Returns the record, None if there is none.

        From then on all its events, earlier ones too, show the new labels.
        """
        ...

    def get(self, job_id: str) -> JobRecord | None:
        """The job's record, None if there is none."""
        ...

    def forecast(self, job_id: str) -> Forecast:
        """The job's position in the queue and when it may be done, estimated from the durations of the last jobs."""
        ...

    def records(
        self, tenant: str | None = None, limit: int | None = MAX_LISTED, before: ListingPosition | None = None
    ) -> list[JobRecord]:
        """The newest jobs of one tenant or of all, newest first; with `before`, only those that follow that position.

        Records that cannot be read are skipped. The answer is empty only if there is no further job.
        """
        ...

    def unreadable(self) -> list[str]:
        """The jobs whose records exist and cannot be read, in no order."""
        ...

    def events(self, job_id: str, after: str = "0") -> list[Event]:
        """The job's events after the event number `after`, oldest first. Does not wait for new ones."""
        ...

    def forget(self, job_id: str) -> bool:
        """Remove record, events, deliveries and idempotency key of an ended job; False if it is missing or live."""
        ...

    def rewrite_log(self) -> bool:
        """Remove forgotten jobs from the server's log on disk; False if the server cannot do so now."""
        ...

    def announce(self, address: WorkerAddress) -> None:
        """Add a worker to workers() for WORKER_TTL_S."""
        ...

    def withdraw(self, name: str) -> None:
        """Remove a worker from workers()."""
        ...

    def workers(self) -> list[WorkerAddress]:
        """The live workers, by name."""
        ...

    def figures(self) -> QueueFigures:
        """How many jobs wait, run and have ended."""
        ...

    def ping(self) -> None:
        """Return if the queue answers."""
        ...

    def close(self) -> None:
        """Close all connections."""
        ...


@dataclass(frozen=True)
class Waiting:
    """A queued job. returned: its last worker released it, or died."""

    job_id: str
    tenant: str
    returned: bool


def claim_order(waiting: Sequence[Waiting], running: Mapping[str, int], served: Mapping[str, float]) -> list[str]:
    """The ids of the waiting jobs of one priority, in the order of their claims if no running job ends meanwhile.

    Returned jobs are first. Each following job is the oldest one of the tenant with the fewest running jobs; among
    equals, of the tenant whose last job was claimed longest ago. scripts/claim.lua chooses the same order.

    Args:
        waiting: the queued jobs, oldest first.
        running: how many jobs of each tenant run.
        served: when a job of each tenant that was not returned was last claimed, on any clock that starts above 0.
    """
    returned = [job for job in waiting if job.returned]
    counts = Counter(running) + Counter(job.tenant for job in returned)
    served_at, place = dict(served), max(served.values(), default=0.0)
    lines: dict[str, deque[str]] = {}
    for job in waiting:
        if not job.returned:
            lines.setdefault(job.tenant, deque()).append(job.job_id)
    order = [job.job_id for job in returned]
    places = {job.job_id: i for i, job in enumerate(waiting)}
    while lines:
        tenant = min(lines, key=lambda each: (counts[each], served_at.get(each, 0.0), places[lines[each][0]]))
        order.append(lines[tenant].popleft())
        counts[tenant] += 1
        place += 1
        served_at[tenant] = place
        if not lines[tenant]:
            del lines[tenant]
    return order


def worker_died() -> JobError:
    """The error of a job whose workers have died MAX_ATTEMPTS times."""
    problem = f"The worker died {MAX_ATTEMPTS} times while it ran this job."
    return JobError(
        code=ErrorCode.ATTEMPTS_EXHAUSTED,
        problem=problem,
        remedy="Look at the worker's log. If memory ran out, try a shorter or smaller clip.",
    )


def check_admission(admission: Admission, queued: int, queued_of_tenant: int) -> None:
    """Refuse another job if too many wait.

    Raises:
        QueueFullError: the tenant's share or the whole queue is used up.
    """
    if queued_of_tenant >= admission.queued_per_tenant:
        problem = f"{queued_of_tenant} of your jobs wait; the limit is {admission.queued_per_tenant}."
        raise QueueFullError(problem, "Submit again when one of them has started.", tenant=True)
    if queued >= admission.queued:
        raise QueueFullError(
            f"{queued} jobs wait; the limit is {admission.queued}.", "Submit again later.", tenant=False
        )


@dataclass(frozen=True)
class Pace:
    """The durations of the last done jobs, for forecasts.

    durations_s: total seconds. rests_s: durations less the requested seconds of training; negative if it ended sooner.
    """

    durations_s: Sequence[float]
    rests_s: Sequence[float]


def asked_training_s(options: ReconstructionOptions) -> float | None:
    """The seconds of training that the options request; None if they count steps, or the preset has no budget."""
    return None if options.iterations is not None else options.budget_s or BUDGETS_S.get(options.preset)


def estimate_forecast(
    record: JobRecord, position: int | None, pace: Pace, ran_s: Mapping[str, float], workers: int
) -> Forecast:
    """The position of a queued or running job in the queue, and when it may be done.

    If the job reports the time left, that is the estimate. Otherwise its duration is the requested training time plus
    the median of pace.rests_s, and at least its budget if it has not started. All other jobs, and a job that requests
    no time, are assumed to last the median of the last durations.

    Args:
        position: how many jobs wait before it; None: it runs.
        pace: the durations of the last done jobs.
        ran_s: how long each running job has run so far, by its id.
        workers: how many live workers share the jobs.
    """
    progress = record.progress
    if progress is not None and progress.seconds_left is not None:
        return Forecast(position=position, eta_s=progress.seconds_left)
    if not pace.durations_s or (position is not None and workers == 0):
        return Forecast(position=position, eta_s=None)
    usual_s = own_s = median(pace.durations_s)
    asked_s = asked_training_s(record.options)
    if record.imported is not None:
        own_s = 0.0  # an imported scene is not trained
    elif asked_s is not None and pace.rests_s:
        own_s = max(0.0, asked_s + median(pace.rests_s))
    if position is None:
        eta_s = max(0.0, own_s - ran_s.get(record.job_id, 0.0))
    else:
        left_s = sum(max(0.0, usual_s - each_s) for each_s in ran_s.values())
        eta_s = (left_s + position * usual_s) / workers + own_s
    if progress is None and record.options.budget_s is not None:
        eta_s = max(eta_s, record.options.budget_s)
    return Forecast(position=position, eta_s=eta_s)


def trainers(workers: list[WorkerAddress]) -> int:
    """How many of the workers claim jobs."""
    return sum(not worker.renders_only for worker in workers)


def place_of(record: JobRecord) -> ListingPosition:
    """The job's position in listings."""
    return ListingPosition(record.created_at_s, record.job_id)


def event_order(number: str) -> tuple[int, int]:
    """The sort key of an event number; text that is not an event number sorts first."""
    parts = EVENT_NUMBER.fullmatch(number)
    return (int(parts[1]), int(parts[2] or 0)) if parts else (0, 0)
