"""Routes of /scenes: list of finished scenes, report, curve, masks, cameras and removal."""

from __future__ import annotations

from fastapi import APIRouter, Response
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from contract.store.shelf import is_job_id
from contract.wire.cameras import CamerasRequest, SceneCameras
from contract.wire.job import JobRecord, JobState
from intrasplat.errors import SceneError
from intrasplat.names import CURVE, MASKS
from intrasplat.notices import NoticeCode, Severity
from intrasplat.report import Report
from service.access import Caller
from service.bodies import BINARY, TEXT
from service.deps import AnyCaller, Deps, Services, no_such_scene, owned_scene
from service.filenames import attachment, stem_of
from service.listing import PAGED, SceneQuery, tell_next
from service.problems import Problem
from service.purge import Receipt
from service.renders import image_response
from service.reuse import others_with_clip
from service.shown import Shown, find_shown, scene_or_feed

router = APIRouter(prefix="/scenes", tags=["scenes"])


class SceneSummary(BaseModel):
    """A scene in the list; `error` says why its report, and so its quality, cannot be read.

    scored: False while its scores are still being measured. warnings: the codes of its report's warnings.
    duration_s: of its clip, from the first frame to the last.
    """

    id: str
    label: str | None = Field(default=None, description="what its caller calls it; PATCH /jobs/{id} changes it")
    metadata: dict[str, str] = Field(default={}, description="what its caller noted on it")
    preset: str
    created_at_s: float = Field(description="when its job was submitted, UNIX s")
    scored: bool = True
    psnr_tissue_db: float | None = None
    warnings: list[NoticeCode] = []
    duration_s: float | None = None
    error: str | None = None
    links: dict[str, str]


@router.get("", operation_id="list_scenes", responses=PAGED)
def list_scenes(services: Services, caller: AnyCaller, response: Response, search: SceneQuery) -> list[SceneSummary]:
    """The finished scenes, newest first, a page at a time.

    While the queue is away they are those in the store, and the header `X-Intrasplat-Queue: away` says so.
    """
    caller.require(KeyScope.VIEW)
    page, is_from_queue = services.done.page_of(caller.tenant, search)
    if not is_from_queue:
        response.headers["X-Intrasplat-Queue"] = "away"
    tell_next(response, page, caller.tenant)
    return [_summary(services, record) for record in page.records]


@router.get("/{scene_id}", operation_id="get_scene")
async def get_scene(scene_id: str, services: Services, caller: AnyCaller) -> Report:
    """The scene's quality report: held-out quality, what was assumed, warnings."""
    caller.require(KeyScope.VIEW)
    record = await run_in_threadpool(finished_job, services, caller, scene_id)
    await services.audit.viewed(caller, scene_id)
    return await run_in_threadpool(services.store.newest_report, scene_id, record.attempt)


@router.get(
    "/{scene_id}/curve",
    operation_id="get_curve",
    response_class=FileResponse,
    responses={200: {"description": "the curve", "content": {"text/csv": TEXT}}},
)
async def get_curve(scene_id: str, services: Services, caller: AnyCaller) -> FileResponse:
    """Held-out psnr_tissue over seconds of training, as CSV."""
    caller.require(KeyScope.VIEW)
    record = await run_in_threadpool(finished_job, services, caller, scene_id)
    folder = services.store.scene_folder(scene_id, record.attempt)
    if not (folder / CURVE).is_file():
        raise Problem(404, "This scene has no curve.", field="scene_id", remedy=f"See GET /scenes/{scene_id}.")
    await services.audit.viewed(caller, scene_id)
    return FileResponse(folder / CURVE, media_type="text/csv")


@router.get(
    "/{scene_id}/masks",
    operation_id="get_masks",
    response_class=FileResponse,
    responses={200: {"description": "the masks", "content": {"application/zip": BINARY}}},
)
async def get_masks(scene_id: str, services: Services, caller: AnyCaller) -> FileResponse:
    """The masks that were found, as a zip that POST /reconstruct takes as `masks`: correct them, and send
    them with `clip_of`, which uses this scene's clip again.

    One PNG a frame in the pixels of the recorded left eye, 255 on instruments.
    """
    caller.require(KeyScope.VIEW)
    record = await run_in_threadpool(finished_job, services, caller, scene_id)
    folder = await run_in_threadpool(services.store.scene_folder, scene_id, record.attempt)
    if not (folder / MASKS).is_file():
        detail = "No masks were found for this scene: they were given, there were none, or nothing looked like one."
        raise Problem(404, detail, field="scene_id", remedy=f"See masks in GET /scenes/{scene_id}.")
    await run_in_threadpool(services.audit.record, AuditAction.EXPORTED, caller, scene_id)
    headers = {"Content-Disposition": attachment(f"{file_stem(record)}-masks.zip")}
    return FileResponse(folder / MASKS, media_type="application/zip", headers=headers)


