"""Spans of requests and jobs, for OpenTelemetry; off unless its variables ask for it.

A span holds Attributes: ids, codes, sizes and durations, and nothing of a patient. Of an error it holds the type, for
texts may name files. While traces are off, every span is INVALID_SPAN, whose methods do nothing. The SDK, which records
spans and sends them, is an extra; configure() imports it (otlp.py) where traces are on.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypedDict, Unpack

from opentelemetry.context import Context
from opentelemetry.trace import INVALID_SPAN, Span, SpanKind, StatusCode, format_trace_id, get_current_span, use_span
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

if TYPE_CHECKING:
    from contract.runtime.otlp import Recorder

TRACEPARENT = "traceparent"
"""The header of W3C Trace Context."""
NEW = ""
"""As a parent: the span begins a trace of its own."""

NAMES = {
    "method": "http.request.method",
    "route": "http.route",
    "status": "http.response.status_code",
    "host": "server.address",
}
"""Attributes that OpenTelemetry has names for; all others have ours."""
MAX_CHARACTERS = 200

EXPORTER, DISABLED = "OTEL_TRACES_EXPORTER", "OTEL_SDK_DISABLED"
ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
OTLP, HTTP_PROTOBUF = "otlp", "http/protobuf"
REMEDY = "pip install 'intrasplat[otel]', or set OTEL_TRACES_EXPORTER=none."

logger = logging.getLogger("intrasplat.traces")


class Attributes(TypedDict, total=False):
    """All that a span may hold besides its name and its times."""

    request_id: str
    job_id: str
    attempt: int
    worker: str
    method: str
    route: str
    status: int
    outcome: str
    host: str
    input_bytes: int
    width: int
    height: int
    layer: str
    format: str
    gaussians: int
    level: int
    shared: bool


_propagator = TraceContextTextMapPropagator()
_recorder: Recorder | None = None


def configure(process: str, instance: str | None = None, environment: Mapping[str, str] | None = None) -> None:
    """Turn traces on if the variables ask for it; a line in the log says so, or why not.

    process: what it is, such as "service". instance: its name among those of its kind; None: a random one.
    """
    variables = os.environ if environment is None else environment
    if not _is_asked_for(variables):
        return
    if lack := _lack(variables):
        logger.warning("traces are off: %s", lack)
        return
    try:
        from contract.runtime.otlp import Recorder
    except ModuleNotFoundError as error:
        logger.warning("traces are off: %s is not installed. %s", error.name, REMEDY)
        return
    try:
        use(Recorder(process, instance))
    except Exception as error:  # a value that OpenTelemetry does not accept must not stop a service
        logger.warning("traces are off: OpenTelemetry does not accept its variables (%s).", type(error).__name__)
        return
    logger.info("traces are sent to the collector")


def use(recorder: Recorder | None) -> None:
    """Let this recorder make the spans of this process; None: turn traces off."""
    global _recorder
    _recorder = recorder


def begin(
    name: str,
    parent: str | None = None,
    *,
    kind: SpanKind = SpanKind.INTERNAL,
    since_s: float | None = None,
    **attributes: Unpack[Attributes],
) -> Span:
    """A span that has begun; the caller must end it.

    parent: the traceparent of another span, which may be of another process; one that is not valid counts as NEW.
    None: the current span of this context. since_s: UNIX s; None: now.
    """
    if _recorder is None:
        return INVALID_SPAN
    context = None if parent is None else _propagator.extract({TRACEPARENT: parent}, Context())
    start_ns = None if since_s is None else round(since_s * 1e9)
    begun = _recorder.tracer.start_span(name, context, kind, start_time=start_ns)
    describe(begun, **attributes)
    return begun


@contextmanager
def span(
    name: str,
    parent: str | None = None,
    *,
    kind: SpanKind = SpanKind.INTERNAL,
    since_s: float | None = None,
    **attributes: Unpack[Attributes],
) -> Iterator[Span]:
    """A span that lasts as long as the context and is the current one in it; arguments as for begin()."""
    if _recorder is None:
        yield INVALID_SPAN
        return
    begun = begin(name, parent, kind=kind, since_s=since_s, **attributes)
    with use_span(begun, end_on_exit=True, record_exception=False, set_status_on_exception=False):
        try:
            yield begun
        except BaseException as error:
            fail(begun, type(error).__name__)
            raise


def describe(span: Span, **attributes: Unpack[Attributes]) -> None:
    """Add attributes to a span."""
    for name, value in attributes.items():
        known = value if isinstance(value, int | float) else str(value)[:MAX_CHARACTERS]
        span.set_attribute(NAMES.get(name, f"intrasplat.{name}"), known)


def fail(span: Span, error: str) -> None:
    """Mark a span as failed. error: the type of the error, or another code."""
    span.set_attribute("error.type", error[:MAX_CHARACTERS])
    span.set_status(StatusCode.ERROR)


def traceparent() -> str | None:
    """The name of the current span for another process; None: there is no span."""
    carrier: dict[str, str] = {}
    _propagator.inject(carrier)
    return carrier.get(TRACEPARENT)


def trace_id() -> str | None:
    """The trace of the current span, 32 hexadecimal digits; None: there is no span."""
    context = get_current_span().get_span_context()
    return format_trace_id(context.trace_id) if context.is_valid else None


def dropped() -> int | None:
    """How many spans of this process were not sent; None: traces are off."""
    return None if _recorder is None else _recorder.sender.dropped


def flush(timeout_s: float = 2.0) -> None:
    """Send the spans that wait, before this process ends."""
    if _recorder is not None:
        _recorder.sender.force_flush(round(timeout_s * 1000))


def _is_asked_for(variables: Mapping[str, str]) -> bool:
    if variables.get(DISABLED, "").strip().lower() == "true":
        return False
    exporter = variables.get(EXPORTER, "").strip().lower()
    return exporter != "none" and (exporter != "" or any(variables.get(each) for each in ENDPOINTS))


def _lack(variables: Mapping[str, str]) -> str | None:
    """What the variables ask for that this program cannot do."""
    exporter = variables.get(EXPORTER, "").strip().lower()
    if exporter not in ("", OTLP):
        return f"{EXPORTER} names another exporter than {OTLP}. Set it to {OTLP}, or to none."
    protocol = next((variables[each] for each in PROTOCOLS if variables.get(each)), HTTP_PROTOBUF)
    if protocol.strip().lower() != HTTP_PROTOBUF:
        return f"{PROTOCOLS[1]} names another protocol than {HTTP_PROTOBUF}. Name the collector's address for that one."
    return None
