"""GET /scenes/{id}/export: a stored scene as a file for other programs, sent while the worker makes it; /exports lists
the formats.
"""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import AsyncIterator
from typing import Annotated, get_args

from fastapi import APIRouter, Query, Response
from pydantic import ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import StreamingResponse

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from contract.store.shelf import is_job_id
from contract.wire.exports import ExportOffer
from contract.wire.job import JobRecord
from contract.wire.rendering import CutRequest, ExportRequest
from intrasplat.errors import UnavailableError
from intrasplat.formats import EXPORT_FORMATS, ExportOptions, VideoView, check_export, requirement
from intrasplat.scene.stored_exports import stored_parts
from service.access import Caller
from service.bodies import BINARY
from service.connection import Answer
from service.deps import AnyCaller, Deps, Services
from service.filenames import attachment
from service.moments import AskedTime, feed_time, scene_time
from service.problems import Problem
from service.renders import image_response, problem_of_reply
from service.scenes import file_stem, find_finished, finished_job
from service.shown import Shown

router = APIRouter(prefix="/scenes", tags=["scenes"])

MAX_EXPORT_S = 3600.0
"""An export that takes longer is cut off."""
FIRST_BYTES_S = 10.0
"""How long the response head waits for the first bytes, so that an error still has an HTTP status."""
BUSY_PAUSE_S = 1.0

logger = logging.getLogger("intrasplat.service")


