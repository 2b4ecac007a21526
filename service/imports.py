"""POST /scenes: imports a scene that another installation exported, by a job like any other.

The service checks the archive without reading its numbers; the worker that claims the job reads the scene.
"""

from __future__ import annotations

import time

from fastapi import APIRouter, Request, Response
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from contract.wire.job import JobFiles, JobRecord, JobView
from contract.wire.labels import Labels
from intrasplat.errors import InputError
from intrasplat.options import JobOptions, parse_options
from intrasplat.report import Imported
from intrasplat.scene.archive import read_archive
from service.access import Caller
from service.bodies import SCENE_BODY
from service.callbacks import check_callback
from service.deps import AnyCaller, Deps, Services
from service.problems import RETRY_AFTER_S
from service.reconstruct import IdempotencyKey, check_scopes, forecast_of, hash_of, receive_form, spool_and_queue
from service.retention import check_retention
from service.upload import SCENE_FORM, SCENE_PART, Received

router = APIRouter(tags=["scenes"])

OPTIONS = ("priority", "retention_hours")
"""The options of an import; those about training do not apply."""


@router.post("/scenes", status_code=202, operation_id="import_scene", openapi_extra=SCENE_BODY)
async def import_scene(
    request: Request, response: Response, services: Services, caller: AnyCaller, idempotency_key: IdempotencyKey = None
) -> JobView:
    """Send a scene that another installation exported with format=scene. 202 means that it is safely on disk and
    queued; Location is the job, which is done when a worker has read the scene, and whose id is the scene's here.
    """
    caller.require(KeyScope.RECONSTRUCT)
    record = await receive_form(request, services, caller, hash_of(idempotency_key), _accept, SCENE_FORM)
    response.headers["Location"] = f"/jobs/{record.job_id}"
    response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return JobView.of(record, await run_in_threadpool(forecast_of, services, record))


def _accept(services: Deps, caller: Caller, job_id: str, received: Received, key: str | None) -> JobRecord:
    """Spool first, then enqueue: a job exists only for an archive that is on disk and has passed the checks."""
    options = _options(received.options)
    check_retention(options, services.settings)
    check_scopes(options, caller, services.settings)
    check_callback(received.callback_url, services.settings)
    if SCENE_PART not in received.names:
        raise InputError(SCENE_PART, "there is no scene.", SCENE_FORM.remedy)
    name, now_s = received.names[SCENE_PART], time.time()
    archive = read_archive(services.store.incoming_folder(job_id) / name, services.settings.max_upload_bytes)
    head = archive.head
    record = JobRecord(
        job_id=job_id,
        tenant=caller.tenant,
        files=JobFiles(clip=name),
        options=options.model_copy(update={"preset": archive.manifest.preset}),
        labels=_labels(received.labels, head.label),
        callback_url=received.callback_url,
        input_bytes=received.total_bytes,
        input_sha256=received.sha256(),
        imported=Imported(
            scene_id=head.scene_id, version=head.intrasplat, exported_at_s=head.exported_at_s, imported_at_s=now_s
        ),
        idempotency_key=key,
        created_at_s=now_s,
    )
    services.audit.record(AuditAction.IMPORTED, caller, job_id)
    return spool_and_queue(services, record)


def _labels(given: Labels, exported: str | None) -> Labels:
    """What the caller writes on the scene; without a label, that of the archive.

    Raises:
        InputError: the archive's is none.
    """
    if given.label is not None or exported is None:
        return given
    try:
        return Labels(label=exported, metadata=given.metadata)
    except ValidationError as error:
        raise InputError(SCENE_PART, "its label is none that a scene can have.", "Give it another one.") from error


def _options(text: str) -> JobOptions:
    """The options of an import.

    Raises:
        InputError: names an option that concerns training, or that cannot be used.
    """
    options = parse_options(JobOptions, text)
    for name in sorted(options.model_fields_set - {*OPTIONS}):
        remedy = f"Leave it out. An import takes {' and '.join(OPTIONS)}."
        raise InputError(f"options.{name}", "an imported scene is not trained.", remedy)
    return options
