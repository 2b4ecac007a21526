"""WS /stream: many views over one connection, each for the newest request. docs/stream.md describes the messages.

While a feed's worker is away, a request with `follow` brings the problem each second.

While a view is rendered and sent, only the newest incoming message is kept. So a viewer that sends requests faster than
they are answered skips views, and a viewer that does not read gets one view and then none.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import time
from typing import Any

from fastapi import APIRouter, WebSocket
from opentelemetry.trace import SpanKind
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from contract.access.keys import KeyScope
from contract.runtime import traces
from contract.wire.job import JobState
from contract.wire.rendering import PictureCamera
from intrasplat.live.state import FeedState
from intrasplat.live.times import LIVE
from intrasplat.notices import Notice
from service.access import AccessRefusal
from service.connection import Answer
from service.deps import Deps, EarlyCaller, Services
from service.moments import moment_text
from service.problems import MESSAGE_REMEDY, Problem, fault, problem_of
from service.query import check_query, no_such_parameter
from service.renders import RenderQuery, answer_to, problem_of_reply, request_of
from service.shown import Shown, find_shown
from service.sockets import GONE, NOT_ALLOWED, NOT_TEXT, TOO_LARGE, Entrance, HangUpError, document_of

router = APIRouter()

LENGTH_BYTES = 4
MAX_MESSAGE = 16 * 1024
"""Maximum characters of a message; a request has some hundred."""
AWAY_RETRY_S = 1.0
"""When a feed that is followed is asked again after an error."""

logger = logging.getLogger("intrasplat.service")


class StreamMessage(RenderQuery):
    """A view that is asked for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str | int | None = Field(default=None, description="comes back with the answer")
    confirm: bool = Field(default=False, description="answer only that the scene is there")
    follow: bool = Field(default=False, description="of t=live of a feed: send every newer moment, too")


class StreamHead(BaseModel):
    """What a view shows; the fields are those of /render's headers."""

    id: str | int | None
    scene: str
    state: JobState | FeedState
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
    captured_at: str | None = Field(default=None, exclude_if=lambda text: text is None)
    """Of a live feed, as the next two: when the pair of the moment arrived, RFC 3339."""
    age_s: float | None = Field(default=None, exclude_if=lambda seconds: seconds is None)
    source_s: float | None = Field(default=None, exclude_if=lambda seconds: seconds is None)


@router.websocket("/stream")
async def stream(websocket: WebSocket, services: Services, caller: EarlyCaller) -> None:
    """Views one after the other; see docs/stream.md."""
    check_query(websocket)
    if caller is not None:
        caller.require(KeyScope.VIEW)  # refused before the handshake
    with contextlib.ExitStack() as lobby:
        if caller is None:
            lobby.enter_context(services.access.stranger())
        await websocket.accept()
        with services.metrics.streams.track_inprogress():
            entrance = Entrance(websocket, services, lobby, KeyScope.VIEW, may_come_in=caller is not None)
            await _Viewer(entrance, services).serve()


