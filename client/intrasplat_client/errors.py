"""What can go wrong between a caller and a service.

IntrasplatError
├── InputError                  what the caller gave cannot be used: names the field and the remedy
│   ├── RequestRefused          the service refused the request (4xx, 501, 507)
│   │   ├── Unauthorized        401: a key is needed, or this one is not known
│   │   ├── Forbidden           403: the key lacks a scope, or the service does not answer to this name
│   │   ├── NotFound            404: there is no such job or scene, or it is another tenant's
│   │   └── Conflict            409: not in this state, such as a render of a job that waits
│   └── JobRejected             the job failed because of what was sent
├── ServiceUnavailable          503; raised after the client's patience, as are the next two
│   ├── RateLimited             429: too much from this caller at once
│   └── Unreachable             nobody answers (raised at once), or the connection was lost
├── JobFailed                   the job failed for another reason
├── JobCancelled                somebody cancelled the job
└── ServiceFault                the service answered with a fault of its own (5xx), or another server answered

Errors that come from an answer carry field, remedy, status and request_id; the service logs more under that id.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from intrasplat_client.models import JobView

UNREACHABLE_REMEDY = "Start one with `intrasplat up`, or correct the address."


@dataclass(frozen=True)
class Refusal:
    """An error answer, as the service's problem document and headers describe it."""

    status: int
    problem: str
    field: str | None = None
    remedy: str = ""
    request_id: str | None = None
    retry_after_s: float | None = None
    job_id: str | None = None
    """The job that the clip became despite the error."""


class IntrasplatError(Exception):
    """Base of all errors raised on purpose."""


class InputError(IntrasplatError):
    """What the caller gave cannot be used.

    Attributes:
        field: what is at fault, in the caller's words ("clip", "masks", "options.holdout").
        problem: what is wrong with it.
        remedy: what to do about it, one sentence.
    """

    def __init__(self, field: str, problem: str, remedy: str) -> None:
        super().__init__(f"{field}: {problem} {remedy}")
        self.field = field
        self.problem = problem
        self.remedy = remedy


class RequestRefused(InputError):
    """The service refused the request; `status` is HTTP's."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(refusal.field or "request", refusal.problem, refusal.remedy)
        self.status = refusal.status
        self.request_id = refusal.request_id


class Unauthorized(RequestRefused):
    """A key is needed, or the service does not know the one that was sent."""


class Forbidden(RequestRefused):
    """The key may not do this."""


class NotFound(RequestRefused):
    """There is no such job, scene or upload."""


class Conflict(RequestRefused):
    """The state of the job or scene does not allow this."""


class ServiceUnavailable(IntrasplatError):
    """The service cannot answer now (503). field: what is missing, such as "queue"."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(f"{refusal.problem} {refusal.remedy}")
        self.problem = refusal.problem
        self.remedy = refusal.remedy
        self.status: int | None = refusal.status
        self.field = refusal.field
        self.request_id = refusal.request_id
        self.retry_after_s = refusal.retry_after_s
        self.job_id = refusal.job_id


class RateLimited(ServiceUnavailable):
    """This caller sent too many requests; `retry_after_s` says when to retry."""


class Unreachable(ServiceUnavailable):
    """The connection failed, so status is None. is_nobody_there: it was never established, so nothing was sent."""

    def __init__(self, url: str, error: Exception, is_nobody_there: bool) -> None:
        what = "No service answers at" if is_nobody_there else "The connection was lost to the service at"
        problem = f"{what} {url} ({type(error).__name__})."
        super().__init__(Refusal(HTTPStatus.SERVICE_UNAVAILABLE, problem, remedy=UNREACHABLE_REMEDY))
        self.status = None
        self.is_nobody_there = is_nobody_there


class ServiceFault(IntrasplatError):
    """The service failed, or another server answered."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(" ".join(part for part in (refusal.problem, refusal.remedy) if part))
        self.status = refusal.status
        self.field = refusal.field
        self.remedy = refusal.remedy
        self.request_id = refusal.request_id


class JobRejected(InputError):
    """The job failed because its input cannot be used; `job` is its last view."""

    def __init__(self, job: JobView, field: str, problem: str, remedy: str) -> None:
        super().__init__(field, problem, remedy)
        self.job = job


class JobFailed(IntrasplatError):
    """The job failed for a reason other than its input; `job` is its last view."""

    def __init__(self, job: JobView) -> None:
        error = job.error
        super().__init__(" ".join(part for part in (error.problem, error.remedy) if part) if error else "It failed.")
        self.job = job


class JobCancelled(IntrasplatError):
    """The job was cancelled; `job` is its last view."""

    def __init__(self, job: JobView) -> None:
        super().__init__(f"Job {job.id} was cancelled.")
        self.job = job


REFUSED_ALSO = (HTTPStatus.NOT_IMPLEMENTED, HTTPStatus.INSUFFICIENT_STORAGE)
"""The installation lacks an extra, or space."""
REFUSED: Mapping[int, type[RequestRefused]] = {
    HTTPStatus.UNAUTHORIZED: Unauthorized,
    HTTPStatus.FORBIDDEN: Forbidden,
    HTTPStatus.NOT_FOUND: NotFound,
    HTTPStatus.CONFLICT: Conflict,
}


def error_of_answer(status: int, headers: Mapping[str, str], content: bytes) -> IntrasplatError:
    """The exception for an answer with an error status."""
    request_id = headers.get("x-request-id")
    try:
        document = json.loads(content)
        return error_of_document({**document, "status": status}, request_id, _seconds(headers.get("retry-after")))
    except (ValueError, KeyError, TypeError):
        problem = f"The service answered {status} without saying why."
        return ServiceFault(Refusal(status, problem, request_id=request_id))


def error_of_document(
    document: Mapping[str, Any], request_id: str | None = None, retry_after_s: float | None = None
) -> IntrasplatError:
    """The exception for a problem document (RFC 9457).

    Raises:
        KeyError, TypeError, ValueError: it is not a problem document.
    """
    refusal = Refusal(
        status=int(document["status"]),
        problem=str(document["detail"]),
        field=document.get("field"),
        remedy=str(document.get("remedy") or ""),
        request_id=request_id,
        retry_after_s=_number(document.get("retry_after_s")) or retry_after_s,
        job_id=document.get("job_id"),
    )
    if refusal.status == HTTPStatus.TOO_MANY_REQUESTS:
        return RateLimited(refusal)
    if refusal.status == HTTPStatus.SERVICE_UNAVAILABLE:
        return ServiceUnavailable(refusal)
    if refusal.status >= HTTPStatus.INTERNAL_SERVER_ERROR and refusal.status not in REFUSED_ALSO:
        return ServiceFault(refusal)
    return REFUSED.get(refusal.status, RequestRefused)(refusal)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _seconds(retry_after: str | None) -> float | None:
    """Retry-After in seconds; None for its other form, a date."""
    return float(retry_after) if retry_after and retry_after.isascii() and retry_after.isdigit() else None