class ExportQuery(ExportOptions):
    """An export as a caller asks for it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    t: AskedTime = None  # type: ignore[assignment]
    format: str = Field(
        default="ply",
        max_length=32,
        description="; ".join(f"{name}: {each.about}" for name, each in EXPORT_FORMATS.items()),
        json_schema_extra={"enum": list(EXPORT_FORMATS)},
    )


@router.get(
    "/{scene_id}/export",
    operation_id="export_scene",
    response_class=Response,
    responses={
        200: {
            "description": "the file",
            "content": dict.fromkeys(sorted({each.media_type for each in EXPORT_FORMATS.values()}), BINARY),
        }
    },
)
async def export_scene(
    scene_id: str, services: Services, caller: AnyCaller, query: Annotated[ExportQuery, Query()]
) -> Response:
    """The scene as a file in one of many formats (docs/export.md). Long ones are sent while they are made.

    Of a live feed it is the part of its past that shows the moment t.

    An export that fails after its first bytes is cut off, so that its transfer is not complete.
    """
    if query.format in EXPORT_FORMATS and EXPORT_FORMATS[query.format].is_stored:
        options = check_export(query.format, query.model_dump(exclude={"format"}))
        return await _stored(scene_id, query.format, options, services, caller)
    shown = await find_finished(services, caller, scene_id)
    request = _request_of(shown, query)
    await run_in_threadpool(services.audit.record, AuditAction.EXPORTED, caller, scene_id)
    first, part, until_s = await services.renderer.ask(request), 0, time.monotonic() + FIRST_BYTES_S
    while first.head.error is None and first.head.more and not first.body and time.monotonic() < until_s:
        part += 1
        first = await next_part(services, request.model_copy(update={"part": part}), first.worker)
    response = image_response(scene_id, first)
    if first.head.more:
        head = {name: value for name, value in response.headers.items() if name != "content-length"}
        response = StreamingResponse(_parts(services, request, first, part), headers=head)
    seen = f"-{query.view}" if query.view not in (None, "endoscope") else ""
    response.headers["Content-Disposition"] = attachment(shown.stem + seen + EXPORT_FORMATS[query.format].suffix)
    return response


@router.get("/{scene_id}/exports", operation_id="list_exports")
async def list_exports(scene_id: str, services: Services, caller: AnyCaller) -> list[ExportOffer]:
    """The formats that the scene can be saved in, and what this installation lacks for some of them."""
    shown = await find_finished(services, caller, scene_id)
    missing = await services.renderer.missing_extras()
    views = await run_in_threadpool(_views, services, shown)
    return [
        ExportOffer(
            format=name,
            about=each.about,
            file_name=shown.stem + each.suffix,
            media_type=each.media_type,
            options=list(each.options),
            views=views if "view" in each.options else [],
            needs=requirement(each.extra) if each.extra is not None and each.extra in missing else None,
        )
        for name, each in EXPORT_FORMATS.items()
        if not (shown.is_feed and each.is_stored)
    ]


def _views(services: Deps, shown: Shown) -> list[VideoView]:
    """The views of a video: stereo without baseline_mm only where the distance of the eyes is known."""
    views = list(get_args(VideoView))
    if shown.attempt is None or services.store.newest_report(shown.scene_id, shown.attempt).right_eye is None:
        views.remove("stereo")
    return views


def _request_of(shown: Shown, query: ExportQuery) -> ExportRequest:
    """The request to the worker.

    Raises:
        InputError: there is no such format, or an option does not fit it.
    """
    given = query.model_dump(exclude={"format", "t"})
    asked = None if query.t is None or shown.is_feed else scene_time(query.t)
    return ExportRequest(
        scene_id=shown.scene_id,
        attempt=shown.attempt or 0,
        moment=feed_time(query.t) if shown.is_feed else None,
        format=query.format,
        options=check_export(query.format, given | {"t": asked}),
        export_id=uuid.uuid4().hex,
    )


async def _stored(scene_id: str, name: str, options: ExportOptions, services: Deps, caller: Caller) -> Response:
    """The stored file of a format that needs no worker."""
    caller.require(KeyScope.DOWNLOAD)
    record = await run_in_threadpool(_stored_job, services, caller, scene_id, name)
    folder = await run_in_threadpool(services.store.scene_folder, scene_id, record.attempt)
    dashboard, label = services.settings.dashboard_dir, record.labels.label
    parts = await run_in_threadpool(stored_parts, name, folder, scene_id, dashboard, label, options.recorded)
    await run_in_threadpool(services.audit.record, AuditAction.DOWNLOADED, caller, scene_id)
    file_name = file_stem(record) + EXPORT_FORMATS[name].suffix
    headers = {"Content-Disposition": attachment(file_name), "Cache-Control": "no-store"}
    return StreamingResponse(parts, media_type=EXPORT_FORMATS[name].media_type, headers=headers)


def _stored_job(services: Deps, caller: Caller, scene_id: str, name: str) -> JobRecord:
    """As finished_job(); a live feed is named as what it is."""
    try:
        return finished_job(services, caller, scene_id)
    except Problem:
        feed = services.feeds.record(scene_id) if is_job_id(scene_id) else None
        if feed is None or not caller.owns(feed):
            raise
    remedy = f"GET /scenes/{scene_id}/exports lists the formats; POST /feeds/{scene_id}/cut makes a scene of a part."
    raise Problem(404, f"A live feed has no export as {name}.", field="scene", remedy=remedy)


async def _parts(services: Deps, request: ExportRequest, answer: Answer, part: int) -> AsyncIterator[bytes]:
    """The rest of an export, starting with `answer`, which is its part number `part`.

    Raises:
        UnavailableError: it cannot continue. The transfer is then cut off, because its head has been sent.
    """
    until_s = time.monotonic() + MAX_EXPORT_S
    yield answer.body
    while answer.head.more:
        if time.monotonic() > until_s:
            raise UnavailableError(f"The export took more than {MAX_EXPORT_S:g} s.", "Ask for fewer frames.")
        part += 1
        answer = await next_part(services, request.model_copy(update={"part": part}), answer.worker)
        if answer.head.error is not None:
            logger.warning("an export was cut off: %s", answer.head.error.kind)
            raise problem_of_reply(answer.head.error)
        yield answer.body


async def next_part(services: Deps, request: ExportRequest | CutRequest, worker: str | None) -> Answer:
    """The answer of the worker, waiting while it is busy.

    Raises:
        UnavailableError: the worker is gone or does not answer.
    """
    until_s = time.monotonic() + MAX_EXPORT_S
    while True:
        answer = await services.renderer.ask(request, worker)
        error = answer.head.error
        if error is None or error.kind != "busy" or time.monotonic() > until_s:
            return answer
        await asyncio.sleep(error.retry_after_s or BUSY_PAUSE_S)
