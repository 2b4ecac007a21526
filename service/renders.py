"""GET /render: one view of one scene, from a worker that has the scene or that trains it."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Coroutine
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from contract.runtime.settings import Settings
from contract.wire.job import JobState
from contract.wire.rendering import RenderRequest, ReplyError
from intrasplat.errors import ErrorCode
from intrasplat.names import Detail, Eye, Light, Smoke
from intrasplat.notices import NoticeCode
from intrasplat.picture import (
    MEDIA_TYPES,
    Highlights,
    ImageFormat,
    IntrinsicsOverride,
    Layer,
    Unseen,
    check_depth_ends,
)
from intrasplat.pose import Pose, parse_pose
from intrasplat.version import version
from service.access import Caller
from service.bodies import BINARY
from service.connection import Answer
from service.deps import AnyCaller, Deps, Services
from service.moments import AskedTime, moment_text
from service.problems import Problem, lacking
from service.request_log import GONE
from service.shown import Shown, find_shown

router = APIRouter(tags=["renders"])

FEED_HEADERS: dict[str, object] = {
    "X-Intrasplat-Captured-At": {
        "description": "of a live feed: when the pair of the moment that is shown arrived (RFC 3339)",
        "schema": {"type": "string", "format": "date-time"},
    },
    "X-Intrasplat-Age-S": {
        "description": "of a live feed: seconds from then until the answer",
        "schema": {"type": "number"},
    },
    "X-Intrasplat-Source-S": {
        "description": "of a live feed: the moment in seconds of the source",
        "schema": {"type": "number"},
    },
}
IMAGE_RESPONSES: dict[int | str, dict[str, object]] = {
    200: {
        "description": "the image",
        "content": dict.fromkeys(MEDIA_TYPES.values(), BINARY),
        "headers": {
            "X-Intrasplat-Unseen": {
                "description": "share of the view that no training frame saw, hatched unless unseen=guess",
                "required": True,
                "schema": {"type": "number", "minimum": 0, "maximum": 1},
            },
            "X-Intrasplat-Detail": {
                "description": "share of the view's tissue whose detail comes from recorded frames",
                "required": True,
                "schema": {"type": "number", "minimum": 0, "maximum": 1},
            },
            "X-Intrasplat-Camera": {
                "description": "the picture's camera: a JSON object of width, height, fx, fy, cx, cy in pixels, and "
                "world_from_camera, 12 numbers in mm, row-major",
                "schema": {"type": "string"},
            },
            "X-Intrasplat-Depth-Unit": {
                "description": "of layer=depth, what a value of 1 is; 0 is invalid. False colours have none, nor have "
                "other layers: `format` says their levels",
                "schema": {"type": "string", "enum": ["0.01 mm", "mm"]},
            },
            "X-Intrasplat-Depth-Range-Mm": {
                "description": "of layer=depth in false colours: depths of the brightest and of the darkest colour",
                "schema": {"type": "string", "pattern": "^-?[0-9]+ -?[0-9]+$"},
            },
            **FEED_HEADERS,
        },
    },
    304: {"description": "it is the one that the caller has"},
}
DEPTH_UNITS = {ImageFormat.PNG: "0.01 mm", ImageFormat.NPY: "mm"}
"""The unit of layer=depth, by format."""
STATUS_OF_REPLY = {"input": 422, "scene": 404, "not-yet": 503, "busy": 503, "internal": 500}
NOT_YET_RETRY_S = "1"

Result = TypeVar("Result")

Pixels = Annotated[int | None, Field(ge=8, le=8192, description="size of the image in pixels; default: the clip's")]
FocalLength = Annotated[
    float | None,
    Field(gt=0, le=1e5, allow_inf_nan=False, description="focal length, in pixels; default: the clip's"),
]
Centre = Annotated[
    float | None,
    Field(
        ge=-1e5,
        le=1e5,
        allow_inf_nan=False,
        description="where the optical axis is, in pixels from the left (cx) or upper (cy) edge; default: the clip's",
    ),
]
DepthEnd = Annotated[int | None, Field(ge=1, le=10_000)]
"""In whole mm, as the header says the range."""
PoseText = Annotated[
    str | None,
    Field(
        max_length=1000,
        description="12 or 16 numbers, row-major world_from_camera in mm, or orbit:yaw,pitch,zoom in degrees, or "
        "orbit:yaw,pitch,zoom,x,y,z with the point looked at in mm; default: the endoscope's own pose at t",
        examples=["orbit:10,0,1", "orbit:10,0,1.5,-4,2,60"],
    ),
]


class ViewQuery(BaseModel):
    """When, where from and through which lens a caller looks."""

    model_config = ConfigDict(frozen=True)

    t: AskedTime = None
    pose: PoseText = None
    width: Pixels = None
    height: Pixels = None
    fx: FocalLength = None
    fy: FocalLength = None
    cx: Centre = None
    cy: Centre = None

    @property
    def asked_pose(self) -> Pose | None:
        """None: the endoscope's own. Raises InputError: the text is no pose."""
        return None if self.pose is None else parse_pose(self.pose)

    @property
    def camera(self) -> IntrinsicsOverride:
        """What of the clip's camera is to be another."""
        return IntrinsicsOverride(**self.model_dump(include=set(IntrinsicsOverride.model_fields)))


