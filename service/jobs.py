"""Routes of /jobs: list, show, label, cancel, retry and follow jobs; deliveries of their webhooks."""

from __future__ import annotations

import functools
import hashlib
from typing import Annotated

from fastapi import APIRouter, Header, Response
from fastapi.sse import EventSourceResponse
from starlette.concurrency import run_in_threadpool

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from contract.queue.interface import event_order
from contract.wire.job import TERMINAL_STATES, JobRecord, JobState, JobView
from contract.wire.labels import LabelChange
from contract.wire.webhooks import MAX_TRIES_BEFORE_AGAIN, Delivery
from service.callbacks import check_callback
from service.deps import AnyCaller, Deps, Services, owned_job
from service.events import NOTHING_SEEN
from service.listing import PAGED, JobQuery, find_page, tell_next
from service.problems import RETRY_AFTER_S, Problem
from service.renders import matches

router = APIRouter(prefix="/jobs", tags=["jobs"])

STREAM_HEADERS = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
"""The second header stops nginx from buffering events."""

UNCHANGED: dict[int | str, dict[str, object]] = {304: {"description": "they are those that the caller has"}}
STREAM_RESPONSES: dict[int | str, dict[str, object]] = {
    200: {"description": "server-sent events", "content": {EventSourceResponse.media_type: {}}},
    204: {"description": "the job has ended, and the caller knows all of it"},
}


@router.get("", operation_id="list_jobs", response_model=list[JobView], responses=PAGED | UNCHANGED)
def list_jobs(
    services: Services,
    caller: AnyCaller,
    response: Response,
    search: JobQuery,
    if_none_match: Annotated[str | None, Header()] = None,
) -> list[JobView] | Response:
    """The jobs, newest first, a page at a time. `position` and `eta_s` are null here: ask GET /jobs/{job_id}."""
    caller.require(KeyScope.VIEW)
    find = functools.partial(services.queue.records, caller.tenant)
    page = find_page(search, caller.tenant, find, search.state)
    tell_next(response, page, caller.tenant)
    jobs = [JobView.of(record) for record in page.records]
    content = "\n".join(each.model_dump_json() for each in jobs)
    response.headers["ETag"] = f'"{hashlib.sha256(content.encode()).hexdigest()}"'
    if matches(if_none_match, response.headers["ETag"]):
        return Response(status_code=304, headers=response.headers)
    return jobs


@router.get("/{job_id}", operation_id="get_job")
def get_job(job_id: str, response: Response, services: Services, caller: AnyCaller) -> JobView:
    """State, position, stage, progress, held-out dB so far, seconds left, and the error if it failed."""
    caller.require(KeyScope.VIEW)
    return _view(services, owned_job(services, caller, job_id), response)


@router.get("/{job_id}/deliveries", operation_id="list_deliveries")
def list_deliveries(job_id: str, services: Services, caller: AnyCaller) -> list[Delivery]:
    """The webhooks about this job's ends, and every try to deliver them; none of a job without a callback_url."""
    caller.require(KeyScope.VIEW)
    return services.queue.deliveries(owned_job(services, caller, job_id).job_id)


@router.post("/{job_id}/deliveries", status_code=202, operation_id="send_again")
def send_again(job_id: str, services: Services, caller: AnyCaller) -> list[Delivery]:
    """Send the webhook about the job's last end now, whether it is owed, was given up or was delivered.

    It keeps its id, and its schedule begins anew. A try that is under way counts as this one. The answer is that of
    GET /jobs/{job_id}/deliveries.
    """
    caller.require(KeyScope.RECONSTRUCT)
    record = owned_job(services, caller, job_id)
    if record.callback_url is None:
        remedy = "Name callback_url when you send a clip; POST /reconstruct with clip_of sends this one again."
        raise Problem(409, "The job has no callback_url.", field="job_id", remedy=remedy)
    if record.state not in TERMINAL_STATES:
        detail = f"The job is {record.state}, and its webhook is sent when it has ended."
        raise Problem(409, detail, field="job_id", remedy=f"See GET /jobs/{job_id}/events.")
    check_callback(record.callback_url, services.settings)
    last = Delivery.of(record).event_id
    tries = sum(len(each.tries) for each in services.queue.deliveries(job_id) if each.event_id == last)
    if tries >= MAX_TRIES_BEFORE_AGAIN:
        detail = f"The webhook was tried {tries} times; one of {MAX_TRIES_BEFORE_AGAIN} or more is not sent again."
        raise Problem(409, detail, field="job_id", remedy=f"Ask for what it tells: GET /jobs/{job_id}.")
    services.audit.record(AuditAction.SENT_AGAIN, caller, job_id)
    services.queue.send_again(record)
    return services.queue.deliveries(job_id)


