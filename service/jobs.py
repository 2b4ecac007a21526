"""POST /reconstruct and the jobs it makes."""

from __future__ import annotations

import contextlib
import shutil
import time
from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from contract.errors import UnavailableError
from contract.job import TERMINAL_STATES, JobOptions, JobRecord, JobState, JobView, parse_options
from contract.store import is_job_id, new_job_id
from service.deps import Deps, Services
from service.problems import RETRY_AFTER_S, Problem, no_room
from service.upload import Received, UploadLimits, receive_upload

router = APIRouter(tags=["jobs"])

UPLOAD_SCHEMA: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "description": "clip, or left and right; the file name's ending tells the format",
                    "properties": {
                        "clip": {"type": "string", "format": "binary"},
                        "left": {"type": "string", "format": "binary"},
                        "right": {"type": "string", "format": "binary"},
                        "calibration": {"type": "string", "format": "binary"},
                        "masks": {"type": "string", "format": "binary"},
                        "options": JobOptions.model_json_schema(),
                    },
                },
                "encoding": {"options": {"contentType": "application/json"}},
            }
        },
    }
}


@router.post("/reconstruct", status_code=202, operation_id="reconstruct", openapi_extra=UPLOAD_SCHEMA)
async def reconstruct(request: Request, response: Response, services: Services) -> JobView:
    """Send a clip. 202 means that it is safely on disk and queued; Location is the job."""
    store, settings = services.store, services.settings
    free_bytes = store.free_bytes()
    if free_bytes < settings.min_free_bytes:
        raise no_room(f"{free_bytes} bytes are left on the data directory's disk.")
    job_id = new_job_id()
    folder = store.open_incoming(job_id)
    room_bytes = free_bytes - settings.min_free_bytes
    try:
        content_type = request.headers.get("content-type", "")
        limits = UploadLimits(settings.max_upload_bytes, room_bytes)
        received = await receive_upload(content_type, request.stream(), folder, limits)
        record = await run_in_threadpool(_accept, services, job_id, received)
    except ClientDisconnect:
        raise Problem(400, "The connection was closed before the upload was complete.") from None
    finally:
        store.discard_incoming(job_id)
    response.headers["Location"] = f"/jobs/{job_id}"
    response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return JobView.of(record)


@router.get("/jobs", operation_id="list_jobs")
def list_jobs(services: Services) -> list[JobView]:
    """The newest jobs, newest first."""
    return [JobView.of(record) for record in services.queue.records()]


@router.get("/jobs/{job_id}", operation_id="get_job")
def get_job(job_id: str, response: Response, services: Services) -> JobView:
    """State, stage, progress, held-out dB so far, seconds left, and the error if it failed."""
    record = known_job(services, job_id)
    if record.state not in TERMINAL_STATES:
        response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return JobView.of(record)


@router.delete("/jobs/{job_id}", operation_id="cancel_job")
def cancel_job(job_id: str, services: Services) -> JobView:
    """Cancel: a queued job at once, a running one as soon as its worker hears of it. The clip is removed with it."""
    known_job(services, job_id)
    record = services.queue.cancel(job_id)
    if record is None:
        raise _no_such_job(job_id)
    if record.state in (JobState.DONE, JobState.FAILED):
        remedy = f"DELETE /scenes/{job_id} removes what is left of it."
        raise Problem(409, f"The job is already {record.state}.", field="job_id", remedy=remedy)
    if record.state is JobState.CANCELLED:
        services.store.remove_clip(job_id)
    return JobView.of(record)


def known_job(services: Deps, job_id: str) -> JobRecord:
    """The record of a job; 404 if there is none."""
    record = services.queue.get(job_id) if is_job_id(job_id) else None
    if record is None:
        raise _no_such_job(job_id)
    return record


def _no_such_job(job_id: str) -> Problem:
    return Problem(404, f"There is no job {job_id[:40]!r}.", field="job_id", remedy="GET /jobs lists what there is.")


def _accept(services: Deps, job_id: str, received: Received) -> JobRecord:
    """Spool first, then queue: a job exists only for a clip that is on disk."""
    record = JobRecord(
        job_id=job_id,
        files=received.files(),
        options=parse_options(received.options),
        input_bytes=received.total_bytes,
        input_sha256=received.sha256(),
        created_at_s=time.time(),
    )
    spooled = services.store.accept(record)
    try:
        services.queue.submit(record)
    except UnavailableError:
        with contextlib.suppress(OSError):
            shutil.rmtree(spooled)  # nothing was promised: the caller hears 503
        raise
    return record
