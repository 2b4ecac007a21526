"""Routes /healthz, /readyz, /info, /key and /metrics."""

from __future__ import annotations

from fastapi import APIRouter
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from contract import CONTRACT_VERSION
from contract.access.audit import utc_text
from contract.access.keys import KeyScope
from contract.wire.rendering import WorkerAddress
from intrasplat.errors import UnavailableError
from intrasplat.picture import ImageFormat, Layer
from intrasplat.version import version
from service.bodies import TEXT
from service.deps import AnyCaller, EarlyCaller, Services
from service.problems import Problem, disk_full, space_remedy
from service.renderer import WORKER_REMEDY
from service.upload import SUFFIXES

router = APIRouter(tags=["system"])

QUEUE_PATIENCE_S, WORKER_PATIENCE_S = 0.5, 0.3
"""How long /readyz waits for the queue, and for a worker that it lists."""

LIMITS = (
    *("max_upload_bytes", "max_frames", "max_frame_pixels", "max_clip_s", "min_free_bytes"),
    *("max_uploads", "upload_silence_s", "max_queued", "max_queued_per_tenant", "requests_per_s"),
    *("tenant_share", "long_training_s"),
    *("max_render_pixels", "render_timeout_s", "retention_hours", "max_retention_hours"),
)
"""Settings that /info shows; None where there is no limit."""


class Readiness(BaseModel):
    """What a ready service has; workers that only render are not counted. Callers without a key hear less."""

    ready: bool = True
    devices: list[str]
    workers: list[str] | None = None
    free_bytes: int | None = None


@router.get("/healthz", operation_id="healthz")
async def healthz() -> dict[str, bool]:
    """The process answers; nothing more, and nothing that another part could hold up."""
    return {"alive": True}


@router.get("/readyz", operation_id="readyz")
async def readyz(services: Services, caller: EarlyCaller) -> Readiness:
    """200 if a clip sent now would be trained: the queue answers, a worker is there, the disk has room.

    It answers within a second, also while the queue does not.
    """
    # Check for a full disk first, because it may stop the queue too.
    missing_bytes = await run_in_threadpool(services.intake.missing_bytes)
    if missing_bytes > 0:
        remedy = space_remedy(None if caller is None else missing_bytes, services.settings.min_free_bytes)
        raise disk_full("The disk has too little free space.", remedy, status=503, field="disk")
    try:
        workers = await run_in_threadpool(services.questions.ask, services.queue.workers, QUEUE_PATIENCE_S)
    except UnavailableError as error:
        raise Problem(503, error.problem, field="queue", remedy=error.remedy) from error
    trainers = [worker for worker in workers if not worker.renders_only]
    there = await services.renderer.reachable(trainers, WORKER_PATIENCE_S)
    if not there:
        raise _nobody_trains(workers)
    readiness = Readiness(devices=[worker.device for worker in there])
    if caller is None:
        return readiness
    free_bytes = await run_in_threadpool(services.store.free_bytes)
    return readiness.model_copy(update={"workers": [worker.name for worker in there], "free_bytes": free_bytes})


class Info(BaseModel):
    """What the service is and takes."""

    name: str = "intrasplat"
    version: str
    contract_version: int = CONTRACT_VERSION
    notice: str = "Research use only. Not a medical device."
    limits: dict[str, int | float | None] = Field(description="settings by name; null where there is no limit")
    accepts: dict[str, list[str]] = Field(description="endings of file names by part")
    layers: list[Layer] = list(Layer)
    formats: list[ImageFormat] = list(ImageFormat)


@router.get("/info", operation_id="info")
async def info(services: Services) -> Info:
    """Version, limits and accepted formats."""
    limits = {name: getattr(services.settings, name) for name in LIMITS}
    accepts = {part: list(suffixes) for part, suffixes in SUFFIXES.items()}
    return Info(version=version(), limits=limits, accepts=accepts)


class KeyView(BaseModel):
    """What the caller may do; key_id is null for this machine's user, who needs no key."""

    tenant: str
    scopes: list[KeyScope]
    key_id: str | None
    expires_at: str | None = Field(description="ISO 8601, UTC; null: it does not expire")


@router.get("/key", operation_id="get_key")
async def get_key(caller: AnyCaller) -> KeyView:
    """The tenant and the scopes of the caller's key, and when it expires."""
    expires_at = None if caller.expires_at_s is None else utc_text(caller.expires_at_s)
    return KeyView(tenant=caller.tenant, scopes=sorted(caller.scopes), key_id=caller.key_id, expires_at=expires_at)


@router.get(
    "/metrics",
    operation_id="metrics",
    response_class=Response,
    responses={200: {"description": "the figures", "content": {"text/plain": TEXT}}},
)
def read_metrics(services: Services, caller: AnyCaller) -> Response:
    """Figures for Prometheus, in its text format."""
    caller.require(KeyScope.OPERATE)
    return Response(services.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)


def _nobody_trains(workers: list[WorkerAddress]) -> Problem:
    if any(worker.renders_only and worker.feed_id is None for worker in workers):
        detail = "The workers that are there only render."
        return Problem(503, detail, field="worker", remedy="Start one that trains: `intrasplat worker`.")
    return Problem(503, "No worker is ready yet.", field="worker", remedy=f"Wait for it. {WORKER_REMEDY}")