class RenderQuery(ViewQuery):
    """A view as a caller asks for it: the query of /render, and with an id the messages of /stream."""

    scene: str | None = Field(default=None, description="may be left out only while there is exactly one scene")
    eye: Eye = Field(
        default="left",
        description="right: seen from the right eye of a stereo clip and through its lens, as recorded?eye=right is; "
        "not with pose",
    )
    layer: Layer = Field(
        default=Layer.RGB,
        description="depth is along the camera's z; confidence is in [0, 1]; error: by how many levels of 255 the "
        "model differs from the recorded frame nearest to t, in the mean of R G B, only from the endoscope's own pose",
    )
    format: ImageFormat = Field(
        default=ImageFormat.PNG,
        description="png and npy are exact (depth: 16-bit png in 0.01 mm, npy in mm, 0 invalid); jpeg and webp are for "
        "eyes, layers but rgb in false colour. confidence and smoke: png is 8 bit, 255 is 1. error: png is 8 bit, a "
        "value of 1 is one level of 255; where nothing is compared npy is NaN, png 0",
    )
    quality: int = Field(default=90, ge=1, le=100, description="quality of a jpeg or webp image")
    unseen: Unseen = Field(
        default=Unseen.MARK,
        description="what to show where no training frame saw anything. mark: a hatch, transparent in png and webp; "
        "depth and confidence 0. guess: what the model draws there",
    )
    highlights: Highlights = Field(
        default=Highlights.ON,
        description="off: colours without the highlights that the eyes of a stereo clip saw differently. A scene that "
        "one eye taught knows none: it is shown as it is, with the notice highlights_unknown. Changes layer rgb alone",
    )
    light: Light = Field(
        default="steady",
        description="the light of layer rgb where exposure or white balance change in the clip, or the border is dark. "
        "steady: that of one frame at all times, everywhere; recorded: that in which the moment was recorded",
    )
    smoke: Smoke = Field(
        default="remove",
        description="show: layer rgb is drawn behind the smoke that was found before the tissue; remove: without it",
    )
    detail: Detail = Field(
        default="on",
        description="on: layer rgb gets what the model misses of the recorded frames nearest in time; off: the model "
        "alone. Changes nothing where recorded frames are not kept",
    )
    near_mm: DepthEnd = Field(default=None, description="of layer=depth in false colours: the depth of the brightest")
    far_mm: DepthEnd = Field(
        default=None,
        description="of layer=depth in false colours: the depth of the darkest, beyond near_mm. Without them the range "
        "is the clip's. Elsewhere both change nothing",
    )


