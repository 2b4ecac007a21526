"""HEAD wherever there is GET: the same status and headers without the body (RFC 9110, 9.3.2)."""

from __future__ import annotations

import asyncio

from starlette.routing import Match, Mount
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class HeadAsGet:
    """ASGI middleware, innermost of all. Routes with their own HEAD keep it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope.get("method") != "HEAD" or _has_route(scope):
            await self._app(scope, receive, send)
            return
        asked: Scope = {**scope, "method": "GET"}
        streaming = asyncio.Event()

        async def send_head(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b""})
            elif not streaming.is_set() and message.get("more_body", False):
                streaming.set()
                await asyncio.sleep(0)

        answering = asyncio.ensure_future(self._app(asked, receive, send_head))
        known = asyncio.ensure_future(streaming.wait())
        try:
            await asyncio.wait({answering, known}, return_when=asyncio.FIRST_COMPLETED)
            if answering.done():
                answering.result()
        finally:
            for task in (answering, known):
                task.cancel()
            await asyncio.wait({answering, known})
            scope["route"] = asked.get("route")


def _has_route(scope: Scope) -> bool:
    routes = [each for each in scope["app"].routes if not isinstance(each, Mount)]
    return any(each.matches(scope)[0] is Match.FULL for each in routes)
