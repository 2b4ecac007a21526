"""Exports as their callers ask for them, part by part."""

from __future__ import annotations

import uuid
from collections.abc import Callable

from contract.wire.exports import check_export
from contract.wire.rendering import ExportRequest, SceneRequest
from worker.daemon.reply import Reply


def export_request(scene_id: str, name: str = "ply", **options: object) -> ExportRequest:
    """The request for the first part."""
    export_id = uuid.uuid4().hex
    return ExportRequest(
        scene_id=scene_id, attempt=1, format=name, options=check_export(name, options), export_id=export_id
    )


def exported(answer: Callable[[SceneRequest], Reply], request: ExportRequest) -> tuple[Reply, bytes]:
    """The first reply and the whole file."""
    first = reply = answer(request)
    content = [first.body]
    while reply.more:
        request = request.model_copy(update={"part": request.part + 1})
        reply = answer(request)
        content.append(reply.body)
    return first, b"".join(content)
