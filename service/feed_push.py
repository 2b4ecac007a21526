"""PUT /feeds/{id}/video and WS /feeds/{id}/pictures: a caller sends the video of a feed that has no source.

The body of PUT is a stream without an end of its own: fragmented mp4, MPEG-TS or Matroska. It has no limit of size, but
one of silence.

Over the WebSocket a browser sends pictures of both eyes, JPEG or WebP. Its binary messages are one stream of bytes, cut
anywhere into messages of at most 64 KiB: for each picture its time, s (float64, little-endian; NaN: none), its length
(uint32, little-endian) and its bytes. The answers are JSON texts {"taken": N}: N pictures have come and been handed on.
A sender with at most two pictures unanswered keeps the delay short. With keys, the first message of a browser is
{"authorize": KEY}. An error is a problem document, after which the connection is closed (1003, 1007, 1008 or 1011).
"""

from __future__ import annotations

import contextlib
import itertools
import json
import time
from collections.abc import AsyncGenerator, Callable, Iterator

from fastapi import APIRouter, Request, WebSocket, WebSocketDisconnect
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from contract.wire.feeds import FeedRecord
from intrasplat.errors import UnavailableError
from intrasplat.live.spec import PICTURE_HEADER, STREAM_HEAD_BYTES, stream_format
from service.access import Caller, key_missing
from service.bodies import VIDEO_BODY
from service.deps import AnyCaller, Deps, EarlyCaller, Services, address_of, owned_feed
from service.problems import Problem, problem_of
from service.pushing import Push, SilentError, hand_on
from service.query import check_query
from service.sockets import FAULT, GONE, MALFORMED, NOT_ALLOWED, NOT_TEXT, Entrance, HangUpError, document_of

router = APIRouter(prefix="/feeds", tags=["feeds"])

KEY_PERIOD_S = 2.0
"""How often the key of a push is checked again."""
MAX_PICTURE_BYTES = 8 * 2**20
GOING_AWAY = 1001
FRAMING_REMEDY = "Send for each picture its time (float64), its length (uint32), both little-endian, and its bytes."
VIDEO_REMEDY = "Send fragmented mp4, MPEG-TS or Matroska."


class Pushed(BaseModel):
    """A push that its sender has ended."""

    bytes: int = Field(description="bytes that the feed has taken")


@router.put("/{feed_id}/video", operation_id="push_video", openapi_extra=VIDEO_BODY)
async def push_video(feed_id: str, request: Request, services: Services, caller: AnyCaller) -> Pushed:
    """Push the video of a feed without a source, as it comes: fragmented mp4, MPEG-TS or Matroska.

    422: the first bytes are of none of them. One connection at a time pushes a feed; a new one takes the place of the
    one before. Bytes are read as fast as the feed takes them.
    """
    await run_in_threadpool(_begin, services, caller, feed_id)
    address = address_of(request)
    still = _StillAllowed(lambda: services.access.caller(request.headers, address) or _no_key(address))
    try:
        async with Push(services, feed_id, pictures=False) as push:

            async def take(piece: bytes) -> None:
                still.check()
                await push.send(piece)

            await hand_on(_of_video(services.intake.body(request)), take)
    except ClientDisconnect:
        raise Problem(400, "The connection was closed.", field="body", remedy="Connect again.") from None
    return Pushed(bytes=push.bytes)


async def _of_video(pieces: AsyncGenerator[bytes]) -> AsyncGenerator[bytes]:
    """The pieces, once the first bytes tell a format that is read. Raises Problem 422 if they tell none."""
    head = b""
    async for piece in pieces:
        head += piece
        if stream_format(head) is not None:
            yield head
            break
        if len(head) >= STREAM_HEAD_BYTES:
            raise _no_video()
    else:
        if head:
            raise _no_video()
    async for piece in pieces:
        yield piece


def _no_video() -> Problem:
    return Problem(422, "The first bytes are not those of a video stream.", field="body", remedy=VIDEO_REMEDY)


@router.websocket("/{feed_id}/pictures")
async def push_pictures(feed_id: str, websocket: WebSocket, services: Services, caller: EarlyCaller) -> None:
    """Pictures of both eyes, one after the other; see the head of this file."""
    check_query(websocket)
    if caller is not None:
        await run_in_threadpool(_pushed_feed, services, caller, feed_id)  # refused before the handshake
    with contextlib.ExitStack() as lobby:
        if caller is None:
            lobby.enter_context(services.access.stranger())
        await websocket.accept()
        entrance = Entrance(websocket, services, lobby, KeyScope.FEEDS, may_come_in=caller is not None)
        try:
            with contextlib.suppress(*GONE):
                await _take_pictures(services, feed_id, entrance)
        except HangUpError as reason:
            await entrance.hang_up(reason)


