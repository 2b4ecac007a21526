"""Finished scenes: their report, curve, exports and removal."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse

from contract.errors import SceneError
from contract.job import TERMINAL_STATES
from contract.rendering import ExportRequest
from contract.store import CURVE, REPORT, is_job_id
from service.deps import Services
from service.problems import Problem
from service.renders import ModelTime, image_response, servable_scene

router = APIRouter(tags=["scenes"])


class SceneSummary(BaseModel):
    """A scene in the list; `error` says why its report, and so its quality, cannot be read."""

    id: str
    psnr_tissue_db: float | None = None
    error: str | None = None
    links: dict[str, str]


@router.get("/scenes", operation_id="list_scenes")
def list_scenes(services: Services) -> list[SceneSummary]:
    """All finished scenes, newest first."""
    return [_summary(services, scene_id) for scene_id in services.store.scene_ids()]


@router.get("/scenes/{scene_id}", operation_id="get_scene")
def get_scene(scene_id: str, services: Services) -> dict[str, Any]:
    """The scene's quality report: held-out quality, what was assumed, warnings."""
    return _report(services, servable_scene(services, scene_id))


@router.get("/scenes/{scene_id}/curve", operation_id="get_curve", response_class=FileResponse)
def get_curve(scene_id: str, services: Services) -> FileResponse:
    """Held-out psnr_tissue over seconds of training, as CSV."""
    folder = services.store.scene_folder(servable_scene(services, scene_id))
    if not (folder / CURVE).is_file():
        raise Problem(404, "This scene has no curve.", field="scene_id")
    return FileResponse(folder / CURVE, media_type="text/csv")


@router.get("/scenes/{scene_id}/export", operation_id="export_scene", response_class=Response)
async def export_scene(
    scene_id: str,
    services: Services,
    t: ModelTime = 0.0,
    format: Annotated[Literal["ply"], Query(description="the property order common splat viewers read")] = "ply",
) -> Response:
    """The scene's Gaussians at time t, in mm."""
    scene_id = await run_in_threadpool(servable_scene, services, scene_id)
    answer = await services.renderer.ask(ExportRequest(scene_id=scene_id, t=t, format=format))
    response = image_response(scene_id, answer)
    response.headers["Content-Disposition"] = f'attachment; filename="{scene_id}.{format}"'
    return response


@router.delete("/scenes/{scene_id}", status_code=204, operation_id="delete_scene")
def delete_scene(scene_id: str, services: Services) -> None:
    """Remove clip, scene and record of a job that has ended."""
    record = services.queue.get(scene_id) if is_job_id(scene_id) else None
    if record is None:
        services.store.scene_folder(scene_id)  # raises SceneError unless a scene is there without its record
    elif record.state not in TERMINAL_STATES:
        remedy = f"Cancel it first: DELETE /jobs/{scene_id}."
        raise Problem(409, f"The job is still {record.state}.", field="scene_id", remedy=remedy)
    services.store.remove(scene_id)  # before its record, by which a removal that was cut short can be asked for again
    services.queue.forget(scene_id)


def _summary(services: Services, scene_id: str) -> SceneSummary:
    """A scene's line in the list; a damaged one hides no other."""
    links = {"report": f"/scenes/{scene_id}", "render": f"/render?scene={scene_id}"}
    try:
        quality_db = _report(services, scene_id).get("psnr_tissue_db")
        return SceneSummary(id=scene_id, psnr_tissue_db=quality_db, links=links)
    except SceneError as error:
        return SceneSummary(id=scene_id, error=str(error), links=links)
    except ValidationError:
        return SceneSummary(id=scene_id, error="The report of this scene holds no quality.", links=links)


def _report(services: Services, scene_id: str) -> dict[str, Any]:
    path = services.store.scene_folder(scene_id) / REPORT
    try:
        report = json.loads(path.read_text(), parse_constant=_refuse)
    except (OSError, ValueError) as error:
        raise SceneError(f"The report of scene {scene_id} cannot be read ({type(error).__name__}).") from error
    if not isinstance(report, dict):
        raise SceneError(f"The report of scene {scene_id} is not a JSON object.")
    return report


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number of JSON's")
