"""POST /reconstruct: turns a clip into a job. It comes in one form, as finished uploads, or from an earlier job."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from io import RawIOBase
from typing import Annotated, TypeAlias, TypeVar

from fastapi import APIRouter, Header, Request, Response
from opentelemetry.trace import get_current_span
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from contract.queue.interface import Admission, QueueFullError
from contract.runtime import traces
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.wire.job import Forecast, JobRecord, JobView
from contract.wire.labels import parse_labels
from intrasplat.errors import InputError, LimitError, UnavailableError
from intrasplat.intake.fit import check_fit
from intrasplat.intake.limits import MAX_MEMORY_BYTES
from intrasplat.intake.sniff import check_file
from intrasplat.options import JobOptions, parse_options
from service.access import Caller
from service.bodies import REQUEST_BODY
from service.callbacks import check_callback
from service.deps import AnyCaller, Deps, Services
from service.intake import declared_length
from service.partial import Partial, find_partial
from service.problems import RETRY_AFTER_S, Problem, disk_full
from service.retention import check_retention
from service.reuse import add_files_of, earlier_job, first_job
from service.upload import CLIP_FORM, LIMIT_REMEDY, PARTS, Form, Received, UploadLimits, receive_upload

router = APIRouter(tags=["jobs"])

SAME_UNDER_A_KEY = ("input_sha256", "options", "callback_url")
"""Fields that must be equal in a second submission under an idempotency key; another callback would never be called."""
STEPS_PER_S = 10.0
"""Converts `iterations` to seconds of training: the speed of a plain machine with `paper`."""
MAX_SUBMISSION_BYTES = 128 * 1024
"""Maximum bytes of a JSON body."""
UNION_MEMBERS = frozenset({"float", "str"})
"""What pydantic adds to the place of an error in a field of several types."""
JSON_REMEDY = 'Send ids of finished uploads by part, and options: {"clip": ID, "options": {"budget_s": 20}}.'

Body = TypeVar("Body", bound=BaseModel)

IdempotencyKey = Annotated[
    str | None,
    Header(min_length=1, max_length=200, description="the same key with the same clip and options is the same job"),
]


Record = TypeVar("Record")
Accept: TypeAlias = Callable[[Deps, Caller, str, Received, str | None], Record]
"""Creates a job or feed: (services, caller, id, received parts, hash of the idempotency key) -> record."""


class Submission(BaseModel):
    """The JSON body: ids of finished uploads by their part, the job whose clip is used again, and the options."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    clip: str | None = None
    left: str | None = None
    right: str | None = None
    calibration: str | None = None
    masks: str | None = None
    poses_file: str | None = None
    fov_mask: str | None = None
    clip_of: str | None = None
    label: str | None = None
    metadata: dict[str, object] | None = None
    callback_url: str | None = None
    options: dict[str, object] = Field(default={})

    def uploads(self) -> dict[str, str]:
        """Upload ids by part."""
        return {part: getattr(self, part) for part in PARTS if getattr(self, part) is not None}


@router.post("/reconstruct", status_code=202, operation_id="reconstruct", openapi_extra=REQUEST_BODY)
async def reconstruct(
    request: Request, response: Response, services: Services, caller: AnyCaller, idempotency_key: IdempotencyKey = None
) -> JobView:
    """Send a clip. 202 means that it is safely on disk and queued; Location is the job."""
    caller.require(KeyScope.RECONSTRUCT)
    key = hash_of(idempotency_key)
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() == "application/json":
        submission = await read_json(request, services, Submission, MAX_SUBMISSION_BYTES, JSON_REMEDY)
        record = await run_in_threadpool(_accept_uploads, services, caller, submission, key)
    else:
        record = await receive_form(request, services, caller, key, accept_clip)
    response.headers["Location"] = f"/jobs/{record.job_id}"
    response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return JobView.of(record, await run_in_threadpool(forecast_of, services, record))


def hash_of(idempotency_key: str | None) -> str | None:
    """The hash of an idempotency key that a record stores."""
    return None if idempotency_key is None else hashlib.sha256(idempotency_key.encode()).hexdigest()


def forecast_of(services: Deps, record: JobRecord) -> Forecast | None:
    """The forecast of a job; None while it is unknown."""
    try:
        return services.queue.forecast(record.job_id)
    except UnavailableError:
        return None


async def receive_form(
    request: Request, services: Deps, caller: Caller, key: str | None, accept: Accept[Record], form: Form = CLIP_FORM
) -> Record:
    """Receive a multipart request and return what `accept` creates from it."""
    store, settings = services.store, services.settings
    with services.intake.slot(caller.tenant, declared_length(request), form.main_part) as slot:
        job_id = new_job_id()
        folder = store.open_incoming(job_id)
        try:
            available_bytes = services.intake.available_bytes() + slot.reserved_bytes
            limits = UploadLimits(settings.max_upload_bytes, available_bytes, settings.min_free_bytes)
            content_type = request.headers.get("content-type", "")
            with traces.span("receive"):
                body = services.intake.body(request, slot)
                received = await receive_upload(content_type, body, folder, limits, form)
            return await run_in_threadpool(accept, services, caller, job_id, received, key)
        except ClientDisconnect:
            detail = "The connection was closed before the upload was complete."
            raise Problem(400, detail, field="body", remedy="Send it again.") from None
        finally:
            await run_in_threadpool(store.discard_incoming, job_id)