async def _take_pictures(services: Deps, feed_id: str, entrance: Entrance) -> None:
    """Hand pictures on until one side closes the connection.

    Raises:
        HangUpError: why this side does.
    """
    while not entrance.is_open:
        message = await entrance.receive()
        if message["type"] == "websocket.disconnect":
            return
        entrance.authorize(document_of(message.get("text") or ""))
    silence_s = services.settings.upload_silence_s
    try:
        await run_in_threadpool(_begin, services, entrance.caller(), feed_id)
        async with Push(services, feed_id, pictures=True) as push:
            still, pictures, taken = _StillAllowed(entrance.caller), PictureStream(), itertools.count(1)

            async def take(piece: bytes) -> None:
                still.check()
                for picture in pictures.add(piece):
                    await push.send(picture)
                    await entrance.send(json.dumps({"taken": next(taken)}))

            await hand_on(_pieces(entrance), take, silence_s)
    except SilentError:
        problem = Problem(408, f"Nothing came in {silence_s:g} s.", remedy="Connect again.")
        raise HangUpError(NOT_ALLOWED, problem) from None
    except (Problem, UnavailableError) as error:
        found = problem_of(error)
        assert found is not None
        raise HangUpError(NOT_ALLOWED if found.status < 500 else FAULT, found) from None


async def _pieces(entrance: Entrance) -> AsyncGenerator[bytes]:
    """The binary messages. Raises WebSocketDisconnect at the end of the connection."""
    while True:
        message = await entrance.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", GOING_AWAY))
        piece: bytes | None = message.get("bytes")
        if piece is not None:
            yield piece
            continue
        document = document_of(message.get("text") or "")
        if not entrance.is_key(document):
            raise HangUpError(NOT_TEXT, Problem(422, "A text message is no picture.", remedy=FRAMING_REMEDY))
        entrance.authorize(document)


class PictureStream:
    """Finds the pictures in a stream of bytes."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def add(self, piece: bytes) -> Iterator[bytes]:
        """The pictures that end in the next piece, each with its header.

        Raises:
            HangUpError: a length is 0 or larger than MAX_PICTURE_BYTES.
        """
        self._bytes += piece
        while len(self._bytes) >= PICTURE_HEADER.size:
            _, length = PICTURE_HEADER.unpack_from(self._bytes)
            if not 0 < length <= MAX_PICTURE_BYTES:
                detail = f"A picture has {length} bytes; the limit is {MAX_PICTURE_BYTES}."
                raise HangUpError(MALFORMED, Problem(422, detail, remedy=FRAMING_REMEDY))
            end = PICTURE_HEADER.size + length
            if len(self._bytes) < end:
                return
            yield bytes(self._bytes[:end])
            del self._bytes[:end]


class _StillAllowed:
    """Ends a push when its key was revoked, or has lost the scope."""

    def __init__(self, caller: Callable[[], Caller]) -> None:
        self._caller = caller
        self._next_s = 0.0

    def check(self) -> None:
        """Return if the caller may still push; looks every KEY_PERIOD_S. Raises Problem 401 or 403 otherwise."""
        if time.monotonic() >= self._next_s:
            self._caller().require(KeyScope.FEEDS)
            self._next_s = time.monotonic() + KEY_PERIOD_S


def _begin(services: Deps, caller: Caller, feed_id: str) -> None:
    """Record that a caller begins to push. Raises as _pushed_feed()."""
    _pushed_feed(services, caller, feed_id)
    services.audit.record(AuditAction.FEED_PUSHED, caller, feed_id)


def _pushed_feed(services: Deps, caller: Caller, feed_id: str) -> FeedRecord:
    """The caller's feed, which is pushed.

    Raises:
        Problem: 403: the key lacks the scope. 404: there is no such feed. 409: the feed has a source.
    """
    caller.require(KeyScope.FEEDS)
    record = owned_feed(services, caller, feed_id)
    if record.options.source is not None:
        remedy = "Open a feed without options.source to push its video."
        raise Problem(409, "The feed reads its source itself.", field="feed_id", remedy=remedy)
    return record


def _no_key(address: str) -> Caller:
    raise key_missing(address)
