"""What WebSockets share: the key of a browser comes in the first message, and a refusal is a last message."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from typing import Any

from fastapi import WebSocket, WebSocketDisconnect
from pydantic_core import from_json
from starlette.types import Message

from contract.access.keys import KeyScope
from service.access import AccessRefusal, Caller, key_missing
from service.deps import Deps, address_of
from service.problems import MESSAGE_REMEDY, Problem

AUTHORIZE_TIMEOUT_S = 5.0
"""A client that connects without a key must send it within this time."""
SEND_TIMEOUT_S = 30.0
"""A client that takes this long to receive one message counts as gone."""

NOT_TEXT, MALFORMED, NOT_ALLOWED, TOO_LARGE, FAULT = 1003, 1007, 1008, 1009, 1011
"""Close codes of RFC 6455, 7.4.1."""

AUTHORIZE = "authorize"
GONE = (WebSocketDisconnect, TimeoutError)
"""Raised when the client has disconnected, or does not read any more."""


class HangUpError(Exception):
    """Close the connection with this code, after a last message."""

    def __init__(self, code: int, problem: Problem) -> None:
        super().__init__(problem.detail)
        self.code = code
        self.problem = problem


class Entrance:
    """The client of one WebSocket, and whether it may come in.

    lobby: counts it as a connection without a key until the key has come.
    scope: what its key must allow.
    """

    def __init__(
        self,
        websocket: WebSocket,
        services: Deps,
        lobby: contextlib.ExitStack,
        scope: KeyScope,
        *,
        may_come_in: bool,
    ) -> None:
        self._websocket = websocket
        self._services = services
        self._lobby = lobby
        self._scope = scope
        self._address = address_of(websocket)
        self._caller: Callable[[], Caller] | None = self._caller_of_headers if may_come_in else None

    @property
    def is_open(self) -> bool:
        """Whether the client has shown who it is."""
        return self._caller is not None

    async def receive(self) -> Message:
        """The client's next message.

        Raises:
            HangUpError: its key does not come within AUTHORIZE_TIMEOUT_S.
        """
        try:
            async with asyncio.timeout(AUTHORIZE_TIMEOUT_S if self._caller is None else None):
                return await self._websocket.receive()
        except TimeoutError:
            raise HangUpError(NOT_ALLOWED, key_missing(self._address)) from None

    async def send(self, content: str | bytes) -> None:
        """Send a message. Raises one of GONE."""
        async with asyncio.timeout(SEND_TIMEOUT_S):
            if isinstance(content, str):
                await self._websocket.send_text(content)
            else:
                await self._websocket.send_bytes(content)

    async def hang_up(self, reason: HangUpError) -> None:
        """Send the problem and close the connection."""
        if isinstance(reason.problem, AccessRefusal):
            await self._services.audit.refused(reason.problem)
        with contextlib.suppress(*GONE):
            await self.send(json.dumps(reason.problem.document()))
            async with asyncio.timeout(SEND_TIMEOUT_S):
                await self._websocket.close(reason.code)

    def caller(self) -> Caller:
        """Who the client is, looked up anew, so that revoking a key ends its connections. Raises Problem 401 or 403."""
        assert self._caller is not None
        caller = self._caller()
        caller.require(self._scope)
        return caller

    def is_key(self, document: dict[str, Any] | Problem) -> bool:
        """Whether a message brings a key, or must."""
        return self._caller is None or (isinstance(document, dict) and AUTHORIZE in document)

    def authorize(self, document: dict[str, Any] | Problem) -> None:
        """Let the client in by the key in a message. Raises HangUpError if it has none or a wrong one."""
        key = document.get(AUTHORIZE) if isinstance(document, dict) else None
        if not isinstance(key, str):
            raise HangUpError(NOT_ALLOWED, key_missing(self._address))

        def caller() -> Caller:
            return self._services.access.caller_of_key(key, self._address)

        try:
            caller().require(self._scope)
        except Problem as problem:
            raise HangUpError(NOT_ALLOWED, problem) from None
        self._caller = caller
        self._lobby.close()

    def _caller_of_headers(self) -> Caller:
        caller = self._services.access.caller(self._websocket.headers, self._address)
        if caller is None:
            raise key_missing(self._address)
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
        return Problem(400, "The message is not a JSON object.", remedy=MESSAGE_REMEDY)
    return document
