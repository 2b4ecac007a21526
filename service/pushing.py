"""Hands the bytes that a caller pushes to the process that follows its feed, in order and as fast as it takes them."""

from __future__ import annotations

import asyncio
import contextlib
import time
import uuid
from collections.abc import AsyncGenerator, Callable, Coroutine
from types import TracebackType
from typing import Any

from starlette.concurrency import run_in_threadpool

from contract.wire.rendering import MAX_PUSH_BYTES, PUSH_REPLACED, PushRequest, ReplyError
from intrasplat.errors import UnavailableError
from intrasplat.live.spec import TS_SYNC
from service.deps import Deps
from service.problems import Problem
from service.renders import problem_of_reply

PATIENCE_S = 60.0
"""How long a push waits for a process that follows the feed: when it begins, and when another takes its place."""
RETRY_S = 0.2
END_TIMEOUT_S = 2.0


class SilentError(Exception):
    """A sender sends nothing."""


async def hand_on(
    pieces: AsyncGenerator[bytes], take: Callable[[bytes], Coroutine[Any, Any, None]], silence_s: float | None = None
) -> None:
    """Let `take` have each piece in turn. The next one is waited for meanwhile, so that an error of `pieces`, as when
    the caller has gone, ends a `take` that waits.

    Raises:
        SilentError: no piece came within silence_s after the last one was taken.
    """
    coming = asyncio.ensure_future(anext(pieces, None))
    taking: asyncio.Future[None] | None = None
    try:
        while True:
            if not (await asyncio.wait({coming}, timeout=silence_s))[0]:
                raise SilentError
            if (piece := coming.result()) is None:
                return
            coming, taking = asyncio.ensure_future(anext(pieces, None)), asyncio.ensure_future(take(piece))
            await asyncio.wait({coming, taking}, return_when=asyncio.FIRST_COMPLETED)
            if coming.done() and (error := coming.exception()) is not None:
                raise error
            await taking
    finally:
        unfinished = [each for each in (coming, taking) if each is not None]
        for each in unfinished:
            each.cancel()
        await asyncio.gather(*unfinished, return_exceptions=True)


class Push:
    """A context manager: one connection that pushes. bytes: how many the feed has taken."""

    def __init__(self, services: Deps, feed_id: str, *, pictures: bool) -> None:
        self.bytes = 0
        self._services = services
        self._request = PushRequest(scene_id=feed_id, push_id=uuid.uuid4().hex, pictures=pictures)
        self._can_be_joined = pictures
        self._has_begun = False

    async def __aenter__(self) -> Push:
        self._services.metrics.pushes.inc()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._services.metrics.pushes.dec()
        if not self._has_begun or (isinstance(error, Problem) and error.field == PUSH_REPLACED):
            return
        last = self._request.model_copy(update={"is_last": True})
        with contextlib.suppress(UnavailableError, TimeoutError):  # a feed without a process has nothing to end
            async with asyncio.timeout(END_TIMEOUT_S):
                await self._services.renderer.ask(last, body=b"")

    async def send(self, piece: bytes) -> None:
        """Return when the feed has taken the bytes; of pictures, all of one.

        Raises:
            Problem: 404: the feed has ended. 409: another push has taken the place of this one. 422: it cannot be used.
            UnavailableError: nobody follows the feed, or another process does that cannot join this stream.
        """
        self._has_begun = True
        if not self.bytes and piece.startswith(TS_SYNC):
            self._can_be_joined = True
        start, until_s = 0, time.monotonic() + PATIENCE_S
        while start < len(piece):
            body = piece[start : start + MAX_PUSH_BYTES]
            if await self._is_taken(body, until_s):
                start, until_s = start + len(body), time.monotonic() + PATIENCE_S
            elif self._request.pictures:
                start = 0

    async def _is_taken(self, body: bytes, until_s: float) -> bool:
        """Whether the feed has taken the bytes. False: another push goes on in place of this one from now."""
        try:
            answer = await self._services.renderer.ask(self._request, body=body)
            error = answer.head.error
            if error is None:
                self.bytes += len(body)
                return True
            if error.kind not in ("busy", "not-yet"):
                raise _problem_of(error)
            if not self._may_wait(until_s):
                raise problem_of_reply(error)
        except UnavailableError:
            if not self._may_wait(until_s):
                raise
        await run_in_threadpool(self._check_is_open)
        await asyncio.sleep(RETRY_S)
        self._request = self._request.model_copy(update={"push_id": uuid.uuid4().hex})
        return False

    def _may_wait(self, until_s: float) -> bool:
        return time.monotonic() < until_s and (self._can_be_joined or not self.bytes)

    def _check_is_open(self) -> None:
        if self._services.feeds.record(self._request.scene_id) is None:
            remedy = "Open another: POST /feeds."
            raise Problem(404, "The feed has ended.", field="feed_id", remedy=remedy)


def _problem_of(error: ReplyError) -> Problem:
    if error.kind == "input" and error.field == PUSH_REPLACED:
        return Problem(
            409, error.problem, field=PUSH_REPLACED, remedy=error.remedy or "Push over one connection at a time."
        )
    return problem_of_reply(error)
