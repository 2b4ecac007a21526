"""A collector of spans for the tests: OTLP over HTTP, as OpenTelemetry's own takes them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

WAIT_S = 60.0


@dataclass(frozen=True)
class Seen:
    """A span as the collector got it; ids as hex, "" without a parent."""

    name: str
    process: str
    trace_id: str
    span_id: str
    parent_id: str
    begun_ns: int
    ended_ns: int
    attributes: dict[str, str | int | bool]
    failed: bool


class Collector:
    """Where it answers, what it was sent, and all the bytes of it."""

    def __init__(self, port: int) -> None:
        self.endpoint = f"http://127.0.0.1:{port}"
        self.spans: list[Seen] = []
        self.content = b""
        self._arrived = threading.Condition()

    def take(self, body: bytes) -> None:
        """Note what a request holds."""
        with self._arrived:
            self.content += body
            self.spans += _spans_of(ExportTraceServiceRequest.FromString(body))
            self._arrived.notify_all()

    def wait_for(self, *names: str) -> list[Seen]:
        """All spans, as soon as those of these names are among them."""
        until_s = time.monotonic() + WAIT_S
        with self._arrived:
            while missing := set(names) - {each.name for each in self.spans}:
                assert self._arrived.wait(until_s - time.monotonic()), f"no span {sorted(missing)}"
            return list(self.spans)


def _spans_of(request: ExportTraceServiceRequest) -> Iterator[Seen]:
    for resource in request.resource_spans:
        about = {each.key: each.value.string_value for each in resource.resource.attributes}
        for span in (span for scope in resource.scope_spans for span in scope.spans):
            yield Seen(
                name=span.name,
                process=about["service.name"],
                trace_id=span.trace_id.hex(),
                span_id=span.span_id.hex(),
                parent_id=span.parent_span_id.hex(),
                begun_ns=span.start_time_unix_nano,
                ended_ns=span.end_time_unix_nano,
                attributes={each.key: getattr(each.value, each.value.WhichOneof("value")) for each in span.attributes},
                failed=span.status.code == 2,
            )


@contextmanager
def collecting() -> Iterator[Collector]:
    """A collector that listens while the context lasts."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            collector.take(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *arguments: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    collector = Collector(server.server_address[1])
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield collector
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