async def read_json(request: Request, services: Deps, model: type[Body], max_bytes: int, remedy: str) -> Body:
    """The JSON body of a request.

    Raises:
        Problem: 400: the body is not JSON. 413: it is larger than max_bytes.
        InputError: a field is unknown or of the wrong type.
    """
    body = b""
    async for piece in services.intake.body(request):
        body += piece
        if len(body) > max_bytes:
            raise Problem(413, f"The JSON body is larger than {max_bytes} bytes.", field="body", remedy=remedy)
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "json_invalid":
            raise Problem(400, "The body is not JSON.", field="body", remedy=remedy) from None
        place = [*first["loc"][:1], *(part for part in first["loc"][1:] if part not in UNION_MEMBERS)]
        field = ".".join(map(str, place)) or "body"
        raise InputError(field, f"{first['msg']}.", remedy) from None


def _accept_uploads(services: Deps, caller: Caller, submission: Submission, key: str | None) -> JobRecord:
    """Create a job from finished uploads. Repeating the request returns the same job."""
    options = parse_options(JobOptions, submission.options)
    given = submission.uploads()
    partials = {part: _finished(services, caller, part, upload_id) for part, upload_id in given.items()}
    job_ids = {part: partial.declaration.job_id for part, partial in partials.items()}
    if any(job_ids.values()):
        return _taken_before(services, job_ids, submission, options)
    labels = parse_labels(submission.label, submission.metadata)
    received = Received(options=options.model_dump_json(), clip_of=submission.clip_of, labels=labels)
    received.callback_url = submission.callback_url
    received.names = {part: partial.path.name for part, partial in partials.items()}
    received.check_clip()  # before anything is read
    with contextlib.ExitStack() as locks:
        for partial in partials.values():
            locks.enter_context(_locked(partial))
        return _make_job_of(services, caller, partials, received, key)


def _make_job_of(
    services: Deps, caller: Caller, partials: Mapping[str, Partial], received: Received, key: str | None
) -> JobRecord:
    """Link the uploads' files into a new job, and remove them from the uploads once the job is accepted.

    Raises:
        Problem: 507: the disk is full; the uploads stay.
    """
    if not services.intake.has_free_space():
        raise disk_full("The disk has too little free space; the uploads stay on it.", services.intake.space_remedy())
    job_id = new_job_id()
    folder = services.store.open_incoming(job_id)
    try:
        for part, partial in partials.items():
            os.link(partial.path, folder / partial.path.name)
            received.digests[part] = partial.sha256()
            received.total_bytes += partial.declaration.length_bytes
        if received.total_bytes > services.settings.max_upload_bytes:
            problem = f"all files together have {received.total_bytes} bytes, more than an upload may have."
            raise LimitError("clip", problem, LIMIT_REMEDY)
        record = accept_clip(services, caller, job_id, received, key)
    except Problem as problem:
        if "job_id" in problem.extensions:  # the clip is in the spool despite the error
            _assign(partials, job_id)
        raise
    finally:
        services.store.discard_incoming(job_id)
    _assign(partials, record.job_id)
    return record


def _locked(partial: Partial) -> RawIOBase:
    """The upload's file, locked: no other request writes to it or creates a job from it meanwhile."""
    try:
        return partial.open()
    except (BlockingIOError, FileNotFoundError):
        detail = "Another request is using this upload."
        raise Problem(423, detail, field="upload", remedy="Send this again.") from None


def _finished(services: Deps, caller: Caller, part: str, upload_id: str) -> Partial:
    """The caller's complete upload for that part."""
    partial = find_partial(services.store, upload_id, caller.tenant)
    if partial is None:
        raise InputError(part, f"there is no upload {upload_id[:40]!r}.", "Create one: POST /uploads.")
    if partial.declaration.part != part:
        problem = f"the upload was created as {partial.declaration.part!r}."
        raise InputError(part, problem, "Use it as what it was created for.")
    if not partial.is_complete:
        detail = f"{partial.offset_bytes} of its {partial.declaration.length_bytes} bytes have come."
        raise Problem(409, detail, field=part, remedy=f"Send the rest: PATCH /uploads/{upload_id}.")
    return partial


