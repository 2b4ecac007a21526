"""WS /stream: many views over one connection, each for the newest request.

The client sends JSON texts: the query of /render, and an `id` of its choice that is repeated in the answer. An answer
is one binary message: the length of its head (4 bytes, big-endian), the head (JSON, StreamHead), the image. An error
is a JSON text: the problem document of HTTP with the `id`. The connection then stays open, unless the caller is not
allowed (1008) or a message was not a request (1003, 1009). With keys, the first message of a browser, which cannot send
headers, is {"authorize": KEY}.

While a view is rendered and sent, only the newest incoming message is kept. So a viewer that sends requests faster than
they are answered skips views, and a viewer that does not read gets one view and then none.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from opentelemetry.trace import SpanKind
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json
from starlette.types import Message

from contract.access.keys import KeyScope
from contract.runtime import traces
from contract.wire.job import JobState
from contract.wire.rendering import PictureCamera
from intrasplat.notices import Notice
from service.access import AccessRefusal, Caller, key_missing
from service.connection import Answer
from service.deps import Deps, EarlyCaller, Services, address_of
from service.problems import API_REMEDY, Problem, fault, problem_of
from service.renders import RenderQuery, Shown, answer_to, find_shown, problem_of_reply, request_of

router = APIRouter()

LENGTH_BYTES = 4
MAX_MESSAGE = 16 * 1024
"""Maximum characters of a message; a request has some hundred."""
AUTHORIZE_TIMEOUT_S = 5.0
"""A client that connects without a key must send it within this time."""
SEND_TIMEOUT_S = 30.0
"""A viewer that takes this long to receive one view counts as gone."""

NOT_TEXT, NOT_ALLOWED, TOO_LARGE = 1003, 1008, 1009
"""Close codes of RFC 6455, 7.4.1."""

AUTHORIZE = "authorize"
GONE = (WebSocketDisconnect, TimeoutError)
"""Raised when the viewer has disconnected, or does not read any more."""

logger = logging.getLogger("intrasplat.service")


class StreamMessage(RenderQuery):
    """A view that is asked for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str | int | None = Field(default=None, description="comes back with the answer")


class StreamHead(BaseModel):
    """What a view shows; the fields are those of /render's headers."""

    id: str | int | None
    scene: str
    state: JobState
    t: float
    iteration: int | None
    unseen: float
    detail: float
    warnings: tuple[Notice, ...]
    media_type: str
    depth_range_mm: tuple[float, float] | None
    render_ms: float
    total_ms: float
    camera: PictureCamera | None = None


class _HangUp(Exception):
    """Close the connection with this code, after a last message."""

    def __init__(self, code: int, problem: Problem) -> None:
        super().__init__(problem.detail)
        self.code = code
        self.problem = problem


@router.websocket("/stream")
async def stream(websocket: WebSocket, services: Services, caller: EarlyCaller) -> None:
    """Views one after the other; see the head of this file."""
    if caller is not None:
        caller.require(KeyScope.VIEW)  # refused before the handshake
    with contextlib.ExitStack() as lobby:
        if caller is None:
            lobby.enter_context(services.access.stranger())
        await websocket.accept()
        with services.metrics.streams.track_inprogress():
            await _Viewer(websocket, services, lobby, may_come_in=caller is not None).serve()


