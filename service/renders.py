"""GET /render: one view of one scene, straight from the worker that holds it."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response
from starlette.concurrency import run_in_threadpool

from contract.errors import SceneError
from contract.job import JobState
from contract.pose import parse_pose
from contract.rendering import MEDIA_TYPES, ImageFormat, IntrinsicsOverride, Layer, RenderRequest, ReplyError
from contract.store import is_job_id
from service.deps import Deps, Services
from service.problems import Problem
from service.renderer import Answer

router = APIRouter(tags=["renders"])

IMAGE_RESPONSES: dict[int | str, dict[str, object]] = {
    200: {"description": "the image", "content": {media_type: {} for media_type in MEDIA_TYPES.values()}}
}
STATUS_OF_REPLY = {"input": 422, "scene": 404, "internal": 500}

Pixels = Annotated[int | None, Query(ge=8, le=8192)]
FocalLength = Annotated[float | None, Query(gt=0, le=1e5, allow_inf_nan=False)]
Centre = Annotated[float | None, Query(ge=-1e5, le=1e5, allow_inf_nan=False)]
ModelTime = Annotated[
    float, Query(ge=0, le=1e6, allow_inf_nan=False, description="0 is the first frame, 1 the end of the clip")
]
PoseText = Annotated[
    str | None,
    Query(
        max_length=1000,
        description="12 or 16 numbers, row-major world_from_camera in mm, or orbit:yaw,pitch,zoom; default: the "
        "endoscope's own pose at t",
        examples=["orbit:10,0,1"],
    ),
]
SceneText = Annotated[str | None, Query(description="may be left out only while there is exactly one scene")]


@router.get("/render", operation_id="render", response_class=Response, responses=IMAGE_RESPONSES)
async def render(
    services: Services,
    t: ModelTime = 0.0,
    pose: PoseText = None,
    scene: SceneText = None,
    width: Pixels = None,
    height: Pixels = None,
    fx: FocalLength = None,
    fy: FocalLength = None,
    cx: Centre = None,
    cy: Centre = None,
    layer: Layer = Layer.RGB,
    format: ImageFormat = ImageFormat.PNG,
) -> Response:
    """An image of the scene at time t from a pose, without the instruments."""
    scene_id = await run_in_threadpool(servable_scene, services, scene)
    request = RenderRequest(
        scene_id=scene_id,
        t=t,
        pose=None if pose is None else parse_pose(pose),
        camera=IntrinsicsOverride(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy),
        layer=layer,
        format=format,
        max_pixels=services.settings.max_render_pixels,
    )
    return image_response(scene_id, await services.renderer.ask(request))


def image_response(scene_id: str, answer: Answer) -> Response:
    """The body with the headers that say what it shows; a worker's error becomes a problem."""
    if answer.head.error is not None:
        raise problem_of_reply(answer.head.error)
    headers = {
        "X-Intrasplat-Scene": scene_id,
        "X-Intrasplat-State": JobState.DONE.value,
        "X-Intrasplat-T": f"{answer.head.t:.6g}",
    }
    if answer.head.warnings:
        text = "; ".join(answer.head.warnings)
        headers["X-Intrasplat-Warning"] = " ".join(text.encode("ascii", "replace").decode().split())
    return Response(answer.body, media_type=answer.head.media_type, headers=headers)


def problem_of_reply(error: ReplyError) -> Problem:
    """What a worker's error is over HTTP."""
    return Problem(STATUS_OF_REPLY[error.kind], error.problem, field=error.field, remedy=error.remedy)


def servable_scene(services: Deps, scene: str | None) -> str:
    """The id of a finished scene: the one named, or the only one there is.

    Raises:
        Problem: 400, none is named and there is not exactly one: never show another patient by accident;
            409, the job has not come to a scene.
        SceneError: there is no such scene.
    """
    if scene is None:
        scene_ids = services.store.scene_ids()
        if len(scene_ids) != 1:
            detail = f"There are {len(scene_ids)} scenes and none was named."
            raise Problem(400, detail, field="scene", remedy="Add scene=ID; GET /scenes lists them.")
        return scene_ids[0]
    try:
        services.store.scene_folder(scene)
    except SceneError:
        record = services.queue.get(scene) if is_job_id(scene) else None
        if record is None:
            raise
        raise Problem(
            409, f"The job is {record.state}; there is no scene.", field="scene", remedy=f"See GET /jobs/{scene}."
        ) from None
    return scene
