"""Uploads in pieces that survive lost connections: the tus protocol, version 1.0.0 (tus.io), creation and termination.

An upload is created with its length and purpose, grows by PATCH, and is named in POST /reconstruct once it is complete.
An offset is answered only when that many bytes are on disk.
"""

from __future__ import annotations

import base64
import binascii
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from io import RawIOBase
from pathlib import PurePosixPath
from typing import Annotated, Any

from fastapi import APIRouter, Header, Request, Response
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from contract.access.keys import KeyScope
from service.access import Caller
from service.deps import AnyCaller, Deps, Services
from service.intake import declared_length
from service.partial import Declaration, Partial, append, close, create_partial, find_partial, open_partials
from service.problems import Problem, problem_of
from service.upload import PARTS, check_part_size, checked_suffix

VERSION = "1.0.0"
RESUMABLE = {"Tus-Resumable": VERSION}
CONTENT_TYPE = "application/offset+octet-stream"
MAX_OPEN_UPLOADS = 100
"""Maximum uploads of one tenant that are unfinished or not used yet."""

REST_REMEDY = "Ask for the offset (HEAD) and send the bytes that follow."
METADATA_REMEDY = (
    "Send `part` (clip, left, right, calibration, masks, poses_file or fov_mask) and `suffix` (.mp4), each value in "
    "base64."
)


class TusRoute(APIRoute):
    """A route that accepts only this version of tus, and names it in every answer."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def handle_tus(request: Request) -> Response:
            try:
                if request.method != "OPTIONS":
                    _check_version(request)
                response = await handle(request)
            except Exception as error:
                problem = problem_of(error)
                if problem is None:
                    raise
                problem.headers |= RESUMABLE
                raise problem from error
            response.headers.update(RESUMABLE)
            return response

        return handle_tus


router = APIRouter(prefix="/uploads", tags=["uploads"], route_class=TusRoute)

TusResumable = Annotated[
    str, Header(description="the version of the protocol", examples=[VERSION], pattern=r"^1\.0\.0$")
]
Metadata = Annotated[
    str,
    Header(
        max_length=2000,
        description="`part` and `suffix` (or `filename`, of which the ending alone is kept), each value in base64",
        examples=["part Y2xpcA==,suffix Lm1wNA=="],
    ),
]


@router.options("", status_code=204, operation_id="describe_uploads", response_class=Response)
def describe_uploads(response: Response, services: Services) -> None:
    """What this server speaks, and how large an upload may be."""
    response.headers.update(
        {
            "Tus-Version": VERSION,
            "Tus-Extension": "creation,termination",
            "Tus-Max-Size": str(services.settings.max_upload_bytes),
        }
    )


@router.post("", status_code=201, operation_id="create_upload", response_class=Response)
def create_upload(
    response: Response,
    services: Services,
    caller: AnyCaller,
    upload_length: Annotated[int, Header(ge=1)],
    upload_metadata: Metadata,
    tus_resumable: TusResumable,
) -> None:
    """Announce a file; Location is where its bytes go. Unused for 24 hours, it is removed."""
    caller.require(KeyScope.RECONSTRUCT)
    part, suffix = _part_and_suffix(upload_metadata)
    _check_size(services, caller, part, upload_length)
    declaration = Declaration(
        tenant=caller.tenant, part=part, suffix=suffix, length_bytes=upload_length, created_at_s=time.time()
    )
    partial = create_partial(services.store, declaration)
    response.headers["Location"] = f"/uploads/{partial.upload_id}"
    response.headers["Upload-Offset"] = "0"


@router.head("/{upload_id}", operation_id="get_upload", response_class=Response)
def get_upload(
    upload_id: str, response: Response, services: Services, caller: AnyCaller, tus_resumable: TusResumable
) -> None:
    """How much has come."""
    caller.require(KeyScope.RECONSTRUCT)
    partial = _owned(services, caller, upload_id)
    response.headers["Upload-Offset"] = str(partial.offset_bytes)
    response.headers["Upload-Length"] = str(partial.declaration.length_bytes)
    response.headers["Cache-Control"] = "no-store"


@router.patch(
    "/{upload_id}",
    status_code=204,
    operation_id="append_to_upload",
    response_class=Response,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {CONTENT_TYPE: {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def append_to_upload(
    upload_id: str,
    request: Request,
    response: Response,
    services: Services,
    caller: AnyCaller,
    upload_offset: Annotated[int, Header(ge=0)],
    tus_resumable: TusResumable,
) -> None:
    """Send the bytes that follow the offset; the new offset is answered when they are on disk."""
    caller.require(KeyScope.RECONSTRUCT)
    content_type = request.headers.get("content-type", "")
    if content_type != CONTENT_TYPE:
        raise Problem(415, f"The content type is {content_type[:80]!r}.", field="Content-Type", remedy=CONTENT_TYPE)
    partial = await run_in_threadpool(_owned, services, caller, upload_id)
    with services.intake.slot(caller.tenant) as slot:
        file = await run_in_threadpool(_open_at, partial, upload_offset)
        try:
            left_bytes = partial.declaration.length_bytes - upload_offset
            _check_fits(declared_length(request), left_bytes)
            new_bytes = await _write(services.intake.body(request, slot), file, left_bytes)
        except ClientDisconnect:
            detail = "The connection was closed; the bytes that came are stored."
            raise Problem(400, detail, field="body", remedy=REST_REMEDY) from None
        finally:
            await run_in_threadpool(close, file)
    response.headers["Upload-Offset"] = str(upload_offset + new_bytes)


@router.delete("/{upload_id}", status_code=204, operation_id="delete_upload", response_class=Response)
def delete_upload(upload_id: str, services: Services, caller: AnyCaller, tus_resumable: TusResumable) -> None:
    """Give an upload up. A job that has it already keeps it."""
    caller.require(KeyScope.RECONSTRUCT)
    services.store.discard_incoming(_owned(services, caller, upload_id).upload_id)


async def _write(pieces: AsyncIterator[bytes], file: RawIOBase, left_bytes: int) -> int:
    """Write all pieces. Returns their number of bytes."""
    new_bytes = 0
    async for piece in pieces:
        _check_fits(new_bytes + len(piece), left_bytes)
        await run_in_threadpool(append, file, piece)
        new_bytes += len(piece)
    return new_bytes


def _open_at(partial: Partial, offset_bytes: int) -> RawIOBase:
    """The upload's file, locked, for writing from that offset."""
    try:
        file = partial.open()
    except BlockingIOError:
        detail, remedy = "Another request is writing to this upload.", f"Wait until it has ended. {REST_REMEDY}"
        raise Problem(423, detail, field="upload_id", remedy=remedy) from None
    except FileNotFoundError:
        detail = "This upload is complete, and a job has taken it."
        raise Problem(409, detail, field="upload_id", remedy="See GET /jobs.") from None
    if partial.offset_bytes == offset_bytes:
        return file
    file.close()
    detail = f"{partial.offset_bytes} bytes have come, not {offset_bytes}."
    headers = {"Upload-Offset": str(partial.offset_bytes)}
    raise Problem(409, detail, field="Upload-Offset", remedy="Send the bytes that follow.", headers=headers)


