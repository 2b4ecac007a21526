"""Checks Host and Origin of every request: no foreign web page may use a service that trusts the loopback interface.

A foreign page in a browser on this machine could reach a service that needs no key. Its Origin refuses it, or
Sec-Fetch-Site where browsers send no Origin, as for images. A DNS name that was rebound to 127.0.0.1 is refused by its
Host. WebSockets are checked in the same way, because browsers let any page open one. HTTPS and
Strict-Transport-Security are left to the proxy.
"""

from __future__ import annotations

from collections.abc import Collection
from urllib.parse import SplitResult, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from contract.runtime.settings import LOOPBACK_NAMES
from service.problems import LENGTH_REMEDY, Problem

ANY_HOST = "*"
"""As a host: accept every name, for clusters that address a service by changing names. Keys are then required."""

ANSWER_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
        "media-src 'self' blob:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
EXPOSED_HEADERS = (
    *("Location", "Retry-After", "ETag", "Server-Timing", "X-Request-Id"),
    *("Upload-Offset", "Upload-Length", "Tus-Resumable", "Tus-Version", "Tus-Extension", "Tus-Max-Size"),
    *(
        f"X-Intrasplat-{name}"
        for name in (
            *("Scene", "State", "Next", "T", "Iteration", "Unseen", "Detail", "Camera"),
            *("Depth-Unit", "Depth-Range-Mm", "Warning", "Warning-Codes", "Captured-At", "Age-S", "Source-S"),
        )
    ),
)
"""The response headers that a page of another origin may read."""
FOREIGN_SITES = frozenset({"cross-site", "same-site"})
"""Values of Sec-Fetch-Site for a request of another page; browsers send no Origin for images. Links are allowed."""
CORS_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")


class Guard:
    """ASGI middleware that refuses foreign hosts and origins and adds the security headers.

    origins: other origins whose pages may use the service; they send a key, never cookies.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str] = LOOPBACK_NAMES, origins: Collection[str] = ()) -> None:
        self._hosts = frozenset(host.lower() for host in hosts)
        self._origins = frozenset(origins)
        self._app = app
        if origins:
            self._app = CORSMiddleware(
                app,
                allow_origins=tuple(origins),
                allow_methods=CORS_METHODS,
                allow_headers=("*",),
                expose_headers=EXPOSED_HEADERS,
            )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(scope=message)
                for name, value in ANSWER_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(Headers(scope=scope))
        answer = self._app if refusal is None else refusal.response()
        await answer(scope, receive, send_with_headers)

    def _refusal(self, headers: Headers) -> Problem | None:
        host = headers.get("host", "")
        if ANY_HOST not in self._hosts and _split(f"//{host}").hostname not in self._hosts:
            remedy = "Whoever runs the service adds names with INTRASPLAT_HOSTS."
            return Problem(403, f"This service does not answer to the name {host[:80]!r}.", field="Host", remedy=remedy)
        origin = headers.get("origin")
        if origin is not None and origin not in self._origins and _split(origin).netloc != host:
            remedy = "Whoever runs the service admits pages from elsewhere with INTRASPLAT_CORS_ORIGINS."
            return Problem(403, f"Pages from {origin[:80]!r} may not use this service.", field="Origin", remedy=remedy)
        is_foreign = origin is None and headers.get("sec-fetch-site") in FOREIGN_SITES
        if is_foreign and headers.get("sec-fetch-dest") != "document":
            remedy = "Whoever runs the service admits pages from elsewhere with INTRASPLAT_CORS_ORIGINS."
            return Problem(403, "Pages from elsewhere may not use this service.", field="Sec-Fetch-Site", remedy=remedy)
        if "transfer-encoding" in headers and "content-length" in headers:  # RFC 9112, 6.1: request smuggling
            close = {"Connection": "close"}
            detail = "The request gives its body's length in two ways."
            return Problem(400, detail, field="Content-Length", remedy=LENGTH_REMEDY, headers=close)
        return None


def _split(url: str) -> SplitResult:
    """The parts of a URL; all empty, and so never allowed, if the text is not a URL."""
    try:
        return urlsplit(url)
    except ValueError:
        return urlsplit("")
