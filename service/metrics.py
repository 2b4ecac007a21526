"""GET /metrics for Prometheus. Labels are routes, states and devices: never a tenant, a name, or an id, but the first
characters of a live feed's."""

from __future__ import annotations

import collections
import contextlib
import time
from collections.abc import Iterator
from http import HTTPStatus

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import generate_latest
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from contract.access.keys import KeyFile
from contract.queue.interface import Queue
from contract.runtime import traces
from contract.store.store import Store
from contract.wire.webhooks import DeliveryStatus
from intrasplat.errors import UnavailableError
from intrasplat.version import version
from service.feed_metrics import of_feeds

NO_ROUTE = "none"
"""The label of the page's files and of unknown paths. Callers choose paths, so a path is never a label."""
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
DURATIONS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0, 60.0, 600.0)
RENDER_DURATIONS_S = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.28, 5.0)
REASONS = {
    401: "key",
    403: "scope",
    409: "state",
    413: "size",
    422: "input",
    429: "rate",
    503: "unavailable",
    507: "disk",
}


class Metrics:
    """The figures of one service. Those of the queue are read when Prometheus asks."""

    def __init__(self, queue: Queue, store: Store) -> None:
        registry = self._registry = CollectorRegistry()
        registry.register(_QueueCollector(queue, store))
        registry.register(_KeyCollector(store))
        ProcessCollector(registry=registry)
        Info("intrasplat_build", "The running version.", registry=registry).info({"version": version()})
        self.requests = Counter(
            "intrasplat_http_requests",
            "Answers by route template.",
            ("method", "route", "status"),
            registry=registry,
        )
        self.durations = Histogram(
            "intrasplat_http_request_duration_seconds",
            "From the first byte of a request to the last of its answer.",
            ("method", "route"),
            buckets=DURATIONS_S,
            registry=registry,
        )
        self.received = Counter(
            "intrasplat_http_received_bytes", "Bytes of bodies, uploads above all.", ("route",), registry=registry
        )
        self.rejected = Counter(
            "intrasplat_rejected", "Requests that were not served, by reason.", ("reason",), registry=registry
        )
        self.renders = Histogram(
            "intrasplat_render_duration_seconds",
            "What the worker took for a view, without queueing and transport.",
            ("state",),
            buckets=RENDER_DURATIONS_S,
            registry=registry,
        )
        self.streams = Gauge("intrasplat_streams", "Open WebSockets on /stream.", registry=registry)
        self.pushes = Gauge("intrasplat_feed_pushes", "Open connections that push a feed's video.", registry=registry)

    def exposition(self) -> bytes:
        """All figures in Prometheus' text format. Reads queue and disk."""
        return generate_latest(self._registry)

    def rendered(self, state: str, render_ms: float) -> None:
        """Count a view of a running or done job."""
        self.renders.labels(state).observe(render_ms / 1000.0)


class Measure:
    """ASGI middleware, outermost of all, that counts and times requests."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            await self._measured(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _measured(self, scope: Scope, receive: Receive, send: Send) -> None:
        status, received_bytes, began_s = HTTPStatus.INTERNAL_SERVER_ERROR.value, 0, time.perf_counter()

        async def counted_receive() -> Message:
            nonlocal received_bytes
            message = await receive()
            received_bytes += len(message.get("body", b""))
            return message

        async def watched_send(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, counted_receive, watched_send)
        finally:
            self._count(scope, status, received_bytes, time.perf_counter() - began_s)

    def _count(self, scope: Scope, status: int, received_bytes: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", NO_ROUTE)
        method = scope["method"] if scope["method"] in METHODS else "other"
        self._metrics.requests.labels(method, route, str(status)).inc()
        self._metrics.durations.labels(method, route).observe(seconds)
        if received_bytes:
            self._metrics.received.labels(route).inc(received_bytes)
        if status in REASONS:
            self._metrics.rejected.labels(REASONS[status]).inc()


class _KeyCollector(Collector):
    """How many keys expire soon."""

    def __init__(self, store: Store) -> None:
        self._keys = KeyFile(store.data_dir)

    def collect(self) -> Iterator[Metric]:
        """The number of keys that expire within 14 days; nothing while the file cannot be read."""
        with contextlib.suppress(UnavailableError):
            number = len(self._keys.expiring(time.time()))
            yield GaugeMetricFamily("intrasplat_keys_expiring", "Keys that expire within 14 days.", number)


class _QueueCollector(Collector):
    """Present figures of the queue, the workers and the disk."""

    def __init__(self, queue: Queue, store: Store) -> None:
        self._queue = queue
        self._store = store

    def collect(self) -> Iterator[Metric]:
        """The figures; for an unreachable queue or disk, only that it is unreachable."""
        try:
            yield from self._of_queue()
            yield from of_feeds(self._queue.feeds(), time.time())
            yield GaugeMetricFamily("intrasplat_queue_up", "Whether the queue answers.", 1)
        except UnavailableError:
            yield GaugeMetricFamily("intrasplat_queue_up", "Whether the queue answers.", 0)
        try:
            free_bytes = self._store.free_bytes()
        except UnavailableError:
            free_bytes = 0
        yield GaugeMetricFamily("intrasplat_free_bytes", "Left on the data directory's disk.", free_bytes)
        if (dropped := traces.dropped()) is not None:
            yield CounterMetricFamily("intrasplat_spans_dropped", "Spans that the collector did not get.", dropped)

    def _of_queue(self) -> list[Metric]:
        figures, workers = self._queue.figures(), self._queue.workers()
        ended = CounterMetricFamily("intrasplat_jobs_ended", "Jobs that came to each end.", labels=("state",))
        for state, count in figures.ended.items():
            ended.add_metric((state.value,), count)
        live = GaugeMetricFamily("intrasplat_workers", "Live workers.", labels=("device", "trains"))
        kinds = collections.Counter(
            (worker.device, "no" if worker.renders_only else "yes") for worker in workers if worker.feed_id is None
        )
        for kind, count in sorted(kinds.items()):
            live.add_metric(kind, count)
        webhooks = CounterMetricFamily("intrasplat_webhooks", "Webhooks delivered and given up.", labels=("status",))
        for status in (DeliveryStatus.DELIVERED, DeliveryStatus.FAILED):
            webhooks.add_metric((status.value,), figures.webhooks.get(status, 0))
        return [
            GaugeMetricFamily("intrasplat_jobs_queued", "Jobs that wait.", figures.queued),
            GaugeMetricFamily("intrasplat_jobs_running", "Jobs that a worker holds.", figures.running),
            GaugeMetricFamily(
                "intrasplat_oldest_queued_seconds", "How long the oldest job has waited.", figures.oldest_queued_s
            ),
            ended,
            live,
            webhooks,
            GaugeMetricFamily(
                "intrasplat_webhooks_owed", "Webhooks still to deliver.", figures.webhooks[DeliveryStatus.OWED]
            ),
        ]