def _owned(services: Deps, caller: Caller, upload_id: str) -> Partial:
    """The caller's upload. A missing upload and another tenant's upload give the same 404."""
    partial = find_partial(services.store, upload_id, caller.tenant)
    if partial is None:
        detail = f"There is no upload {upload_id[:40]!r}."
        raise Problem(404, detail, field="upload_id", remedy="Create one: POST /uploads.")
    return partial


def _check_version(request: Request) -> None:
    if request.headers.get("tus-resumable") != VERSION:
        headers = {"Tus-Version": VERSION}
        raise Problem(412, f"This is tus {VERSION}.", field="Tus-Resumable", remedy=f"Send {VERSION}.", headers=headers)


def _check_size(services: Deps, caller: Caller, part: str, length_bytes: int) -> None:
    check_part_size(part, length_bytes)
    services.intake.check(caller.tenant, length_bytes)
    count = sum(partial.declaration.tenant == caller.tenant for partial in open_partials(services.store))
    if count >= MAX_OPEN_UPLOADS:
        remedy = "Use or delete some: DELETE /uploads/{id}."
        raise Problem(429, f"{count} uploads are open.", field="uploads", remedy=remedy)


def _check_fits(new_bytes: int, left_bytes: int) -> None:
    if new_bytes > left_bytes:
        detail = f"Only {left_bytes} bytes of the upload are left to come."
        raise Problem(413, detail, field="Upload-Length", remedy=REST_REMEDY)


def _part_and_suffix(metadata: str) -> tuple[str, str]:
    """Part and file ending from Upload-Metadata; everything else there is ignored."""
    values = {}
    for pair in metadata.split(","):
        name, _, encoded = pair.strip().partition(" ")
        try:
            values[name] = base64.b64decode(encoded, validate=True).decode()
        except (binascii.Error, UnicodeDecodeError):
            raise Problem(
                400, f"{name[:40]!r} is not base64.", field="Upload-Metadata", remedy=METADATA_REMEDY
            ) from None
    part = values.get("part", "")
    if part not in PARTS:
        raise Problem(422, f"{part[:40]!r} is not a part of a clip.", field="Upload-Metadata", remedy=METADATA_REMEDY)
    return part, checked_suffix(part, values.get("suffix") or PurePosixPath(values.get("filename", "")).suffix)
