"""Every error as problem+json (RFC 9457) that names the field at fault and the remedy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocketState

from contract.queue.feeds import FeedsFullError
from contract.queue.interface import QueueFullError
from intrasplat.errors import (
    ErrorCode,
    InputError,
    LimitError,
    MissingExtraError,
    NotListedError,
    SceneError,
    UnavailableError,
)
from intrasplat.files.disk_errors import DISK_FULL_ERRNOS, StoreFullError

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = 2
"""Default Retry-After of 423, 429 and 503."""
RETRY_REMEDY = "Send the request again after the seconds in Retry-After."
API_REMEDY = "The API is described at /openapi.json."
MESSAGE_REMEDY = "Messages are described in docs/stream.md, and in short at /openapi.json."
SPACE_REMEDY = "Delete scenes (DELETE /scenes/{id}) or give it more room."
MIN_FREE = "INTRASPLAT_MIN_FREE_BYTES"
LENGTH_REMEDY = "Send Content-Length once, as a number, or chunks without it."
SCENES_REMEDY = "GET /scenes lists what there is."
FAULT_REMEDY = "Report it with the log's lines of this X-Request-Id."

MAX_SHOWN = 80
"""Maximum characters of a caller's own text that an answer repeats, such as an unknown field's name."""

TITLES = {
    400: "The request cannot be understood",
    401: "A key is needed",
    403: "Not allowed",
    404: "Not found",
    405: "Method not allowed",
    408: "Nothing came",
    409: "Not in this state",
    412: "Another version is spoken here",
    413: "Too large",
    415: "Not this type of content",
    422: "The input cannot be used",
    423: "Being written to",
    429: "Too much at once",
    500: "A fault of the service",
    501: "This installation lacks what it takes",
    503: "Not available now",
    507: "No room on disk",
}


class Problem(Exception):
    """An error response; raised anywhere below a route.

    remedy has no default, so that nobody forgets it. `extensions` are further members of the document, such as the
    job. retry_after_s: seconds until a retry may succeed; in the document too, for callers that see no headers.
    """

    def __init__(
        self,
        status: int,
        detail: str,
        *,
        field: str | None = None,
        remedy: str | None,
        headers: Mapping[str, str] | None = None,
        extensions: Mapping[str, object] | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.field = None if field is None else field[:MAX_SHOWN]
        self.remedy = remedy
        self.headers = dict(headers or {})
        self.extensions = dict(extensions or {})
        if retry_after_s is not None:
            self.extensions["retry_after_s"] = retry_after_s
            self.headers["Retry-After"] = str(max(1, math.ceil(retry_after_s)))
        if status in (423, 429, 503):
            self.headers.setdefault("Retry-After", str(RETRY_AFTER_S))

    def document(self) -> dict[str, object]:
        """The problem document of RFC 9457, with the remedy, and the field if one is at fault."""
        title = TITLES.get(self.status, "Error")
        document = {"type": "about:blank", "title": title, "status": self.status, "detail": self.detail}
        about = {"field": self.field, "remedy": self.remedy, **self.extensions}
        return document | {name: value for name, value in about.items() if value is not None}

    def response(self) -> JSONResponse:
        """The problem document as a response."""
        return JSONResponse(self.document(), self.status, headers=self.headers, media_type=MEDIA_TYPE)


def install_handlers(app: FastAPI) -> None:
    """Answer every exception that leaves a route with a problem document; an unexpected one remains a fault (500)."""
    for kind in (Problem, InputError, SceneError, UnavailableError, RequestValidationError, HTTPException, OSError):
        app.add_exception_handler(kind, answer)


async def answer(connection: Any, error: Exception) -> Any:
    """The problem as a response to a Request. A WebSocket is refused, or closed after a last message."""
    problem = problem_of(error)
    if problem is None:
        raise error
    if isinstance(connection, Request):
        return problem.response()
    if connection.application_state is WebSocketState.CONNECTING:
        await connection.send_denial_response(problem.response())
    else:
        await connection.send_json(problem.document())
        await connection.close(1011)
    return None


def problem_of(error: Exception) -> Problem | None:
    """The problem for an error; None for an unexpected one."""
    match error:
        case Problem():
            return error
        case MissingExtraError():
            return lacking(error.problem, error.remedy)
        case InputError():
            status = 413 if isinstance(error, LimitError) else 422
            extensions = {"code": error.code.value} if isinstance(error, NotListedError) else None
            return Problem(status, error.problem, field=error.field, remedy=error.remedy, extensions=extensions)
        case SceneError():
            return Problem(404, str(error), field="scene", remedy=SCENES_REMEDY)
        case QueueFullError():
            return Problem(429 if error.tenant else 503, error.problem, field="queue", remedy=error.remedy)
        case FeedsFullError():
            return Problem(429 if error.tenant else 503, error.problem, field="feeds", remedy=error.remedy)
        case StoreFullError():
            return disk_full(error.problem, error.remedy)
        case UnavailableError():
            return Problem(503, error.problem, remedy=error.remedy)
        case RequestValidationError():
            return _problem_of_validation(error)
        case HTTPException():
            return _problem_of_http_exception(error)
        case OSError() if error.errno in DISK_FULL_ERRNOS:
            return disk_full("The data directory's disk is full.")
        case _:
            return None


def fault() -> Problem:
    """The answer to an unexpected error; the log has the details, under the request's id."""
    return Problem(500, "Something went wrong in the service; its log has the details.", remedy=FAULT_REMEDY)


def lacking(detail: str, remedy: str | None) -> Problem:
    """The answer where an extra is not installed; its member `code` is "missing_extra"."""
    return Problem(501, detail, field="format", remedy=remedy, extensions={"code": ErrorCode.MISSING_EXTRA.value})


def disk_full(detail: str, remedy: str = SPACE_REMEDY, *, status: int = 507, field: str | None = None) -> Problem:
    """The answer when the disk is full; its member `code` is "store_full"."""
    return Problem(status, detail, field=field, remedy=remedy, extensions={"code": ErrorCode.STORE_FULL.value})


def disk_full_for_upload(upload_bytes: int, available_bytes: int, min_free_bytes: int) -> Problem:
    """The answer to an upload of upload_bytes when only available_bytes may be written."""
    detail = f"The disk has room for {max(available_bytes, 0)} bytes of an upload, and {upload_bytes} are needed."
    return disk_full(detail, space_remedy(upload_bytes - available_bytes, min_free_bytes))


def space_remedy(missing_bytes: int | None, min_free_bytes: int) -> str:
    """The remedy for a disk with too little free space. missing_bytes None: not shown to the caller."""
    amount = "space" if missing_bytes is None else f"{missing_bytes} bytes"
    return f"Free {amount}, such as by DELETE /scenes/{{id}}: {min_free_bytes} must stay free ({MIN_FREE})."


def _problem_of_validation(error: RequestValidationError) -> Problem:
    first = error.errors()[0]
    if first["type"] == "json_invalid":
        return Problem(400, "The body is not JSON.", field="body", remedy=API_REMEDY)
    given = "" if first["type"] == "missing" else f" (given: {str(first.get('input'))[:MAX_SHOWN]!r})"
    place = [str(each) for each in first["loc"] if each != "[key]"]  # pydantic's sign for the key itself
    return Problem(422, f"{first['msg']}{given}.", field=".".join(place[1:] or place), remedy=API_REMEDY)


def _problem_of_http_exception(error: HTTPException) -> Problem:
    return Problem(error.status_code, str(error.detail), remedy=API_REMEDY, headers=error.headers)
