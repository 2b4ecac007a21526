"""Every error as problem+json (RFC 9457) that names the field at fault and the remedy."""

from __future__ import annotations

import errno
import logging
from collections.abc import Mapping

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from contract.errors import InputError, LimitError, SceneError, UnavailableError

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = 2
logger = logging.getLogger("intrasplat.service")

TITLES = {
    400: "The request cannot be understood",
    401: "A key is needed",
    403: "Not allowed",
    404: "Not found",
    405: "Method not allowed",
    409: "Not in this state",
    413: "Too large",
    422: "The input cannot be used",
    500: "A fault of the service",
    503: "Not available now",
    507: "No room on disk",
}


class Problem(Exception):
    """An answer other than the one asked for; raised anywhere below a route."""

    def __init__(
        self,
        status: int,
        detail: str,
        *,
        field: str | None = None,
        remedy: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.field = field
        self.remedy = remedy
        self.headers = headers or {}

    def response(self, headers: Mapping[str, str] | None = None) -> JSONResponse:
        """The problem document; 503 also says when to come back."""
        document = {
            "type": "about:blank",
            "title": TITLES.get(self.status, "Error"),
            "status": self.status,
            "detail": self.detail,
            "field": self.field,
            "remedy": self.remedy,
        }
        extra = {"Retry-After": str(RETRY_AFTER_S)} if self.status == 503 else {}
        content = {name: value for name, value in document.items() if value is not None}
        return JSONResponse(
            content, self.status, headers={**self.headers, **(headers or {}), **extra}, media_type=MEDIA_TYPE
        )


def install_handlers(app: FastAPI) -> None:
    """Answer every exception that leaves a route as a problem document."""
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(InputError, _on_input_error)
    app.add_exception_handler(SceneError, _on_scene_error)
    app.add_exception_handler(UnavailableError, _on_unavailable)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(OSError, _on_os_error)
    app.add_exception_handler(Exception, _on_fault)


def no_room(detail: str) -> Problem:
    """The answer to what the disk has no room for."""
    return Problem(507, detail, remedy="Delete scenes (DELETE /scenes/{id}) or give it more room.")


async def _on_problem(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, Problem)
    return error.response()


async def _on_input_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, InputError)
    status = 413 if isinstance(error, LimitError) else 422
    return Problem(status, error.problem, field=error.field, remedy=error.remedy).response()


async def _on_scene_error(request: Request, error: Exception) -> JSONResponse:
    return Problem(404, str(error), field="scene", remedy="GET /scenes lists what there is.").response()


async def _on_unavailable(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, UnavailableError)
    return Problem(503, error.problem, remedy=error.remedy).response()


async def _on_validation_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    field = str(first["loc"][-1])
    given = "" if first["type"] == "missing" else f" (given: {str(first.get('input'))[:80]!r})"
    detail = f"{first['msg']}{given}."
    return Problem(422, detail, field=field, remedy="The API is described at /openapi.json.").response()


async def _on_http_exception(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    remedy = "The API is described at /openapi.json." if error.status_code in (404, 405) else None
    return Problem(error.status_code, str(error.detail), remedy=remedy).response(error.headers)


async def _on_os_error(request: Request, error: Exception) -> JSONResponse:
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return no_room("The data directory's disk is full.").response()
    return await _on_fault(request, error)


async def _on_fault(request: Request, error: Exception) -> JSONResponse:
    logger.error("fault in %s %s: %s", request.method, request.url.path, type(error).__name__, exc_info=error)
    return Problem(500, "Something went wrong in the service; its log has the details.").response()
