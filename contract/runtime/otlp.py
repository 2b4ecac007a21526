"""Records spans (traces.py) with OpenTelemetry's SDK and sends them to a collector by OTLP over HTTP; extra `otel`."""

from __future__ import annotations

import atexit
import logging
import os
import queue
import threading
import time
from collections.abc import Sequence

from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import ReadableSpan, SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import SpanExporter, SpanExportResult

from intrasplat.version import version

FLUSH_LOOK_S = 0.01
AT_EXIT_MS = 2000
"""How long a process waits at its end for spans that are not sent yet."""

logger = logging.getLogger("intrasplat.traces")


class Recorder:
    """A tracer and the sender of its spans. The standard OTEL_ variables set destination, interval and sampling."""

    def __init__(self, process: str, instance: str | None = None, exporter: SpanExporter | None = None) -> None:
        attributes = {"service.name": os.environ.get("OTEL_SERVICE_NAME") or f"intrasplat-{process}"}
        attributes |= {"service.version": version()} | ({"service.instance.id": instance} if instance else {})
        self.sender = Sender(exporter or OTLPSpanExporter())
        provider = TracerProvider(resource=Resource.create(attributes), shutdown_on_exit=False)
        provider.add_span_processor(self.sender)
        self.tracer = provider.get_tracer("intrasplat", version())
        logging.getLogger("opentelemetry").setLevel(logging.CRITICAL)  # Sender logs a failure once itself
        atexit.register(self.sender.force_flush, AT_EXIT_MS)


class Sender(SpanProcessor):
    """Sends ended spans in batches, in its own thread. It never blocks: spans are dropped when its buffer is full.

    The SDK's own processor counts no losses, and starts a thread in every forked child.
    """

    def __init__(self, exporter: SpanExporter) -> None:
        self._exporter = exporter
        self._waiting: queue.Queue[ReadableSpan] = queue.Queue(_number("OTEL_BSP_MAX_QUEUE_SIZE", 2048))
        self._max_batch = _number("OTEL_BSP_MAX_EXPORT_BATCH_SIZE", 512)
        self._period_s = _number("OTEL_BSP_SCHEDULE_DELAY", 5000) / 1000
        self._lock = threading.Lock()
        self._hurry = threading.Event()
        self._away = False
        self.dropped = 0
        threading.Thread(target=self._run, name="traces", daemon=True).start()

    def on_end(self, span: ReadableSpan) -> None:
        if span.context is None or not span.context.trace_flags.sampled:
            return
        try:
            self._waiting.put_nowait(span)
        except queue.Full:
            with self._lock:
                self.dropped += 1
        if self._waiting.qsize() >= self._max_batch:
            self._hurry.set()

    def force_flush(self, timeout_millis: int = 30000) -> bool:
        """Send the waiting spans now; False if that takes too long."""
        until_s = time.monotonic() + timeout_millis / 1000
        while self._waiting.unfinished_tasks and time.monotonic() < until_s and not self._away:
            self._hurry.set()
            time.sleep(FLUSH_LOOK_S)
        return not self._waiting.unfinished_tasks

    def _run(self) -> None:
        while True:
            self._hurry.wait(self._period_s)
            self._hurry.clear()
            while batch := self._batch():
                self._send(batch)
                for _ in batch:
                    self._waiting.task_done()

    def _batch(self) -> list[ReadableSpan]:
        """The next waiting spans, at most as many as one request may carry."""
        batch: list[ReadableSpan] = []
        while len(batch) < self._max_batch and not self._waiting.empty():
            batch.append(self._waiting.get_nowait())
        return batch

    def _send(self, batch: Sequence[ReadableSpan]) -> None:
        try:
            is_sent = self._exporter.export(batch) is SpanExportResult.SUCCESS
        except Exception:  # whatever the collector answers, this thread goes on
            is_sent = False
        if not is_sent:
            with self._lock:
                self.dropped += len(batch)
        if is_sent is self._away:
            self._away = not is_sent
            if self._away:
                logger.warning("the collector does not take spans; they are dropped until it does")
            else:
                logger.warning("the collector takes spans again; %d were dropped so far", self.dropped)


def _number(variable: str, default: int) -> int:
    """A whole number above 0 from a variable; the default if the variable has another value."""
    text = os.environ.get(variable, "")
    return int(text) if text.isdecimal() and int(text) > 0 else default