@router.get("/render", operation_id="render", response_class=Response, responses=IMAGE_RESPONSES)
async def render(
    services: Services,
    caller: AnyCaller,
    query: Annotated[RenderQuery, Query()],
    http_request: Request,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """An image at time t from a pose, without the instruments; while the job runs, from its newest snapshot.

    `scene` may be a live feed's id.
    """
    start = time.perf_counter()
    shown = await find_shown(services, caller, query.scene, with_feeds=True)
    request = request_of(query, shown, services.settings)
    tag = tag_of(request)
    if shown.attempt is not None and matches(if_none_match, tag):
        return Response(status_code=304, headers=cache_headers(shown, tag))
    answered = await unless_gone(http_request, answer_to(services, caller, request, shown))
    if answered is None:
        return Response(status_code=GONE)
    shown, answer = answered
    if shown.attempt != request.attempt:  # the job has ended meanwhile
        tag = tag_of(request.model_copy(update={"attempt": shown.attempt}))
    response = image_response(shown.scene_id, answer)
    is_coarse = NoticeCode.COARSE in [each.code for each in answer.head.warnings]
    response.headers.update(cache_headers(shown, tag, is_coarse=is_coarse))
    response.headers["X-Intrasplat-Unseen"] = f"{answer.head.unseen:.3f}"
    response.headers["X-Intrasplat-Detail"] = f"{answer.head.detail:.3f}"
    if answer.head.depth_range_mm is not None:
        response.headers["X-Intrasplat-Depth-Range-Mm"] = " ".join(f"{each:.0f}" for each in answer.head.depth_range_mm)
    if answer.head.camera is not None:
        response.headers["X-Intrasplat-Camera"] = answer.head.camera.model_dump_json()
    if query.layer is Layer.DEPTH and query.format in DEPTH_UNITS:
        response.headers["X-Intrasplat-Depth-Unit"] = DEPTH_UNITS[query.format]
    total_ms = (time.perf_counter() - start) * 1e3
    response.headers["Server-Timing"] = f"render;dur={answer.head.render_ms:.1f}, total;dur={total_ms:.1f}"
    return response


async def unless_gone(http_request: Request, work: Coroutine[Any, Any, Result]) -> Result | None:
    """The result of the work. If the caller disconnects first, cancel the work and return None."""
    done, disconnected = asyncio.create_task(work), asyncio.create_task(_disconnected(http_request))
    try:
        await asyncio.wait({done, disconnected}, return_when=asyncio.FIRST_COMPLETED)
        return done.result() if done.done() else None
    finally:
        for task in (done, disconnected):
            task.cancel()


async def _disconnected(http_request: Request) -> None:
    """Return when the caller has disconnected."""
    while (await http_request.receive())["type"] != "http.disconnect":
        pass


async def answer_to(services: Deps, caller: Caller, request: RenderRequest, shown: Shown) -> tuple[Shown, Answer]:
    """The worker's answer, and what it shows; the finished scene if the job has just ended.

    Raises:
        Problem: 429: the caller or its tenant has too many pending renders.
        UnavailableError: no worker answers in time.
    """
    with services.render_limits.admitted(caller, request):
        answer = await services.renderer.ask(request)
        if not shown.is_feed and answer.head.error is not None and answer.head.error.kind == "not-yet":
            shown = await find_shown(services, caller, shown.scene_id)
            if shown.attempt is not None:
                answer = await services.renderer.ask(request.model_copy(update={"attempt": shown.attempt}))
    services.render_limits.learn(shown.scene_id, answer.head)
    if answer.head.error is None and answer.body:
        services.metrics.rendered("feed" if shown.is_feed else shown.state.value, answer.head.render_ms)
    return shown, answer


def request_of(query: RenderQuery, shown: Shown, settings: Settings) -> RenderRequest:
    """The request to the worker.

    Raises:
        InputError: time, pose, or the ends of the depths are not valid.
    """
    check_depth_ends(query.near_mm, query.far_mm)
    return RenderRequest(
        scene_id=shown.scene_id,
        attempt=shown.attempt,
        **shown.time_fields(query.t),
        pose=query.asked_pose,
        eye=query.eye,
        camera=query.camera,
        layer=query.layer,
        format=query.format,
        quality=query.quality,
        unseen=query.unseen,
        highlights=query.highlights,
        light=query.light,
        smoke=query.smoke,
        detail=query.detail,
        near_mm=query.near_mm,
        far_mm=query.far_mm,
        max_pixels=settings.max_render_pixels,
    )


def image_response(scene_id: str, answer: Answer) -> Response:
    """The response: the image and the headers that describe it. A worker's error becomes a problem."""
    head = answer.head
    if head.error is not None:
        raise problem_of_reply(head.error)
    state = JobState.DONE if head.iteration is None else JobState.RUNNING
    headers = {"X-Intrasplat-Scene": scene_id, "X-Intrasplat-State": state.value, "X-Intrasplat-T": f"{head.t:.6g}"}
    if (feed := head.feed) is not None:
        headers |= {
            "X-Intrasplat-State": feed.state.value,
            "X-Intrasplat-Captured-At": moment_text(feed.captured_at_s),
            "X-Intrasplat-Age-S": f"{feed.age_s:.3f}",
            "X-Intrasplat-Source-S": f"{feed.source_s:.3f}",
        }
    if head.iteration is not None:
        headers["X-Intrasplat-Iteration"] = str(head.iteration)
    if head.warnings:
        text = "; ".join(each.text for each in head.warnings)
        headers["X-Intrasplat-Warning"] = " ".join(text.encode("ascii", "replace").decode().split())
        headers["X-Intrasplat-Warning-Codes"] = ", ".join(each.code for each in head.warnings)
    return Response(answer.body, media_type=head.media_type, headers=headers)


def problem_of_reply(error: ReplyError) -> Problem:
    """The HTTP problem for a worker's error."""
    if error.code is ErrorCode.MISSING_EXTRA:
        return lacking(error.problem, error.remedy)
    headers = {"Retry-After": NOT_YET_RETRY_S} if error.kind == "not-yet" else None
    return Problem(
        STATUS_OF_REPLY[error.kind],
        error.problem,
        field=error.field,
        remedy=error.remedy,
        headers=headers,
        retry_after_s=error.retry_after_s,
    )


def tag_of(request: RenderRequest) -> str:
    """The ETag of a view of a finished scene: the same request to the same attempt always has the same answer."""
    asked = f"{version()} {request.model_dump_json()}"
    return f'W/"{hashlib.sha256(asked.encode()).hexdigest()[:32]}"'


def matches(if_none_match: str | None, tag: str) -> bool:
    """Whether the caller already has the answer with this tag (RFC 9110, 13.1.2)."""
    given = [each.strip() for each in (if_none_match or "").split(",")]
    return "*" in given or tag.removeprefix("W/") in [each.removeprefix("W/") for each in given]


def cache_headers(shown: Shown, tag: str, *, is_coarse: bool = False) -> dict[str, str]:
    """Cache headers. A view of a finished scene may be cached but must be revalidated, so that its removal is noticed.
    A snapshot must not be cached, nor a coarse picture, which will be sharper later.
    """
    if shown.attempt is None or is_coarse:
        return {"Cache-Control": "no-store"}
    return {"Cache-Control": "private, no-cache", "ETag": tag}
