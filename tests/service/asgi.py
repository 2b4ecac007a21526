"""A blocking HTTP client on an ASGI application, without a socket: one event loop in a thread, as under a server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import httpx
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fastapi import FastAPI


class AsgiClient:
    """Requests to the application, one after the other."""

    def __init__(self, portal: BlockingPortal, http: httpx.AsyncClient) -> None:
        self._portal = portal
        self._http = http

    def request(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """Any request; arguments as httpx has them."""
        return self._portal.call(partial(self._http.request, method, path, **arguments))

    def get(self, path: str, **arguments: Any) -> httpx.Response:
        """GET."""
        return self.request("GET", path, **arguments)

    def post(self, path: str, **arguments: Any) -> httpx.Response:
        """POST."""
        return self.request("POST", path, **arguments)

    def delete(self, path: str) -> httpx.Response:
        """DELETE."""
        return self.request("DELETE", path)


@contextmanager
def serving(app: FastAPI, base_url: str) -> Iterator[AsgiClient]:
    """Start the application, hand out a client, end the application."""
    transport = httpx.ASGITransport(app=app, raise_app_exceptions=False)
    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(app.router.lifespan_context(app)),
        portal.wrap_async_context_manager(httpx.AsyncClient(transport=transport, base_url=base_url)) as http,
    ):
        yield AsgiClient(portal, http)
