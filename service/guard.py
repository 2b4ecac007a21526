"""What every request and answer passes: no foreign page may use a service that trusts the loopback interface.

There are no accounts yet, so the service binds to loopback. A page from elsewhere that is open in a browser on this
machine could still reach it; it is refused by its Origin, and a name that was rebound to 127.0.0.1 by its Host.
"""

from __future__ import annotations

from collections.abc import Collection
from urllib.parse import SplitResult, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Problem

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})

ANSWER_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Guard:
    """ASGI middleware: refuses foreign hosts and origins, adds the security headers."""

    def __init__(self, app: ASGIApp, hosts: Collection[str] = LOOPBACK_NAMES) -> None:
        self._app = app
        self._hosts = frozenset(hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in ANSWER_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(Headers(scope=scope))
        answer = self._app if refusal is None else refusal.response()
        await answer(scope, receive, send_with_headers)

    def _refusal(self, headers: Headers) -> Problem | None:
        host = headers.get("host", "")
        if _split(f"//{host}").hostname not in self._hosts:
            return Problem(403, f"This service does not answer to the name {host[:80]!r}.", field="Host")
        origin = headers.get("origin")
        if origin is not None and _split(origin).netloc != host:
            return Problem(403, f"Pages from {origin[:80]!r} may not use this service.", field="Origin")
        return None


def _split(url: str) -> SplitResult:
    """The parts of a URL; all of them empty, and so allowed nowhere, if it is none."""
    try:
        return urlsplit(url)
    except ValueError:
        return urlsplit("")
