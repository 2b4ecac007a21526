"""One connection for many views of a scene: faster than a request each. Only the newest request is answered."""

from __future__ import annotations

import json
from types import TracebackType
from typing import TYPE_CHECKING, Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI

from intrasplat_client.connection import ANSWER_TIMEOUT_S, CONNECT_TIMEOUT_S, authorization
from intrasplat_client.errors import IntrasplatError, Unreachable, error_of_answer
from intrasplat_client.views import Image, image_of_message, view_query

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection as AsyncConnection
    from websockets.sync.client import ClientConnection as Connection

MAX_MESSAGE_BYTES = 2**28
"""64 million pixels of depth in mm, more than any service renders; the library's own limit is 1 MiB."""

CONNECTION_ERRORS = (OSError, InvalidHandshake, InvalidURI, ConnectionClosed)
"""OSError includes TimeoutError."""


class StreamMessages:
    """The requests and answers of one connection; both viewers share it."""

    def __init__(self, url: str, scene: str, api_key: str | None) -> None:
        self.http_url = url
        self.url = f"ws{url.removeprefix('http')}/stream"
        self.headers = authorization(api_key)
        self._scene = scene
        self._last_id = 0

    def request(
        self,
        t: float | str | None,
        pose: str | None,
        layer: str,
        format: str,
        quality: int | None,
        unseen: str | None,
        highlights: str | None,
        light: str | None,
        smoke: str | None,
        detail: str | None,
        camera: dict[str, float],
    ) -> str:
        """The message that asks for a view."""
        self._last_id += 1
        query = view_query(
            t, self._scene, pose, layer, format, quality, unseen, highlights, light, smoke, detail, camera
        )
        return json.dumps({"id": self._last_id, **query})

    def answer(self, message: str | bytes) -> Image | None:
        """The view of the last request; None for the answer to an earlier request.

        Raises:
            IntrasplatError: the service's refusal.
        """
        about, answer = image_of_message(message)
        if about not in (self._last_id, None):
            return None
        if isinstance(answer, IntrasplatError):
            raise answer
        return answer

    def error_of(self, error: Exception) -> IntrasplatError:
        """The exception for a failed connection."""
        if isinstance(error, InvalidStatus):
            response = error.response
            headers = {name.lower(): value for name, value in response.headers.raw_items()}
            return error_of_answer(response.status_code, headers, bytes(response.body or b""))
        return Unreachable(self.http_url, error, is_nobody_there=not self._last_id)


class Viewer:
    """The result of Client.stream(), a context manager. One thread at a time may use it."""

    def __init__(self, messages: StreamMessages) -> None:
        from websockets.sync.client import connect

        self._messages = messages
        try:
            self._socket: Connection = connect(
                messages.url,
                additional_headers=messages.headers,
                open_timeout=CONNECT_TIMEOUT_S,
                max_size=MAX_MESSAGE_BYTES,
            )
        except CONNECTION_ERRORS as error:
            raise messages.error_of(error) from error

    def render(
        self,
        t: float | str | None = None,
        pose: str | None = None,
        *,
        layer: str = "rgb",
        format: str = "jpeg",
        quality: int | None = None,
        unseen: str | None = None,
        highlights: str | None = None,
        light: str | None = None,
        smoke: str | None = None,
        detail: str | None = None,
        **camera: float,
    ) -> Image:
        """One view; arguments as Client.render has them."""
        try:
            message = self._messages.request(
                t, pose, layer, format, quality, unseen, highlights, light, smoke, detail, camera
            )
            self._socket.send(message)
            while True:
                image = self._messages.answer(self._socket.recv(ANSWER_TIMEOUT_S))
                if image is not None:
                    return image
        except CONNECTION_ERRORS as error:
            raise self._messages.error_of(error) from error

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class AsyncViewer:
    """The result of AsyncClient.stream(), an asynchronous context manager. One task at a time may use it; asyncio
    only."""

    def __init__(self, messages: StreamMessages) -> None:
        self._messages = messages
        self._socket: AsyncConnection

    async def render(
        self,
        t: float | str | None = None,
        pose: str | None = None,
        *,
        layer: str = "rgb",
        format: str = "jpeg",
        quality: int | None = None,
        unseen: str | None = None,
        highlights: str | None = None,
        light: str | None = None,
        smoke: str | None = None,
        detail: str | None = None,
        **camera: float,
    ) -> Image:
        """One view; arguments as Client.render has them."""
        import asyncio

        try:
            message = self._messages.request(
                t, pose, layer, format, quality, unseen, highlights, light, smoke, detail, camera
            )
            await self._socket.send(message)
            async with asyncio.timeout(ANSWER_TIMEOUT_S):
                while True:
                    image = self._messages.answer(await self._socket.recv())
                    if image is not None:
                        return image
        except CONNECTION_ERRORS as error:
            raise self._messages.error_of(error) from error

    async def __aenter__(self) -> AsyncViewer:
        from websockets.asyncio.client import connect

        messages = self._messages
        try:
            self._socket = await connect(
                messages.url,
                additional_headers=messages.headers,
                open_timeout=CONNECT_TIMEOUT_S,
                max_size=MAX_MESSAGE_BYTES,
            )
        except CONNECTION_ERRORS as error:
            raise messages.error_of(error) from error
        return self

    async def __aexit__(self, *_: Any) -> None:
        await self._socket.close()
