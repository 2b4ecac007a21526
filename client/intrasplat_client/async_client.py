"""AsyncClient: every method of Client, to be awaited."""

from __future__ import annotations

from types import TracebackType

import httpx

from intrasplat_client.connection import DEFAULT_URL, AwaitedConnection, http_settings
from intrasplat_client.core import Core
from intrasplat_client.session import DEFAULT_PATIENCE_S, OnWait
from intrasplat_client.viewer import AsyncViewer, StreamMessages


class AsyncClient(Core):
    """A connection to one service: use it as an asynchronous context, or await aclose(). Arguments are Client's."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        api_key: str | None = None,
        patience_s: float = DEFAULT_PATIENCE_S,
        on_wait: OnWait | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        url = url.rstrip("/")
        self._http = httpx.AsyncClient(transport=transport, **http_settings(url, api_key))
        self._api_key = api_key
        super().__init__(AwaitedConnection(self._http), url, patience_s, on_wait)

    def stream(self, scene: str) -> AsyncViewer:
        """A connection for many views: `async with client.stream(scene) as viewer: await viewer.render(t, pose)`."""
        return AsyncViewer(StreamMessages(self.url, scene, self._api_key))

    async def aclose(self) -> None:
        """Close the connection."""
        await self._http.aclose()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()
