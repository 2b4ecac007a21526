"""Webhooks: the message that a caller gets when its job has ended, and the log of its delivery.

The body and its headers follow Standard Webhooks (standardwebhooks.com). It names the job and nothing of its content:
whoever receives it asks for the rest with a key.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from contract.wire.job import JobRecord, JobState
from intrasplat.codes import known_code
from intrasplat.names import JOB_ID_PATTERN

CALLBACK_PART = "callback_url"
MAX_CALLBACK_CHARACTERS = 1000
MAX_TRIES_BEFORE_AGAIN = 100
"""A webhook that was tried this often is not sent again: every try stands in its log."""
CALLBACK_ABOUT = "where a webhook goes when the job has ended: a URL at a host that the service's operator has allowed"


class DeliveryStatus(StrEnum):
    """Where the delivery of a webhook stands."""

    OWED = "owed"
    DELIVERED = "delivered"
    FAILED = "failed"
    """Given up: after the last try, or because the receiver wants no more (410)."""


class TryFailure(StrEnum):
    """Why one try to deliver a webhook failed; docs/codes.md explains each."""

    ADDRESS_REFUSED = "address_refused"
    CERTIFICATE = "certificate"
    FAULT = "fault"
    HOST_REFUSED = "host_refused"
    STATUS = "status"
    TIMEOUT = "timeout"
    UNREACHABLE = "unreachable"
    UNCLASSIFIED = "unclassified"


class DeliveryTry(BaseModel):
    """One try to deliver a webhook."""

    model_config = ConfigDict(frozen=True)

    at_s: float = Field(description="when it began, UNIX s")
    status_code: int | None = Field(default=None, description="the receiver's answer; None if there was none")
    failure: Annotated[TryFailure | None, known_code(TryFailure)] = Field(
        default=None, description="why it failed; None: the webhook was delivered"
    )
    retry_after_s: float | None = Field(
        default=None,
        description="for how long a receiver that answered 429 or 503 asked to be left alone (Retry-After)",
    )


class Delivery(BaseModel):
    """A webhook about one end of a job, and all tries to deliver it so far."""

    model_config = ConfigDict(frozen=True)

    event_id: str = Field(description="the header webhook-id, the same at every try")
    state: JobState = Field(description="the state in which the job ended")
    error_code: str | None = Field(default=None, description="the code of a failed job's error")
    ended_at_s: float = Field(description="when the job ended, UNIX s")
    status: DeliveryStatus = DeliveryStatus.OWED
    tries: tuple[DeliveryTry, ...] = ()
    forgiven_tries: int = Field(
        default=0, description="how many of them no longer count, because a caller had the webhook sent again since"
    )
    next_try_at_s: float | None = Field(
        default=None, description="time of the next try, UNIX s; None: a try is in progress, or there is none to come"
    )

    @property
    def job_id(self) -> str:
        """The job."""
        return self.event_id.partition(".")[0]

    @classmethod
    def of(cls, record: JobRecord) -> Delivery:
        """What is owed about the end of a job that has ended."""
        return cls(
            event_id=event_id(record.job_id, record.attempt, record.state),
            state=record.state,
            error_code=record.error.code.value if record.error else None,
            ended_at_s=record.finished_at_s or time.time(),
        )

    def again(self) -> Delivery:
        """The same, owed anew: the tries so far are forgiven."""
        return self.model_copy(update={"status": DeliveryStatus.OWED, "forgiven_tries": len(self.tries)})


class EndedJob(BaseModel):
    """The job that a webhook is about."""

    model_config = ConfigDict(frozen=True)

    job_id: str = Field(pattern=JOB_ID_PATTERN)
    state: JobState = Field(description="done, failed or cancelled")
    error_code: str | None = Field(default=None, description="the code of a failed job's error (docs/codes.md)")


class JobEnded(BaseModel):
    """The body of a webhook: a job has ended."""

    model_config = ConfigDict(frozen=True)

    id: str = Field(description="the event's id, as in the header webhook-id")
    type: str = Field(description="job.done, job.failed or job.cancelled")
    timestamp: str = Field(description="when the job ended, ISO 8601, UTC")
    data: EndedJob

    @classmethod
    def of(cls, delivery: Delivery) -> JobEnded:
        """What a delivery tells."""
        ended = datetime.fromtimestamp(delivery.ended_at_s, UTC).isoformat(timespec="milliseconds")
        job = EndedJob(job_id=delivery.job_id, state=delivery.state, error_code=delivery.error_code)
        return cls(id=delivery.event_id, type=f"job.{delivery.state}", timestamp=ended, data=job)


def event_id(job_id: str, attempt: int, state: JobState) -> str:
    """The id of a job's end: a job that failed and was retried ends once more, with another attempt or state."""
    return f"{job_id}.{attempt}.{state}"
