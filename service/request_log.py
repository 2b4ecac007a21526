"""Middleware around all routes: request ids, a log line and a span for each request, and the answer to a fault.

Log and span contain the route's template, not the path, and no query, headers or body: callers put anything there.
"""

from __future__ import annotations

import logging
import re
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from opentelemetry.trace import INVALID_SPAN, Span, SpanKind
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from contract.runtime import traces
from contract.runtime.logs import answering
from contract.store.shelf import is_job_id
from service.metrics import METHODS
from service.problems import RETRY_REMEDY, Problem, fault

REQUEST_ID = "X-Request-Id"
ACCEPTED_REQUEST_ID = re.compile(r"[0-9a-fA-F-]{8,64}")
"""A caller's request id is used if it is a UUID or trace id. The id is logged, and words in it could name somebody."""

QUIET_ROUTES = frozenset({"/healthz", "/readyz", "/metrics", "/scenes/{scene_id}/recorded"})
"""Routes that machines and viewers of feeds poll. They are logged only when their status changes from or to a failure;
the audit says who looked."""

MAX_OPEN = 512
"""Maximum requests, event streams and WebSockets at a time. Each may occupy a connection for long."""

NO_ROUTE = "-"
"""Of the page's files, which are logged only when they fail."""
OTHER_METHOD = "_OTHER"
"""OpenTelemetry's name for an unknown HTTP method, in spans."""
OK = 200
GONE = 499
"""A status for the log only: the caller disconnected before it was answered."""
SWITCHED = 101

logger = logging.getLogger("intrasplat.access")


@dataclass
class _Answered:
    """The progress of the answer to one request."""

    status: int | None = None


class RequestLog:
    """ASGI middleware; only the counting of requests is further out."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._open = 0
        self._last_status: dict[str, int] = {}
        """The last status of each quiet route; OK for everything below 400."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get(REQUEST_ID, "")
        answered, began_s = _Answered(), time.perf_counter()
        self._open += 1
        with _span_of(scope) as span:
            request_id = given if ACCEPTED_REQUEST_ID.fullmatch(given) else traces.trace_id() or uuid.uuid4().hex
            with answering(request_id):
                try:
                    await self._answer(scope, receive, _marking(scope, send, request_id, answered), answered)
                finally:
                    self._open -= 1
                    self._log(scope, answered.status or GONE, time.perf_counter() - began_s)
                    _describe(span, scope, request_id, answered.status or GONE)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, answered: _Answered) -> None:
        if self._open > MAX_OPEN:
            problem = Problem(
                503, f"The service answers {MAX_OPEN} requests already, its most at once.", remedy=RETRY_REMEDY
            )
            await _refuse(problem, scope, receive, send)
            return
        try:
            await self._app(scope, receive, send)
        except Exception:
            logger.exception("a fault")
            if answered.status is not None:
                raise  # the answer has started: the server cuts the connection
            await _refuse(fault(), scope, receive, send)

    def _log(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", NO_ROUTE)
        fields = {
            "method": scope.get("method", "WEBSOCKET"),
            "route": route,
            "status": status,
            "duration_ms": round(seconds * 1000.0, 1),
        }
        is_polled = route in QUIET_ROUTES and not self._has_changed(route, status)
        is_of_page = route == NO_ROUTE and status < 400
        level = logging.DEBUG if is_polled or is_of_page else logging.INFO
        logger.log(level, "answered", extra=fields)

    def _has_changed(self, route: str, status: int) -> bool:
        now = status if status >= 400 else OK
        before, self._last_status[route] = self._last_status.get(route, OK), now
        return now != before


def _marking(scope: Scope, send: Send, request_id: str, answered: _Answered) -> Send:
    """A `send` that notes the status, adds the request's id, and gives refused WebSockets a problem document."""

    async def marked(message: Message) -> None:
        kind = message["type"]
        if kind == "websocket.close" and answered.status is None:
            problem = Problem(404, "There is no such WebSocket.", remedy="There are /stream and /feeds/{id}/pictures.")
            await _refuse(problem, scope, _nothing, marked)
            return
        if kind == "websocket.accept":
            answered.status = SWITCHED
        elif kind in ("http.response.start", "websocket.http.response.start"):
            answered.status = message["status"]
            MutableHeaders(scope=message)[REQUEST_ID] = request_id
        await send(message)

    return marked


async def _refuse(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    response: Response = problem.response()
    await response(scope, receive, send)


async def _nothing() -> Message:
    return {"type": "websocket.disconnect"}


@contextmanager
def _span_of(scope: Scope) -> Iterator[Span]:
    """The span of a request, in the caller's trace. Each view of a WebSocket has its own span."""
    if scope["type"] == "websocket" or scope["path"] in QUIET_ROUTES:
        yield INVALID_SPAN
        return
    parent = Headers(scope=scope).get(traces.TRACEPARENT, traces.NEW)
    with traces.span(_method_of(scope), parent, kind=SpanKind.SERVER) as span:
        yield span


def _describe(span: Span, scope: Scope, request_id: str, status: int) -> None:
    if not span.is_recording():
        return
    method, route = _method_of(scope), getattr(scope.get("route"), "path", NO_ROUTE)
    span.update_name(f"{method} {route}")
    traces.describe(span, request_id=request_id, method=method, route=route, status=status)
    for job_id in scope.get("path_params", {}).values():
        if is_job_id(str(job_id)):
            traces.describe(span, job_id=str(job_id))
    if status >= 500:
        traces.fail(span, str(status))


def _method_of(scope: Scope) -> str:
    return scope["method"] if scope["method"] in METHODS else OTHER_METHOD
