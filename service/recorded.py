"""GET /scenes/{id}/recorded: recorded frames and masks, to compare with renders and to check masks."""

from __future__ import annotations

import hashlib
from typing import Annotated

from fastapi import APIRouter, Header, Query, Response
from starlette.concurrency import run_in_threadpool

from contract.wire.rendering import RecordedRequest, WorkerReply
from intrasplat.names import Eye
from intrasplat.picture import MEDIA_TYPES, ImageFormat, RecordedMasks
from intrasplat.scene.recorded_file import MASK, PICTURE, read_frame
from service.bodies import BINARY
from service.connection import Answer
from service.deps import AnyCaller, Deps, Services
from service.moments import AskedTime
from service.renders import FEED_HEADERS, image_response, matches
from service.shown import find_shown

router = APIRouter(prefix="/scenes", tags=["scenes"])

OfEye = Annotated[Eye, Query(description="a scene keeps the right eye's frames if both eyes taught it")]
Masks = Annotated[
    RecordedMasks,
    Query(
        description="marked: JPEG, instruments marked; off: JPEG as recorded; only: PNG, 255 on instruments, else clear"
    ),
]


@router.get(
    "/{scene_id}/recorded",
    operation_id="get_recorded",
    response_class=Response,
    responses={
        200: {
            "description": "the frame",
            "content": {"image/jpeg": BINARY, "image/png": BINARY},
            "headers": FEED_HEADERS,
        },
        304: {"description": "it is the one that the caller has"},
    },
)
async def get_recorded(
    scene_id: str,
    services: Services,
    caller: AnyCaller,
    t: Annotated[AskedTime, Query()] = None,
    eye: OfEye = "left",
    masks: Masks = RecordedMasks.MARKED,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """The recorded frame nearest to t as the model's camera sees it; also while the job trains, and of a live feed.

    X-Intrasplat-T is the frame's time, and the ETag the picture's SHA-256. `recorded` of GET /scenes/{id} lists the
    frames that a finished scene keeps.
    """
    shown = await find_shown(services, caller, scene_id, with_feeds=True)
    request = RecordedRequest(scene_id=scene_id, attempt=shown.attempt, **shown.time_fields(t), eye=eye, masks=masks)
    if request.attempt is None or request.masks is RecordedMasks.MARKED:
        answer = await services.renderer.ask(request)
    else:
        answer = await run_in_threadpool(_as_stored, services, request, request.attempt)
    response = image_response(scene_id, answer)
    response.headers["Cache-Control"] = "no-store"
    tag = response.headers["ETag"] = f'"{hashlib.sha256(answer.body).hexdigest()}"'
    if matches(if_none_match, tag):
        del response.headers["content-length"], response.headers["content-type"]
        return Response(status_code=304, headers=response.headers)
    return response


def _as_stored(services: Deps, request: RecordedRequest, attempt: int) -> Answer:
    """A stored frame or mask of a finished scene, read from disk: a worker that trains has little time.

    Raises:
        SceneError: the scene has no recorded frames, or a file is damaged.
        InputError: it has none of this eye, or no masks.
    """
    is_mask = request.masks is RecordedMasks.ONLY
    folder = services.store.scene_folder(request.scene_id, attempt)
    count = services.store.newest_report(request.scene_id, attempt).frame_count
    index, body = read_frame(folder, count, request.t, request.eye, MASK if is_mask else PICTURE)
    media_type = MEDIA_TYPES[ImageFormat.PNG if is_mask else ImageFormat.JPEG]
    return Answer(WorkerReply(media_type=media_type, t=index / count), body)
