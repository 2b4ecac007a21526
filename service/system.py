"""Whether the service lives, whether it can work, and what it is."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from pydantic import BaseModel
from starlette.responses import JSONResponse, Response

from contract import CONTRACT_VERSION
from contract.access.keys import KeyScope
from contract.queue.interface import trainers
from contract.wire.errors import UnavailableError
from contract.wire.rendering import ImageFormat, Layer
from service.deps import AnyCaller, Deps, Services
from service.problems import Problem, no_room
from service.renderer import WORKER_REMEDY
from service.upload import SUFFIXES
from service.version import version

router = APIRouter(tags=["system"])


LIMITS = (
    *("max_upload_bytes", "max_frames", "max_frame_pixels", "max_clip_s", "min_free_bytes"),
    *("max_uploads", "upload_silence_s", "max_queued", "max_queued_per_tenant", "requests_per_s"),
    *("max_render_pixels", "render_timeout_s", "retention_hours", "max_retention_hours"),
)
"""Settings that callers are told; None where there is no limit."""


class Readiness(BaseModel):
    """What a ready service has; workers that only render are not counted."""

    ready: bool = True
    workers: list[str]
    devices: list[str]
    free_bytes: int


@router.get("/healthz", operation_id="healthz")
async def healthz() -> dict[str, bool]:
    """The process answers; nothing more, and nothing that another part could hold up."""
    return {"alive": True}


@router.get("/readyz", operation_id="readyz", response_model=Readiness)
def readyz(services: Services) -> Readiness | JSONResponse:
    """200 if a clip sent now would be trained: the queue answers, a worker is ready, the disk has room."""
    trouble = _trouble(services)
    if trouble is not None:
        return trouble.response()
    workers = [worker for worker in services.queue.workers() if not worker.renders_only]
    return Readiness(
        workers=[worker.name for worker in workers],
        devices=[worker.device for worker in workers],
        free_bytes=services.store.free_bytes(),
    )


@router.get("/info", operation_id="info")
async def info(services: Services) -> dict[str, Any]:
    """Version, limits and accepted formats."""
    settings = services.settings
    return {
        "name": "intrasplat",
        "version": version(),
        "contract_version": CONTRACT_VERSION,
        "notice": "Research use only. Not a medical device.",
        "limits": {name: getattr(settings, name) for name in LIMITS},
        "accepts": {part: list(suffixes) for part, suffixes in SUFFIXES.items()},
        "layers": [layer.value for layer in Layer],
        "formats": [format.value for format in ImageFormat],
    }


class KeyView(BaseModel):
    """What the caller may do; key_id is null for this machine's user, who needs no key."""

    tenant: str
    scopes: list[KeyScope]
    key_id: str | None


@router.get("/key", operation_id="get_key")
async def get_key(caller: AnyCaller) -> KeyView:
    """The tenant and the scopes of the caller's key."""
    return KeyView(tenant=caller.tenant, scopes=sorted(caller.scopes), key_id=caller.key_id)


@router.get("/metrics", operation_id="metrics", response_class=Response)
def read_metrics(services: Services, caller: AnyCaller) -> Response:
    """Figures for Prometheus, in its text format."""
    caller.require(KeyScope.OPERATE)
    return Response(services.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)


def _trouble(services: Deps) -> Problem | None:
    """The first reason why work would not get done now. A full disk comes first, for the queue may be away with it."""
    if not services.intake.has_room():
        return no_room("The disk is full.", status=503, field="disk")
    try:
        services.queue.ping()
        workers = services.queue.workers()
    except UnavailableError as error:
        return Problem(503, error.problem, field="queue", remedy=error.remedy)
    if not trainers(workers):
        return Problem(503, "No worker is ready yet.", field="worker", remedy=f"Wait for it. {WORKER_REMEDY}")
    return None
