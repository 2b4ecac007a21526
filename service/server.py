"""uvicorn with limits on connections and heads, problem documents for bad requests, and a quick shutdown."""

from __future__ import annotations

import asyncio
import json
import resource
from types import FrameType

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn._types import ASGISendEvent
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from contract.runtime.settings import Settings
from service.deps import Deps
from service.problems import MEDIA_TYPE, Problem

KEEP_ALIVE_S = 15
HEAD_S = 20.0
"""A connection is closed if the head of its first or next request takes longer. The check runs at this interval, so
closing may take twice as long."""
MAX_HEAD_BYTES = 32 * 1024
"""The limit of a request's line and headers together."""
MAX_CONNECTIONS = 1024
"""Maximum open connections, idle or not; service/request_log.py counts requests."""
BACKLOG = 128
"""Connections that wait to be accepted; asyncio accepts all of them at once. As many above the maximum get an answer to
retry later; further ones are closed, because asyncio logs, and keeps, each one for which it has no file descriptor."""
SPARE_FILES = 512
"""File descriptors for all but connections: files, queue, workers, and twice the backlog."""
GRACE_S = 10
"""How long requests in progress may take when the service ends; callers can resume an upload later."""

PING_PERIOD_S = 20.0
PING_TIMEOUT_S = 20.0
MAX_MESSAGE_BYTES = 64 * 1024
"""Maximum bytes of a message from a WebSocket's client, which sends times and poses."""
MAX_WAITING_MESSAGES = 16

UNREADABLE = Problem(400, "This is not a sound HTTP request.", remedy="See that its lengths and headers are right.")


class HttpConnection(H11Protocol):
    """Answers invalid HTTP with a problem document, and does not wait forever for a request."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        assert self.limit_concurrency is not None
        if len(self.connections) > self.limit_concurrency + BACKLOG:
            self.transport.close()
        self.loop.call_later(HEAD_S, self._end_if_silent, None)

    def send_400_response(self, msg: str) -> None:
        """Answer a request that h11 cannot parse."""
        headers = [("content-type", MEDIA_TYPE), ("connection", "close"), ("x-content-type-options", "nosniff")]
        body = json.dumps(UNREADABLE.document()).encode()
        headers.append(("content-length", str(len(body))))
        answer = (h11.Response(status_code=400, headers=headers), h11.Data(data=body), h11.EndOfMessage())
        for event in answer:
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def _end_if_silent(self, answered: object) -> None:
        """Close the connection if no request has started since the last check. answered: the last request then."""
        if self.transport.is_closing() or self.transport.get_protocol() is not self:  # upgraded to a WebSocket
            return
        last: RequestResponseCycle | None = self.cycle
        is_waiting = last is None or last.response_complete
        if is_waiting and last is answered:
            self.transport.close()
        else:
            self.loop.call_later(HEAD_S, self._end_if_silent, last if is_waiting else object())


class WebSocketConnection(WebSocketsSansIOProtocol):
    """Treats a handshake that was refused with a complete answer as answered; uvicorn logs it as a fault otherwise."""

    async def send(self, message: ASGISendEvent) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            self.handshake_complete = True


class Server(uvicorn.Server):
    """Ends the event streams as soon as a signal arrives, because they would end last by themselves."""

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        config = uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            http=HttpConnection,
            ws=WebSocketConnection,
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_keep_alive=KEEP_ALIVE_S,
            timeout_graceful_shutdown=GRACE_S,
            limit_concurrency=max_connections(),
            backlog=BACKLOG,
            h11_max_incomplete_event_size=MAX_HEAD_BYTES,
            ws_max_size=MAX_MESSAGE_BYTES,
            ws_max_queue=MAX_WAITING_MESSAGES,
            ws_per_message_deflate=False,  # images are compressed already
            ws_ping_interval=PING_PERIOD_S,
            ws_ping_timeout=PING_TIMEOUT_S,
        )
        super().__init__(config)
        deps = app.state.deps
        assert isinstance(deps, Deps)
        self._end_channels = deps.end_channels

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._end_channels()
        super().handle_exit(sig, frame)


def max_connections() -> int:
    """How many connections the limit of open files allows. Raises that limit if permitted."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_CONNECTIONS + SPARE_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return MAX_CONNECTIONS if soft == resource.RLIM_INFINITY else min(MAX_CONNECTIONS, max(soft - SPARE_FILES, 1))