class _Viewer:
    """One connection: one task reads and keeps the newest request, another answers."""

    def __init__(self, entrance: Entrance, services: Deps) -> None:
        self._entrance = entrance
        self._services = services
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
            if isinstance(result, HangUpError):
                await self._entrance.hang_up(result)
            elif isinstance(result, Exception) and not isinstance(result, GONE):
                raise result

    async def _read(self) -> None:
        while True:
            message = await self._entrance.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            if text is None:
                raise HangUpError(NOT_TEXT, Problem(422, "A binary message is not a request.", remedy=MESSAGE_REMEDY))
            if len(text) > MAX_MESSAGE:
                detail = f"The message has {len(text)} characters, more than {MAX_MESSAGE}."
                raise HangUpError(TOO_LARGE, Problem(413, detail, remedy=MESSAGE_REMEDY))
            document = document_of(text)
            if self._entrance.is_key(document):
                self._entrance.authorize(document)
            else:
                self._newest = document
                self._arrived.set()

    async def _answer_all(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            document, start = self._newest, time.perf_counter()
            assert document is not None
            shown = await self._answer(document, start)
            if shown is not None:
                await self._follow(*shown)

    async def _answer(self, document: dict[str, Any] | Problem, start: float) -> tuple[StreamMessage, float] | None:
        """Send the view that is asked for. Returns the request and its second if newer moments are to follow."""
        try:
            if isinstance(document, Problem):
                raise document
            message = message_of(document)
            if message.confirm:
                await self._confirm(message)
                return None
            shown, answer = await self._view(message)
        except Exception as error:
            message_id = document.get("id") if isinstance(document, dict) else None
            problem = await self._send_problem(error, message_id)
            does_follow = isinstance(document, dict) and document.get("follow") is True and problem.status in (429, 503)
            return (message_of(document), -math.inf) if does_follow and isinstance(document, dict) else None
        await self._entrance.send(packed(message, shown, answer, (time.perf_counter() - start) * 1e3))
        return (message, answer.head.feed.source_s) if message.follow and answer.head.feed is not None else None

    async def _confirm(self, message: StreamMessage) -> None:
        """Send that the scene or feed is there. Raises Problem: it is not, or the caller may not see it."""
        caller = self._entrance.caller()
        self._services.limiter.admit(caller.key_id or caller.address)
        shown = await find_shown(self._services, caller, message.scene, with_feeds=True)
        await self._entrance.send(json.dumps({"id": message.id, "state": shown.state}))

    async def _view(self, message: StreamMessage, newer_than_s: float | None = None) -> tuple[Shown, Answer]:
        """The worker's answer.

        Raises:
            Problem: it is an error, or the caller may not have it.
        """
        caller = self._entrance.caller()
        self._services.limiter.admit(caller.key_id or caller.address)
        with traces.span("view of /stream", traces.NEW, kind=SpanKind.SERVER):
            shown = await find_shown(self._services, caller, message.scene, with_feeds=True)
            request = request_of(message, shown, self._services.settings)
            if message.follow and request.moment != LIVE:
                raise Problem(422, "Only t=live of a feed can be followed.", field="follow", remedy="Leave it out.")
            if newer_than_s is not None:
                request = request.model_copy(update={"newer_than_s": newer_than_s})
            shown, answer = await answer_to(self._services, caller, request, shown)
            if answer.head.error is not None:
                raise problem_of_reply(answer.head.error)
        return shown, answer

    async def _follow(self, message: StreamMessage, source_s: float) -> None:
        """Send newer moments than this second of the source, until another request has come or the feed has ended."""
        following = asyncio.create_task(self._send_newer(message, source_s))
        asked = asyncio.create_task(self._arrived.wait())
        try:
            await asyncio.wait({following, asked}, return_when=asyncio.FIRST_COMPLETED)
            if following.done():
                following.result()
        finally:
            for task in (following, asked):
                task.cancel()
            await asyncio.gather(following, asked, return_exceptions=True)

    async def _send_newer(self, message: StreamMessage, source_s: float) -> None:
        assert message.scene is not None
        while True:
            start = time.perf_counter()

            async def ask(after_s: float) -> tuple[Shown, Answer]:
                nonlocal start
                start = time.perf_counter()
                return await self._view(message, None if after_s == -math.inf else after_s)

            try:
                shown, answer = await self._services.followed.newer(message.scene, source_s, ask)
            except Exception as error:
                problem = await self._send_problem(error, message.id)
                if problem.status not in (429, 503):
                    return
                await asyncio.sleep(AWAY_RETRY_S)
                continue
            if answer.head.feed is None:
                return
            source_s = answer.head.feed.source_s
            await self._entrance.send(packed(message, shown, answer, (time.perf_counter() - start) * 1e3))

    async def _send_problem(self, error: Exception, message_id: object) -> Problem:
        """Send the error; close the connection of a caller without a valid key."""
        problem = problem_of(error)
        if problem is None:
            logger.error("a fault in a stream: %s", type(error).__name__, exc_info=error)
            problem = fault()
        if problem.status == 401:
            raise HangUpError(NOT_ALLOWED, problem)
        if isinstance(problem, AccessRefusal):
            await self._services.audit.refused(problem)
        await self._entrance.send(json.dumps({**problem.document(), "id": message_id}))
        return problem


def message_of(document: dict[str, Any]) -> StreamMessage:
    """Parse a request.

    Raises:
        Problem: 422: the document is not a valid request; names the field.
    """
    try:
        return StreamMessage.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "extra_forbidden":
            raise no_such_parameter(str(first["loc"][0]), StreamMessage.model_fields) from None
        detail = f"{first['msg']} (given: {str(first['input'])[:80]!r})."
        raise Problem(422, detail, field=str(first["loc"][0]), remedy=MESSAGE_REMEDY) from None


def packed(message: StreamMessage, shown: Shown, answer: Answer, total_ms: float) -> bytes:
    """A view as one binary message."""
    feed = answer.head.feed
    of_feed: dict[str, Any] = {}
    if feed is not None:
        of_feed = {"captured_at": moment_text(feed.captured_at_s), "age_s": feed.age_s, "source_s": feed.source_s}
    head = StreamHead(
        id=message.id,
        scene=shown.scene_id,
        state=shown.state if feed is None else feed.state,
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
        **of_feed,
    )
    text = head.model_dump_json().encode()
    return len(text).to_bytes(LENGTH_BYTES, "big") + text + answer.body
