"""How every process logs: text or JSON lines on stderr that reveal nothing about a patient.

Clips are named after patients, and callers put anything into paths, queries and headers. So a line holds only: our own
messages, the fields below, the kind of an error and where it was raised but not its text, and the template of another
library's message without its values.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

from contract.runtime import traces
from contract.runtime.settings import Settings

OURS = "intrasplat"
"""Loggers of this name and below are ours."""

FIELDS = (
    *("request_id", "trace_id", "job_id", "attempt", "stage", "worker"),
    *("method", "route", "status", "duration_ms", "error"),
)
"""What `extra` may carry into a line."""

MAX_FIELD_CHARACTERS = 200
MAX_FRAMES = 30

_request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def current_request_id() -> str | None:
    """The id of the request that this context answers; None if there is none."""
    return _request_id.get()


@contextmanager
def answering(request_id: str) -> Iterator[None]:
    """Give lines that are logged in this context the request's id."""
    token = _request_id.set(request_id)
    try:
        yield
    finally:
        _request_id.reset(token)


def configure(settings: Settings, process: str) -> None:
    """Send the log of this process to stderr, in the format that the settings name.

    process: what it is, such as "service" or "worker"; in every line.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines(process) if settings.log_format == "json" else TextLines(process))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger(OURS).setLevel(logging.INFO)
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access"):  # they bring handlers of their own
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True
    logging.captureWarnings(True)
    logging.raiseExceptions = False  # a failing handler would print the values that a line must not hold
    sys.excepthook = _log_uncaught
    threading.excepthook = lambda args: _log_uncaught(args.exc_type, args.exc_value, args.exc_traceback)


class TextLines(logging.Formatter):
    """For people: time, level, process, message, fields."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        fields = "".join(f" {name}={value}" for name, value in fields_of(record).items())
        line = f"{_time_of(record)} {record.levelname.lower()} {self._process} {message_of(record)}{fields}"
        return "\n".join([line, *(f"    {frame}" for frame in frames_of(record))])


class JsonLines(logging.Formatter):
    """For collectors: one JSON object a line."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, object] = {
            "time": _time_of(record),
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "message": message_of(record),
            **fields_of(record),
        }
        frames = frames_of(record)
        return json.dumps(line | {"trace": frames} if frames else line)


def message_of(record: logging.LogRecord) -> str:
    """Our own message on one line; of another library's message the first line of its template."""
    if _is_ours(record):
        return " ".join(record.getMessage().split())
    if record.name == "py.warnings":
        return "a warning of Python's"
    lines = str(record.msg).strip().splitlines()
    return f"{record.name}: {lines[0][:MAX_FIELD_CHARACTERS] if lines else ''}"


def fields_of(record: logging.LogRecord) -> dict[str, object]:
    """The fields of a line that are allowed and there; the error's kind if the line tells of one."""
    given = {name: getattr(record, name, None) for name in FIELDS} if _is_ours(record) else {}
    given["request_id"] = given.get("request_id") or current_request_id()
    given["trace_id"] = traces.trace_id()
    if record.exc_info and record.exc_info[0] is not None:
        given["error"] = record.exc_info[0].__name__
    fields = {name: value for name, value in given.items() if value is not None}
    return {name: value if isinstance(value, int | float) else _short(value) for name, value in fields.items()}


def frames_of(record: logging.LogRecord) -> list[str]:
    """The places where the line's error was raised, innermost last: file, line and function, never its text."""
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return []
    frames = _places(error.__traceback__)
    if error.__cause__ is not None:
        frames += [f"because of {type(error.__cause__).__name__}", *_places(error.__cause__.__traceback__)]
    return frames[-MAX_FRAMES:]


def _places(traceback: TracebackType | None) -> list[str]:
    places = []
    while traceback is not None:
        code = traceback.tb_frame.f_code
        path = Path(code.co_filename)
        places.append(f"{path.parent.name}/{path.name}:{traceback.tb_lineno} {code.co_name}")
        traceback = traceback.tb_next
    return places


def _log_uncaught(kind: type[BaseException], error: BaseException | None, traceback: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt) or error is None:
        return
    logging.getLogger(OURS).critical("uncaught error", exc_info=(kind, error, traceback))


def _is_ours(record: logging.LogRecord) -> bool:
    return record.name == OURS or record.name.startswith(f"{OURS}.")


def _time_of(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")


def _short(value: object) -> str:
    return "".join(each if each.isprintable() and each != " " else "?" for each in str(value)[:MAX_FIELD_CHARACTERS])
