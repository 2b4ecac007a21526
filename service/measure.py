"""GET /scenes/{id}/measure: places in mm under points of a view, and what they make together over time."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response
from pydantic import ConfigDict, Field

from contract.wire.rendering import MeasureRequest
from intrasplat.measuring import MAX_POINTS, Measurement, ShapeKind, check_shape, parse_points
from service.deps import AnyCaller, Services
from service.renders import ViewQuery, image_response
from service.scenes import find_finished

router = APIRouter(prefix="/scenes", tags=["scenes"])


class MeasureQuery(ViewQuery):
    """The points that a caller asks about, and the view that shows them: as /render has it."""

    model_config = ConfigDict(extra="forbid")

    points: str = Field(
        max_length=1000,
        description=f"1 to {MAX_POINTS} points x,y;x,y in pixels from the picture's upper left; for two points "
        "the answer has their distance, too",
        examples=["320,256", "300,200;360.5,240"],
    )
    shape: ShapeKind | None = Field(
        default=None,
        description="what the points make together, at every frame: line, the sum of straight pieces from point to "
        "point (2 or more); area, of a polygon of flat triangles whose sides do not cross (3 or more); angle, at the "
        "second of 3 points",
    )


@router.get("/{scene_id}/measure", operation_id="measure", response_model=Measurement)
async def measure(
    scene_id: str, services: Services, caller: AnyCaller, query: Annotated[MeasureQuery, Query()]
) -> Response:
    """Depth, place and uncertainty in mm of what the points of a view show; of two points the distance, which the
    tissue carries along, at every frame; with `shape`, a length, an area or an angle of all of them. Where the
    confidence is low or no frame saw the tissue, nothing is measured, and `refusal` says why. Research use only.
    """
    points = parse_points(query.points)
    check_shape(query.shape, len(points))
    shown = await find_finished(services, caller, scene_id)
    await services.audit.viewed(caller, scene_id)
    request = MeasureRequest(
        scene_id=scene_id,
        attempt=shown.attempt or 0,
        **shown.time_fields(query.t),
        pose=query.asked_pose,
        camera=query.camera,
        points=points,
        shape=query.shape,
        max_pixels=services.settings.max_render_pixels,
    )
    response = image_response(scene_id, await services.renderer.ask(request))
    response.headers["Cache-Control"] = "no-store"
    return response