def _taken_before(
    services: Deps, job_ids: Mapping[str, str | None], submission: Submission, options: JobOptions
) -> JobRecord:
    """The job that took the uploads, if one job took all of them and has the same clip and options.

    job_ids: the job that took each part; None: no job did.
    """
    part, job_id = next((part, job_id) for part, job_id in job_ids.items() if job_id is not None)
    known = services.queue.get(job_id)
    record = known or services.store.labelled_submission(job_id)
    clip_of = submission.clip_of and first_job(services.store, submission.clip_of)
    asked = (options, clip_of, submission.callback_url)
    asked_before = record and (record.options, record.clip_of, record.callback_url)
    if len(set(job_ids.values())) > 1 or record is None or asked_before != asked:
        detail = f"The upload was used for the job {job_id} already."
        raise Problem(409, detail, field=part, remedy="Upload the file again.", extensions={"job_id": job_id})
    # An accepted clip is never refused by a full queue that has lost its record.
    return known or services.queue.submit(record)


def _assign(partials: Mapping[str, Partial], job_id: str) -> None:
    for partial in partials.values():
        partial.assign_to(job_id)


def accept_clip(services: Deps, caller: Caller, job_id: str, received: Received, key: str | None) -> JobRecord:
    """Spool first, then enqueue: a job exists only for a clip that is on disk."""
    options = parse_options(JobOptions, received.options)
    check_retention(options, services.settings)
    check_scopes(options, caller, services.settings)
    check_callback(received.callback_url, services.settings)
    received.check_clip()
    sent = set(received.names)
    clip_of = None
    if received.clip_of is not None:
        earlier = earlier_job(services, caller, received.clip_of)
        clip_of = first_job(services.store, earlier.job_id)
        add_files_of(services, earlier, services.store.incoming_folder(job_id), received)
    record = JobRecord(
        job_id=job_id,
        tenant=caller.tenant,
        files=received.files(),
        options=options,
        labels=received.labels,
        callback_url=received.callback_url,
        input_bytes=received.total_bytes,
        input_sha256=received.sha256(),
        clip_of=clip_of,
        idempotency_key=key,
        created_at_s=time.time(),
    )
    with traces.span("check"):
        _look_at(services, record, received.names, sent)
    outcome = "ok" if clip_of is None else f"ok (clip of {clip_of})"
    services.audit.record(AuditAction.ACCEPTED, caller, job_id, outcome)
    return spool_and_queue(services, record)


def check_scopes(options: JobOptions, caller: Caller, settings: Settings) -> None:
    """Return if the caller may request this priority and training time. Raises Problem 403 otherwise."""
    if options.priority == "high":
        caller.require(KeyScope.PRIORITY)
    training_s = options.budget_s or (options.iterations or 0) / STEPS_PER_S
    if training_s > settings.long_training_s:
        caller.require(KeyScope.LONG)


def _look_at(services: Deps, record: JobRecord, names: Mapping[str, str], sent: Collection[str]) -> None:
    """Refuse files that cannot be a clip, and options that do not fit them.

    Memory is not checked here, because the worker may run on another machine. names: names of all files, by part.
    sent: the parts that do not come from an earlier job.
    """
    limits = replace(services.settings.clip_limits, decoded_bytes=MAX_MEMORY_BYTES)
    folder = services.store.incoming_folder(record.job_id)
    files = {part: folder / name for part, name in names.items()}
    for part, path in files.items():
        check_file(path, part, limits)
    check_fit(record.options, files, sent)


def spool_and_queue(services: Deps, record: JobRecord) -> JobRecord:
    """Put the received files into the spool, then enqueue the job. Returns and raises as enqueue()."""
    traces.describe(get_current_span(), job_id=record.job_id, input_bytes=record.input_bytes)
    record = record.model_copy(update={"trace": traces.traceparent()})
    with services.sweep.in_hand(record.job_id):
        with traces.span("spool"):
            services.store.accept(record)
        with traces.span("enqueue"):
            return enqueue(services, record)


def enqueue(services: Deps, record: JobRecord) -> JobRecord:
    """Enqueue the job of a clip in the spool. Returns the record that the queue has for it.

    Raises:
        QueueFullError: the queue is full; the clip is removed.
        Problem: 503: the queue is unreachable. The clip stays, and is queued as soon as the queue is back.
        InputError: the idempotency key was used for another clip, other options or another callback; the clip is
            removed.
    """
    settings = services.settings
    try:
        standing = services.queue.submit(record, Admission(settings.max_queued, settings.max_queued_per_tenant))
    except QueueFullError:
        services.store.purge(record.job_id)
        raise
    except UnavailableError as error:
        services.sweep.leave(record.job_id)
        detail = f"{error.problem} The clip is safe and is queued as soon as the queue is back."
        remedy = f"Send nothing again; ask for GET /jobs/{record.job_id} later."
        raise Problem(503, detail, field="queue", remedy=remedy, extensions={"job_id": record.job_id}) from error
    if standing.job_id == record.job_id:
        return standing
    services.store.purge(record.job_id)
    if any(getattr(standing, name) != getattr(record, name) for name in SAME_UNDER_A_KEY):
        problem = f"it was used for the job {standing.job_id} with another clip, other options or another callback_url."
        raise InputError("Idempotency-Key", problem, "Use a new key for every new job.")
    return standing
