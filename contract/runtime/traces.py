"""What requests and jobs spend their time on, for OpenTelemetry; off unless its variables ask for it.

A span holds Attributes: ids, codes, sizes and durations, and nothing of a patient. Of an error it holds the type, for
texts may name files. This module imports no part of OpenTelemetry. contract/runtime/otlp.py does, where traces are on;
elsewhere every function here returns at once.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from enum import StrEnum
from typing import Protocol, TypedDict, Unpack

TRACEPARENT = "traceparent"
"""The header of W3C Trace Context."""
NEW = ""
"""As a parent: the span begins a trace of its own."""

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


class Kind(StrEnum):
    """Which side of a call a span is of, in the names of OpenTelemetry."""

    INTERNAL = "INTERNAL"
    SERVER = "SERVER"
    CLIENT = "CLIENT"
    CONSUMER = "CONSUMER"


class Span:
    """A span that is not recorded, and what one that is can do."""

    traceparent: str | None = None
    """Names this span to another process; None: traces are off."""
    trace_id: str | None = None

    def set(self, **attributes: Unpack[Attributes]) -> None:
        """Add attributes."""

    def rename(self, name: str) -> None:
        """Give it another name."""

    def end(self, failed: str | None = None) -> None:
        """End it, once. failed: the type of the error, or another code."""


class Recorder(Protocol):
    """What makes spans where traces are on."""

    @property
    def dropped(self) -> int:
        """Spans that were not sent: the collector was away, or too many waited."""
        ...

    def begin(self, name: str, parent: str, kind: Kind, since_s: float | None, attributes: Attributes) -> Span:
        """As begin() below, with the parent known."""
        ...

    def flush(self, timeout_s: float) -> None:
        """Send what waits."""
        ...


NOT_RECORDED = Span()
_recorder: Recorder | None = None
_current: ContextVar[Span] = ContextVar("span", default=NOT_RECORDED)


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
        from contract.runtime.otlp import OtlpRecorder
    except ModuleNotFoundError as error:
        logger.warning("traces are off: %s is not installed. %s", error.name, REMEDY)
        return
    try:
        recorder = OtlpRecorder(process, instance)
    except Exception as error:  # a value that OpenTelemetry does not accept must not stop a service
        logger.warning("traces are off: OpenTelemetry does not accept its variables (%s).", type(error).__name__)
        return
    use(recorder)
    logger.info("traces are sent to the collector")


def use(recorder: Recorder | None) -> None:
    """Let this recorder make the spans of this process; None: nobody."""
    global _recorder
    _recorder = recorder


def begin(
    name: str,
    parent: str | None = None,
    *,
    kind: Kind = Kind.INTERNAL,
    since_s: float | None = None,
    **attributes: Unpack[Attributes],
) -> Span:
    """A span that has begun; the caller must end it.

    parent: the traceparent of another span, which may be of another process; one that is not valid counts as NEW.
    None: the current span of this context. since_s: UNIX s; None: now.
    """
    if _recorder is None:
        return NOT_RECORDED
    if parent is None:
        parent = current().traceparent or NEW
    return _recorder.begin(name, parent, kind, since_s, attributes)


@contextmanager
def span(
    name: str,
    parent: str | None = None,
    *,
    kind: Kind = Kind.INTERNAL,
    since_s: float | None = None,
    **attributes: Unpack[Attributes],
) -> Iterator[Span]:
    """A span that lasts as long as the context and is the current one in it; arguments as of begin()."""
    if _recorder is None:
        yield NOT_RECORDED
        return
    begun = begin(name, parent, kind=kind, since_s=since_s, **attributes)
    token = _current.set(begun)
    try:
        yield begun
    except BaseException as error:
        begun.end(failed=type(error).__name__)
        raise
    finally:
        _current.reset(token)
        begun.end()


def current() -> Span:
    """The span of this context."""
    return _current.get()


def dropped() -> int | None:
    """How many spans of this process were not sent; None: traces are off."""
    return None if _recorder is None else _recorder.dropped


def flush(timeout_s: float = 2.0) -> None:
    """Send what waits, before this process ends."""
    if _recorder is not None:
        _recorder.flush(timeout_s)


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
