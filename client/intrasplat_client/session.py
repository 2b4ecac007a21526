"""Calls to one service, repeated while it is busy or the connection is lost."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TypeAlias, TypeVar

import httpx

from intrasplat_client.connection import Answer, Call, Connection
from intrasplat_client.errors import (
    IntrasplatError,
    Refusal,
    ServiceFault,
    ServiceUnavailable,
    Unreachable,
    error_of_answer,
)

DEFAULT_PATIENCE_S = 30.0
FIRST_PAUSE_S = 0.25
MAX_PAUSE_S = 8.0
NEVER_CONNECTED = (httpx.ConnectError, httpx.ConnectTimeout, httpx.UnsupportedProtocol, httpx.ProxyError)

Content = TypeVar("Content")
Parsed = TypeVar("Parsed")
OnWait: TypeAlias = Callable[[IntrasplatError, float], None]
"""Called with each failure after which a call is repeated, and the seconds that it waits before that."""


class Patience:
    """Pauses that double until their sum since the last success exceeds `total_s`."""

    def __init__(self, total_s: float) -> None:
        self._total_s = total_s
        self.renew()

    def renew(self) -> None:
        """Start again after a success."""
        self._left_s, self._next_s = self._total_s, FIRST_PAUSE_S

    def pause_s(self, failure: IntrasplatError) -> float:
        """How long to wait after a failure, at least as long as the service asked for.

        Raises:
            IntrasplatError: the failure itself, once patience is used up.
        """
        asked_s = failure.retry_after_s if isinstance(failure, ServiceUnavailable) else None
        pause_s = max(self._next_s, asked_s or 0.0)
        if pause_s > self._left_s:
            raise failure
        self._left_s -= pause_s
        self._next_s = min(2 * self._next_s, MAX_PAUSE_S)
        return pause_s


class Session:
    """One service over one connection.

    url: the service's address in messages.
    patience_s: how long, in total, a call waits while the service is busy or the connection is lost.
    """

    def __init__(self, connection: Connection, url: str, patience_s: float, on_wait: OnWait | None = None) -> None:
        self._connection = connection
        self._url = url
        self._patience_s = patience_s
        self._on_wait = on_wait
        self.sleep = connection.sleep

    def patience(self) -> Patience:
        """A new Patience, for attempts that the caller repeats itself."""
        return Patience(self._patience_s)

    async def wait(self, patience: Patience, failure: IntrasplatError) -> None:
        """Wait after a failure; raises it once patience is used up."""
        pause_s = patience.pause_s(failure)
        if self._on_wait is not None:
            self._on_wait(failure, pause_s)
        await self.sleep(pause_s)

    async def send(self, call: Call) -> httpx.Response:
        """Send a call once. Returns its answer, whatever the status.

        Raises:
            Unreachable: the connection failed.
        """
        try:
            return await self._connection.send(call)
        except httpx.TransportError as error:
            raise self._unreachable(error) from error

    @asynccontextmanager
    async def stream(self, call: Call) -> AsyncIterator[Answer]:
        """Send a call and read its answer line by line; raises Unreachable, also while it is read."""
        try:
            async with self._connection.stream(call) as answer:
                yield answer
        except httpx.TransportError as error:
            raise self._unreachable(error) from error

    async def request(self, call: Call, *, patience_s: float | None = None, is_there: bool = False) -> httpx.Response:
        """Send a call; repeat it while the service is busy (429, 503) or the connection is lost. Returns its success.

        patience_s: replaces the session's.
        is_there: the service has answered before, so a refused connection is tried again.

        Raises:
            Unreachable: nothing listens there; or the connection was lost and patience is used up, or the call may not
                be repeated.
            ServiceUnavailable, RateLimited: the service stayed busy.
            RequestRefused, ServiceFault: it answered with another error.
        """
        patience = self.patience() if patience_s is None else Patience(patience_s)
        while True:
            failure: IntrasplatError
            try:
                response = await self.send(call)
            except Unreachable as error:
                if (error.is_nobody_there and not is_there) or not call.is_repeatable:
                    raise
                failure = error
            else:
                if response.is_success or response.status_code == httpx.codes.NOT_MODIFIED:
                    return response
                failure = error_of(response)
                # An answer that names a job has accepted the clip: do not send it again.
                if not isinstance(failure, ServiceUnavailable) or failure.job_id is not None:
                    raise failure
            is_there = True
            await self.wait(patience, failure)

    def _unreachable(self, error: httpx.TransportError) -> Unreachable:
        return Unreachable(self._url, error, isinstance(error, NEVER_CONNECTED))


def error_of(response: httpx.Response) -> IntrasplatError:
    """The exception for a response that is not a success."""
    return error_of_answer(response.status_code, response.headers, response.content)


def parsed(response: httpx.Response, parse: Callable[[Content], Parsed], content: Content) -> Parsed:
    """The result of `parse` on the content of a successful response.

    Raises:
        ServiceFault: it cannot be parsed, so another server or another version answered.
    """
    try:
        return parse(content)
    except (ValueError, KeyError, TypeError) as error:
        problem = "What answers there is not an intrasplat service, or is one of another version."
        raise ServiceFault(Refusal(response.status_code, problem, remedy="Correct the address.")) from error
