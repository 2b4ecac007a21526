"""A receiver of webhooks on a port of this machine, as a hospital's system would be one."""

from __future__ import annotations

import json
import queue
import ssl
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from contract.access.webhook_secrets import tenant_secret
from tests.test_operations import block

ARRIVES_WITHIN_S = 60.0


@dataclass(frozen=True)
class Webhook:
    """A request that came. Names of headers are in lower case."""

    path: str
    headers: Mapping[str, str]
    body: bytes

    @property
    def document(self) -> dict[str, Any]:
        """The body as JSON."""
        document: dict[str, Any] = json.loads(self.body)
        return document

    def is_genuine(self, webhook_secret: str, tenant: str) -> bool:
        """What the documented sample says, given the secret that the tenant has."""
        names: dict[str, Any] = {}
        exec(block("python"), names)
        genuine: bool = names["is_genuine"](tenant_secret(webhook_secret, tenant), self.headers, self.body)
        return genuine


class Receiver:
    """Keeps what comes and answers with `answers`, one after the other, then with 204; a context manager.

    tls: it speaks https with this certificate. waits: it answers a request only after go_on(). floods: its answers have
    bodies without end. retry_after: of each of its `answers`.
    """

    def __init__(
        self,
        *answers: int,
        tls: ssl.SSLContext | None = None,
        waits: bool = False,
        floods: bool = False,
        retry_after: str | None = None,
    ) -> None:
        self._answers = list(answers)
        self._retry_after = retry_after
        self._floods = floods
        self._end = threading.Event()
        self._may_answer = threading.Event()
        if not waits:
            self._may_answer.set()
        self.came: queue.Queue[Webhook] = queue.Queue()
        self.all: list[Webhook] = []
        self.flooded_bytes: queue.Queue[int] = queue.Queue()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                with suppress(OSError):  # the service may have hung up
                    receiver._take(self)

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        if tls is not None:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True)
        self.port: int = self._server.server_address[1]
        self.origin = f"{'http' if tls is None else 'https'}://127.0.0.1:{self.port}"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)

    def __enter__(self) -> Receiver:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._end.set()
        self.go_on()
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def go_on(self) -> None:
        """Answer what came and what comes."""
        self._may_answer.set()

    def next(self) -> Webhook:
        """The next that comes; queue.Empty if none does."""
        return self.came.get(timeout=ARRIVES_WITHIN_S)

    def _take(self, request: BaseHTTPRequestHandler) -> None:
        body = request.rfile.read(int(request.headers["content-length"]))
        headers = {name.lower(): value for name, value in request.headers.items()}
        webhook = Webhook(request.path, headers, body)
        self.all.append(webhook)
        self.came.put(webhook)
        self._may_answer.wait()
        asks_to_wait = self._answers and self._retry_after
        status = self._answers.pop(0) if self._answers else 204
        request.send_response(status)
        if asks_to_wait:
            request.send_header("Retry-After", asks_to_wait)
        request.send_header("Set-Cookie", "receivers=own")
        if 300 <= status < 400:
            request.send_header("Location", "/elsewhere")
        if not self._floods:
            request.send_header("Content-Length", "0")
        request.end_headers()
        if self._floods:
            self._flood(request)

    def _flood(self, request: BaseHTTPRequestHandler) -> None:
        sent = 0
        with suppress(OSError):
            while not self._end.is_set():
                sent += request.wfile.write(bytes(65536))
        self.flooded_bytes.put(sent)