@router.patch("/{job_id}", operation_id="label_job")
def label_job(job_id: str, change: LabelChange, response: Response, services: Services, caller: AnyCaller) -> JobView:
    """Change label and metadata, in whatever state the job is. A field that is left out stays, null removes it.

    `metadata` takes the place of all that was there. Neither is for names of persons.
    """
    caller.require(KeyScope.RECONSTRUCT)
    before = owned_job(services, caller, job_id)
    services.audit.record(AuditAction.LABELLED, caller, job_id)
    services.store.keep_labels(job_id, before.labels.changed(change))
    record = services.queue.relabel(job_id, change) or owned_job(services, caller, job_id)
    services.purger.log_is_stale()
    return _view(services, record, response)


@router.delete("/{job_id}", operation_id="cancel_job")
def cancel_job(job_id: str, response: Response, services: Services, caller: AnyCaller) -> JobView:
    """Cancel: a queued job at once, a running one as soon as its worker hears of it. The clip is removed with it."""
    caller.require(KeyScope.RECONSTRUCT)
    owned_job(services, caller, job_id)
    services.audit.record(AuditAction.CANCELLED, caller, job_id)
    record = services.queue.cancel(job_id) or owned_job(services, caller, job_id)
    if record.state in (JobState.DONE, JobState.FAILED):
        remedy = f"DELETE /scenes/{job_id} removes what is left of it."
        raise Problem(409, f"The job is already {record.state}.", field="job_id", remedy=remedy)
    if record.state is JobState.CANCELLED:
        services.store.purge(job_id)
    return _view(services, record, response)


@router.post("/{job_id}/retry", status_code=202, operation_id="retry_job")
def retry_job(job_id: str, response: Response, services: Services, caller: AnyCaller) -> JobView:
    """Try a failed job again, as if its workers had not died."""
    caller.require(KeyScope.RECONSTRUCT)
    before = owned_job(services, caller, job_id)
    if before.state is not JobState.FAILED:
        detail = f"The job is {before.state}; only a failed one is tried again."
        raise Problem(409, detail, field="job_id", remedy=f"See GET /jobs/{job_id}.")
    if services.store.submission(job_id) is None:
        raise Problem(409, "The job's clip is gone.", field="job_id", remedy="Send it again: POST /reconstruct.")
    services.audit.record(AuditAction.RETRIED, caller, job_id)
    record = services.queue.retry(job_id) or owned_job(services, caller, job_id)
    response.headers["Location"] = f"/jobs/{job_id}"
    return _view(services, record, response)


@router.get(
    "/{job_id}/events",
    operation_id="watch_job",
    response_class=Response,
    responses=STREAM_RESPONSES,
)
async def watch_job(
    job_id: str, services: Services, caller: AnyCaller, last_event_id: Annotated[str, Header()] = "0"
) -> Response:
    """Every change of the job as a server-sent event `job` whose data is the job, until it has ended.

    A caller that was cut off sends Last-Event-ID and receives what it missed.
    """
    caller.require(KeyScope.VIEW)
    record = await run_in_threadpool(owned_job, services, caller, job_id)
    after = event_order(last_event_id)
    if after > NOTHING_SEEN and record.state in TERMINAL_STATES:
        missed = await run_in_threadpool(services.queue.events, job_id, last_event_id)
        if not missed:
            return Response(status_code=204)  # a browser does not reconnect after 204
    return EventSourceResponse(services.job_channels.stream(job_id, after), headers=STREAM_HEADERS)


def _view(services: Deps, record: JobRecord, response: Response) -> JobView:
    """The job's present state; sets Retry-After while it has not ended."""
    if record.state in TERMINAL_STATES:
        return JobView.of(record)
    response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return JobView.of(record, services.queue.forecast(record.job_id))
