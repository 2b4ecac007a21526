"""The stored files of a finished scene, byte for byte: for players and programs that read docs/scene-file.md."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Header, Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from intrasplat.errors import SceneError
from intrasplat.names import MANIFEST, SCENE
from intrasplat.scene.results import listed_files
from service.bodies import BINARY
from service.deps import AnyCaller, Services
from service.problems import Problem
from service.renders import matches
from service.scenes import finished_job

router = APIRouter(prefix="/scenes", tags=["scenes"])

MEDIA_TYPES = {".json": "application/json", ".csv": "text/csv"}
ANY_FILE = "application/octet-stream"
NEVER_CHANGES = "private, max-age=31536000, immutable"
CHANGES_ONCE = "private, no-cache"
"""Cache-Control of the other files, which change once: scores are added to a finished scene."""
RESPONSES: dict[int | str, dict[str, object]] = {
    200: {"description": "the file", "content": dict.fromkeys((ANY_FILE, *MEDIA_TYPES.values()), BINARY)},
    206: {"description": "the part that Range asks for", "content": {ANY_FILE: BINARY}},
    304: {"description": "it is the one that the caller has"},
    416: {"description": "Range lies beyond the file's end"},
}


@dataclass(frozen=True)
class StoredFile:
    """A file of a scene and its SHA-256."""

    path: Path
    sha256: str


@router.head("/{scene_id}/files/{name}", include_in_schema=False)
@router.get("/{scene_id}/files/{name}", operation_id="get_file", response_class=FileResponse, responses=RESPONSES)
async def get_file(
    scene_id: str,
    name: str,
    services: Services,
    caller: AnyCaller,
    request: Request,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """A stored file: manifest.json, or one of those that it lists, such as scene.safetensors or recorded.zip. Answers
    Range.

    The ETag is the SHA-256 of the file.
    """
    caller.require(KeyScope.DOWNLOAD)
    record = await run_in_threadpool(finished_job, services, caller, scene_id)
    folder = await run_in_threadpool(services.store.scene_folder, scene_id, record.attempt)
    found = await run_in_threadpool(_file_of, folder, name)
    if found is None:
        remedy = f"GET /scenes/{scene_id}/files/{MANIFEST} lists the others."
        raise Problem(404, f"This scene has no file {name[:80]!r}.", field="name", remedy=remedy)
    headers = {
        "ETag": f'"{found.sha256}"',
        "Cache-Control": NEVER_CHANGES if name == SCENE else CHANGES_ONCE,
        "Vary": "Authorization, X-API-Key",
    }
    if matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if request.method == "GET":
        await run_in_threadpool(services.audit.record, AuditAction.DOWNLOADED, caller, scene_id)
    media_type = MEDIA_TYPES.get(found.path.suffix, ANY_FILE)
    return FileResponse(found.path, headers=headers, media_type=media_type)


def _file_of(folder: Path, name: str) -> StoredFile | None:
    """The scene's file with that name; None if its manifest does not list it.

    Raises:
        SceneError: the manifest cannot be read.
    """
    manifest = folder / MANIFEST
    try:
        content = manifest.read_bytes()
        if name == MANIFEST:
            return StoredFile(manifest, hashlib.sha256(content).hexdigest())
        listed = listed_files(json.loads(content))
        if name not in listed or name != Path(name).name:
            return None
        return StoredFile(folder / name, str(listed[name]["sha256"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"The manifest of this scene cannot be read ({type(error).__name__}).") from error
