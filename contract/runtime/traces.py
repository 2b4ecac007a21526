"""Spans of requests and jobs, for OpenTelemetry; off unless its environment variables turn them on.

A span has Attributes: ids, codes, sizes and durations, and nothing about a patient. Of an error it records only the
type, because messages may name files. While traces are off, every span is INVALID_SPAN, whose methods do nothing. The
SDK, which records and sends spans, is an extra; configure() imports it (otlp.py) when traces are on.
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
"""As a parent: the span starts a new trace."""

NAMES = {
    "method": "http.request.method",
    "route": "http.route",
    "status": "http.response.status_code",
    "host": "server.address",
}
"""Attributes that OpenTelemetry has names for; all others use our names."""
MAX_CHARACTERS = 200

EXPORTER, DISABLED = "OTEL_TRACES_EXPORTER", "OTEL_SDK_DISABLED"
ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
OTLP, HTTP_PROTOBUF = "otlp", "http/protobuf"
REMEDY = "pip install 'intrasplat-server[otel]', or set OTEL_TRACES_EXPORTER=none."

logger = logging.getLogger("intrasplat.traces")


class Attributes(TypedDict, total=False):
    """The attributes that a span may have."""

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
    """Turn traces on if the environment variables request it. The log says so, or why not.

    process: the kind of process, such as "service". instance: its name among those; None: a random one.
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
    """Create the spans of this process with this recorder; None: turn traces off."""
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
    """Start a span, which the caller must end.

    parent: the traceparent of another span, maybe in another process; an invalid one counts as NEW. None: the current
    span of this context. since_s: when the span started, UNIX s; None: now.
    """
    if _recorder is None:
        return INVALID_SPAN
    context = None if parent is None else _propagator.extract({TRACEPARENT: parent}, Context())
    start_ns = None if since_s is None else round(since_s * 1e9)
    new_span = _recorder.tracer.start_span(name, context, kind, start_time=start_ns)
    describe(new_span, **attributes)
    return new_span


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
    new_span = begin(name, parent, kind=kind, since_s=since_s, **attributes)
    with use_span(new_span, end_on_exit=True, record_exception=False, set_status_on_exception=False):
        try:
            yield new_span
        except BaseException as error:
            fail(new_span, type(error).__name__)
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
    """The traceparent of the current span, to pass to another process; None: there is no span."""
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
    """Send the waiting spans before this process ends."""
    if _recorder is not None:
        _recorder.sender.force_flush(round(timeout_s * 1000))


def _is_asked_for(variables: Mapping[str, str]) -> bool:
    if variables.get(DISABLED, "").strip().lower() == "true":
        return False
    exporter = variables.get(EXPORTER, "").strip().lower()
    return exporter != "none" and (exporter != "" or any(variables.get(each) for each in ENDPOINTS))


def _lack(variables: Mapping[str, str]) -> str | None:
    """What the variables request and this program cannot do."""
    exporter = variables.get(EXPORTER, "").strip().lower()
    if exporter not in ("", OTLP):
        return f"{EXPORTER} names another exporter than {OTLP}. Set it to {OTLP}, or to none."
    protocol = next((variables[each] for each in PROTOCOLS if variables.get(each)), HTTP_PROTOBUF)
    if protocol.strip().lower() != HTTP_PROTOBUF:
        return f"{PROTOCOLS[1]} names another protocol than {HTTP_PROTOBUF}. Name the collector's address for that one."
    return None
