"""One request and its answer, over a blocking or an asynchronous connection.

The modules that import this one are written once, as coroutines. BlockingConnection has the same three methods as
AwaitedConnection, but they never suspend, so `run` gets the result of such a coroutine in one step.
"""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Generator, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import anyio
import httpx

from intrasplat_client.errors import UNREACHABLE_REMEDY, InputError

DEFAULT_URL = "http://127.0.0.1:8765"
CONNECT_TIMEOUT_S = 5.0
ANSWER_TIMEOUT_S = 60.0
"""Timeout of one read or write without any progress; an upload as a whole may take longer."""
HEARTBEAT_TIMEOUT_S = 45.0
"""Timeout of an event stream: three heartbeats."""

EVENT_TIMEOUT = httpx.Timeout(HEARTBEAT_TIMEOUT_S, connect=CONNECT_TIMEOUT_S)

Result = TypeVar("Result")


@dataclass(frozen=True)
class Body:
    """What a request sends: its length, its bytes piece by piece, and a callback that gets the bytes sent so far."""

    length_bytes: int
    pieces: Callable[[], Iterator[bytes]]
    on_sent: Callable[[int], None]


@dataclass(frozen=True)
class Call:
    """A request. is_repeatable: it may be sent again if its answer was lost."""

    method: str
    path: str
    query: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    json: Any = None
    body: Body | None = None
    is_repeatable: bool = False

    def arguments(self) -> dict[str, Any]:
        """Arguments of request() and stream() of an httpx client, except the body."""
        length = {} if self.body is None else {"Content-Length": str(self.body.length_bytes)}
        headers = {**self.headers, **length}
        return {"method": self.method, "url": self.path, "params": self.query, "headers": headers, "json": self.json}


@dataclass(frozen=True)
class Answer:
    """An answer whose lines arrive one by one; `read` fetches the rest of it into `response` instead."""

    response: httpx.Response
    lines: AsyncIterator[str]
    read: Callable[[], Coroutine[Any, Any, object]]


class Connection(Protocol):
    """The network operations of a client. send and stream raise httpx.TransportError if the connection fails."""

    async def send(self, call: Call) -> httpx.Response:
        """Send a call. Returns its answer, completely read."""

    def stream(self, call: Call) -> AbstractAsyncContextManager[Answer]:
        """Send a call. The answer stays open during the context."""

    async def sleep(self, seconds: float) -> None:
        """Wait."""


class BlockingConnection:
    """A Connection whose coroutines block and never suspend."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http

    async def send(self, call: Call) -> httpx.Response:
        content = None if call.body is None else _sent(call.body)
        return self._http.request(**call.arguments(), content=content)

    @asynccontextmanager
    async def stream(self, call: Call) -> AsyncIterator[Answer]:
        with self._http.stream(**call.arguments(), timeout=EVENT_TIMEOUT) as response:

            async def lines() -> AsyncIterator[str]:
                for line in response.iter_lines():
                    yield line

            async def read() -> bytes:
                return response.read()

            yield Answer(response, lines(), read)

    async def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


class AwaitedConnection:
    """A Connection whose coroutines suspend while they wait."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http

    async def send(self, call: Call) -> httpx.Response:
        content = None if call.body is None else _sent_by_thread(call.body)
        return await self._http.request(**call.arguments(), content=content)

    @asynccontextmanager
    async def stream(self, call: Call) -> AsyncIterator[Answer]:
        async with self._http.stream(**call.arguments(), timeout=EVENT_TIMEOUT) as response:
            yield Answer(response, response.aiter_lines(), response.aread)

    async def sleep(self, seconds: float) -> None:
        await anyio.sleep(seconds)


def run(coroutine: Coroutine[Any, Any, Result]) -> Result:
    """The result of a coroutine that only waits on a BlockingConnection, and so ends without ever suspending."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        result: Result = end.value
        return result
    coroutine.close()
    raise RuntimeError("A coroutine of the blocking client was suspended.")


def iterate(items: AsyncGenerator[Result, None]) -> Generator[Result, None, None]:
    """The items of an asynchronous generator that only waits on a BlockingConnection."""
    try:
        while True:
            try:
                item = run(items.__anext__())
            except StopAsyncIteration:
                return
            yield item
    finally:
        run(items.aclose())


def _sent(body: Body) -> Iterator[bytes]:
    sent_bytes = 0
    for piece in body.pieces():
        yield piece
        sent_bytes += len(piece)
        body.on_sent(sent_bytes)


async def _sent_by_thread(body: Body) -> AsyncIterator[bytes]:
    """The pieces, read by a thread because a disk may be slow."""
    pieces, sent_bytes = body.pieces(), 0
    while (piece := await anyio.to_thread.run_sync(next, pieces, None)) is not None:
        yield piece
        sent_bytes += len(piece)
        body.on_sent(sent_bytes)


def http_settings(url: str, api_key: str | None) -> dict[str, Any]:
    """Arguments of httpx.Client and httpx.AsyncClient.

    Raises:
        InputError: the url cannot be read.
    """
    try:
        base_url = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise InputError("url", f"{url[:80]!r} is not an address ({error}).", UNREACHABLE_REMEDY) from error
    timeout = httpx.Timeout(ANSWER_TIMEOUT_S, connect=CONNECT_TIMEOUT_S)
    return {"base_url": base_url, "timeout": timeout, "headers": authorization(api_key)}


def authorization(api_key: str | None) -> dict[str, str]:
    """The header that carries the API key. A key that was read from a file may end with a line break."""
    return {} if api_key is None else {"Authorization": f"Bearer {api_key.strip()}"}
