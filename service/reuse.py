"""A new job with the clip of an earlier job. It gets its own links to the files, so either job can be removed alone."""

from __future__ import annotations

import os
from pathlib import Path

from contract.store.shelf import is_job_id
from contract.store.store import Store
from contract.wire.job import JobRecord
from intrasplat.errors import InputError, LimitError, UnavailableError
from service.access import Caller
from service.deps import Deps, not_found
from service.partial import sha256_of
from service.problems import Problem
from service.upload import CLIP_OF, LIMIT_REMEDY, Received


def add_files_of(services: Deps, earlier: JobRecord, folder: Path, received: Received) -> None:
    """Link an earlier job's files into the upload of a new one, except the parts that were sent with it.

    Args:
        folder: the folder of the new upload.

    Raises:
        Problem: 409: the clip is no longer stored.
        LimitError: sent and linked files together exceed the maximum size of an upload.
    """
    try:
        source = services.store.fetch_clip(earlier.job_id)
        for name in earlier.files.model_dump(exclude_none=True).values():
            part = Path(name).stem
            if part not in received.names:
                os.link(source / name, folder / name)
                received.names[part] = name
                received.digests[part] = sha256_of(folder / name)
                received.total_bytes += (folder / name).stat().st_size
    except FileNotFoundError:
        raise _no_clip(earlier.job_id) from None
    except UnavailableError:
        if services.store.submission(earlier.job_id) is None:  # removed meanwhile
            raise _no_clip(earlier.job_id) from None
        raise
    if received.total_bytes > services.settings.max_upload_bytes:
        problem = f"its files have {received.total_bytes} bytes with those sent, more than an upload may have."
        raise LimitError(CLIP_OF, problem, LIMIT_REMEDY)


def earlier_job(services: Deps, caller: Caller, job_id: str) -> JobRecord:
    """The submission of the caller's job with that id, whose clip is stored.

    Raises:
        InputError: `job_id` is not a job id.
        Problem: 404: the caller has no such job. 409: its clip is no longer stored.
        UnavailableError: the clip does not exist, and the queue that would know the job is unreachable.
    """
    if not is_job_id(job_id):
        raise InputError(CLIP_OF, f"{job_id[:40]!r} is no job's id.", "Give the id of a job or scene: GET /jobs.")
    record = services.store.submission(job_id) or services.queue.get(job_id)
    if record is None or not caller.owns(record):
        remedy = "GET /jobs lists what there is."
        raise not_found(f"There is no job {job_id!r} whose clip could be used.", CLIP_OF, remedy, caller, record)
    if services.store.submission(job_id) is None:
        raise _no_clip(job_id)
    if record.imported is not None:
        problem = f"the scene {job_id} was imported, and its clip stayed where it was made."
        raise InputError(CLIP_OF, problem, "Give a job that reconstructed a clip here, or send the clip itself.")
    return record


def first_job(store: Store, job_id: str) -> str:
    """The job with which the clip was uploaded; the job itself if no other is known."""
    record = store.submission(job_id)
    return job_id if record is None else record.clip_of or job_id


def others_with_clip(services: Deps, record: JobRecord) -> list[str]:
    """The other jobs of the tenant that store the same clip, newest first."""
    first = record.clip_of or record.job_id
    same = [each for each in services.queue.records(record.tenant, None) if first in (each.job_id, each.clip_of)]
    ids = [each.job_id for each in same if each.job_id != record.job_id]
    return [job_id for job_id in ids if services.store.submission(job_id) is not None]


def _no_clip(job_id: str) -> Problem:
    detail = f"The clip of job {job_id} is not kept any more."
    return Problem(409, detail, field=CLIP_OF, remedy="Send the clip itself: as clip, or as left and right.")
