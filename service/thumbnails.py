"""GET /scenes/{id}/thumbnail: a small picture of a finished scene, rendered once and stored beside its files."""

from __future__ import annotations

import hashlib
import logging
from typing import Annotated

from fastapi import APIRouter, Header, Response
from starlette.concurrency import run_in_threadpool

from contract.access.keys import KeyScope
from contract.wire.job import JobRecord
from contract.wire.rendering import RenderRequest
from intrasplat.errors import UnavailableError
from intrasplat.notices import NoticeCode
from intrasplat.picture import MEDIA_TYPES, ImageFormat, IntrinsicsOverride
from service.access import Caller
from service.deps import AnyCaller, Deps, Services
from service.renders import answer_to, matches, problem_of_reply
from service.scenes import finished_job
from service.shown import Shown

router = APIRouter(prefix="/scenes", tags=["scenes"])

WIDTH = 240
"""Width of a thumbnail in pixels: twice that of the page's cards, for dense screens."""
QUALITY = 80
MEDIA_TYPE = MEDIA_TYPES[ImageFormat.JPEG]
RESPONSES: dict[int | str, dict[str, object]] = {
    200: {"description": "the picture", "content": {MEDIA_TYPE: {}}},
    304: {"description": "it is the one that the caller has"},
}
logger = logging.getLogger("intrasplat.service")


@router.get("/{scene_id}/thumbnail", operation_id="get_thumbnail", response_class=Response, responses=RESPONSES)
async def get_thumbnail(
    scene_id: str, services: Services, caller: AnyCaller, if_none_match: Annotated[str | None, Header()] = None
) -> Response:
    """The scene's first moment from the endoscope's own pose, 240 pixels wide. It is removed with the scene."""
    caller.require(KeyScope.VIEW)
    record = await run_in_threadpool(finished_job, services, caller, scene_id)
    await services.audit.viewed(caller, scene_id)
    content = await run_in_threadpool(services.store.thumbnail, scene_id, record.attempt)
    if content is None:
        content = await _rendered(services, caller, record)
    headers = {
        "ETag": f'"{hashlib.sha256(content).hexdigest()}"',
        "Cache-Control": "private, no-cache",
        "Vary": "Authorization, X-API-Key",
    }
    if matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(content, media_type=MEDIA_TYPE, headers=headers)


async def _rendered(services: Deps, caller: Caller, record: JobRecord) -> bytes:
    """The picture from a worker. It is stored unless it is coarse, as while the worker trains.

    Raises:
        Problem: the worker cannot render the scene now, or the caller requests too much.
        UnavailableError: no worker answers in time.
    """
    request = RenderRequest(
        scene_id=record.job_id,
        attempt=record.attempt,
        t=0.0,
        camera=IntrinsicsOverride(width=WIDTH),
        format=ImageFormat.JPEG,
        quality=QUALITY,
    )
    _, answer = await answer_to(services, caller, request, Shown(record.job_id, record.attempt))
    if answer.head.error is not None:
        raise problem_of_reply(answer.head.error)
    if NoticeCode.COARSE not in [each.code for each in answer.head.warnings]:
        try:
            await run_in_threadpool(services.store.keep_thumbnail, record.job_id, record.attempt, answer.body)
        except UnavailableError as error:
            logger.warning("a thumbnail was not kept: %s", error.problem, extra={"job_id": record.job_id})
    return answer.body