class _Viewer:
    """One connection: one task reads and keeps the newest request, another answers.

    lobby: counts it as a connection without a key until the key has come.
    """

    def __init__(self, websocket: WebSocket, services: Deps, lobby: contextlib.ExitStack, *, may_come_in: bool) -> None:
        self._websocket = websocket
        self._services = services
        self._lobby = lobby
        self._address = address_of(websocket)
        self._caller: Callable[[], Caller] | None = self._caller_of_headers if may_come_in else None
        self._newest: dict[str, Any] | Problem | None = None
        self._arrived = asyncio.Event()

    async def serve(self) -> None:
        """Serve until one side closes the connection."""
        tasks = [asyncio.create_task(self._read()), asyncio.create_task(self._answer_all())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, _HangUp):
                await self._hang_up(result)
            elif isinstance(result, Exception) and not isinstance(result, GONE):
                raise result

    async def _read(self) -> None:
        while True:
            message = await self._receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            if text is None:
                raise _HangUp(NOT_TEXT, Problem(422, "A binary message is not a request.", remedy=API_REMEDY))
            if len(text) > MAX_MESSAGE:
                detail = f"The message has {len(text)} characters, more than {MAX_MESSAGE}."
                raise _HangUp(TOO_LARGE, Problem(413, detail, remedy=API_REMEDY))
            document = document_of(text)
            if self._caller is None or (isinstance(document, dict) and AUTHORIZE in document):
                self._caller = self._authorized(document)
                self._lobby.close()
            else:
                self._newest = document
                self._arrived.set()

    async def _receive(self) -> Message:
        """The viewer's next message. The key must come within AUTHORIZE_TIMEOUT_S."""
        try:
            async with asyncio.timeout(AUTHORIZE_TIMEOUT_S if self._caller is None else None):
                return await self._websocket.receive()
        except TimeoutError:
            raise _HangUp(NOT_ALLOWED, key_missing(self._address)) from None

    async def _answer_all(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            document, start = self._newest, time.perf_counter()
            assert document is not None
            try:
                answer = await self._answer(document, start)
            except Exception as error:
                await self._send_problem(error, document.get("id") if isinstance(document, dict) else None)
            else:
                async with asyncio.timeout(SEND_TIMEOUT_S):
                    await self._websocket.send_bytes(answer)

    async def _answer(self, document: dict[str, Any] | Problem, start: float) -> bytes:
        """The message with the view."""
        if isinstance(document, Problem):
            raise document
        message = message_of(document)
        caller = self._known_caller()
        self._services.limiter.admit(caller.key_id or caller.address)
        with traces.span("view of /stream", traces.NEW, kind=SpanKind.SERVER):
            shown = await find_shown(self._services, caller, message.scene)
            request = request_of(message, shown, self._services.settings)
            shown, answer = await answer_to(self._services, caller, request, shown)
            if answer.head.error is not None:
                raise problem_of_reply(answer.head.error)
        return packed(message, shown, answer, (time.perf_counter() - start) * 1e3)

    async def _send_problem(self, error: Exception, message_id: object) -> None:
        """Send the error; close the connection of a caller without a valid key."""
        problem = problem_of(error)
        if problem is None:
            logger.error("a fault in a stream: %s", type(error).__name__, exc_info=error)
            problem = fault()
        if problem.status == 401:
            raise _HangUp(NOT_ALLOWED, problem)
        if isinstance(problem, AccessRefusal):
            await self._services.audit.refused(problem)
        document = {**problem.document(), "id": message_id}
        async with asyncio.timeout(SEND_TIMEOUT_S):
            await self._websocket.send_text(json.dumps(document))

    async def _hang_up(self, reason: _HangUp) -> None:
        if isinstance(reason.problem, AccessRefusal):
            await self._services.audit.refused(reason.problem)
        with contextlib.suppress(*GONE):
            async with asyncio.timeout(SEND_TIMEOUT_S):
                await self._websocket.send_text(json.dumps(reason.problem.document()))
                await self._websocket.close(reason.code)

    def _known_caller(self) -> Caller:
        """The connection's caller, checked for each view, so that revoking a key ends its streams."""
        assert self._caller is not None
        caller = self._caller()
        caller.require(KeyScope.VIEW)
        return caller

    def _caller_of_headers(self) -> Caller:
        caller = self._services.access.caller(self._websocket.headers, self._address)
        if caller is None:
            raise key_missing(self._address)
        return caller

    def _authorized(self, document: dict[str, Any] | Problem) -> Callable[[], Caller]:
        """The connection's caller, by the key in a message."""
        key = document.get(AUTHORIZE) if isinstance(document, dict) else None
        if not isinstance(key, str):
            raise _HangUp(NOT_ALLOWED, key_missing(self._address))

        def caller() -> Caller:
            return self._services.access.caller_of_key(key, self._address)

        try:
            caller().require(KeyScope.VIEW)
        except Problem as problem:
            raise _HangUp(NOT_ALLOWED, problem) from None
        return caller


def document_of(text: str) -> dict[str, Any] | Problem:
    """The JSON object of a message, or the problem if it is not one."""
    try:
        document = from_json(
            text
        )  # stricter than json: limits depth, and refuses lone surrogates, which cannot be sent back
    except ValueError:
        document = None
    if not isinstance(document, dict):
        return Problem(400, "The message is not a JSON object.", remedy=API_REMEDY)
    return document


def message_of(document: dict[str, Any]) -> StreamMessage:
    """Parse a request.

    Raises:
        Problem: 422: the document is not a valid request; names the field.
    """
    try:
        return StreamMessage.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        detail = f"{first['msg']} (given: {str(first['input'])[:80]!r})."
        raise Problem(422, detail, field=str(first["loc"][0]), remedy=API_REMEDY) from None


def packed(message: StreamMessage, shown: Shown, answer: Answer, total_ms: float) -> bytes:
    """A view as one binary message."""
    head = StreamHead(
        id=message.id,
        scene=shown.scene_id,
        state=shown.state,
        t=answer.head.t,
        iteration=answer.head.iteration,
        unseen=round(answer.head.unseen, 3),
        detail=round(answer.head.detail, 3),
        warnings=answer.head.warnings,
        media_type=answer.head.media_type,
        depth_range_mm=answer.head.depth_range_mm,
        render_ms=answer.head.render_ms,
        total_ms=total_ms,
        camera=answer.head.camera,
    )
    text = head.model_dump_json().encode()
    return len(text).to_bytes(LENGTH_BYTES, "big") + text + answer.body