@router.get("/{scene_id}/cameras", operation_id="get_cameras", response_model=SceneCameras)
async def get_cameras(scene_id: str, services: Services, caller: AnyCaller) -> Response:
    """Where the endoscope was, frame by frame, and its lens; also while the job trains."""
    shown = await find_shown(services, caller, scene_id)
    request = CamerasRequest(scene_id=scene_id, attempt=shown.attempt)
    response = image_response(scene_id, await services.renderer.ask(request))
    response.headers["Cache-Control"] = "no-store"
    return response


@router.delete("/{scene_id}", operation_id="purge_scene")
def purge_scene(scene_id: str, services: Services, caller: AnyCaller) -> Receipt:
    """Remove a job that has ended, however it ended: clip, scene, record, events. The receipt says what was removed.

    A removal that was cut off is finished by asking again, or by the service itself within minutes.
    """
    caller.require(KeyScope.PURGE)
    record = _known(services, scene_id)
    if record is None or not caller.owns(record):
        raise no_such_scene(scene_id, caller, record)
    others = others_with_clip(services, record)
    return services.purger.purge(scene_id, caller).model_copy(update={"clip_kept_by": others})


def finished_job(services: Deps, caller: Caller, scene_id: str) -> JobRecord:
    """The record of a done job of the caller's tenant, whose scene exists.

    Raises:
        Problem: 404: there is no such scene, or it is another tenant's. 409: the job has no finished scene.
    """
    record = owned_scene(services, caller, scene_id)
    if record.state is not JobState.DONE:
        detail = f"The job is {record.state}; there is no finished scene."
        raise Problem(409, detail, field="scene", remedy=f"See GET /jobs/{scene_id}.")
    return record


async def find_finished(services: Deps, caller: Caller, scene_id: str) -> Shown:
    """The finished scene or the live feed of that id; raises as finished_job(), and Problem 403 without the scope."""
    caller.require(KeyScope.VIEW)
    return await run_in_threadpool(scene_or_feed, services, caller, scene_id, _finished)


def _finished(services: Deps, caller: Caller, scene_id: str) -> Shown:
    record = finished_job(services, caller, scene_id)
    return Shown(scene_id, record.attempt, stem=file_stem(record))


def file_stem(record: JobRecord) -> str:
    """Of the names of files that are made of the job's scene."""
    return stem_of(record.labels.label, record.created_at_s, record.job_id)


def _known(services: Deps, scene_id: str) -> JobRecord | None:
    """The job's record. If the queue has lost it, the record made at submission."""
    if not is_job_id(scene_id):
        return None
    return services.queue.get(scene_id) or services.store.submission(scene_id)


def _summary(services: Deps, record: JobRecord) -> SceneSummary:
    """A scene's entry in the list. A damaged scene still gets an entry."""
    scene_id = record.job_id
    links = {"report": f"/scenes/{scene_id}", "render": f"/render?scene={scene_id}", "job": f"/jobs/{scene_id}"}
    links["thumbnail"] = f"/scenes/{scene_id}/thumbnail"
    summary = SceneSummary(
        id=scene_id,
        **record.labels.model_dump(),
        preset=record.options.preset,
        created_at_s=record.created_at_s,
        links=links,
    )
    try:
        report = services.store.newest_report(scene_id, record.attempt)
    except SceneError as error:
        return summary.model_copy(update={"error": str(error)})
    codes = [each.code for each in report.warnings if each.severity is Severity.WARNING]
    times_s = report.frame_times_s
    known = {"scored": report.scored, "psnr_tissue_db": report.psnr_tissue_db, "warnings": codes}
    known["duration_s"] = times_s[-1] - times_s[0] if times_s else None
    return summary.model_copy(update=known)
