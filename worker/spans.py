"""Trace spans of a worker (contract/runtime/traces.py).

A job has spans of its wait, of each attempt and of its stages; a request of its time since arrival and of its wait.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from opentelemetry.trace import INVALID_SPAN, Span, SpanKind

from contract.runtime import traces
from contract.wire.job import JobRecord
from worker.request_queue import WaitingRequest


@contextmanager
def attempt_span(record: JobRecord, worker: str) -> Iterator[Span]:
    """The span of one attempt at a job, in the trace of the request that submitted it.

    The first attempt also gets a span of the time that the job waited.
    """
    parent = record.trace or traces.NEW
    if record.attempt == 1:
        traces.begin("wait in queue", parent, since_s=record.created_at_s, job_id=record.job_id).end()
    attributes = traces.Attributes(job_id=record.job_id, attempt=record.attempt, worker=worker)
    with traces.span("attempt", parent, kind=SpanKind.CONSUMER, **attributes) as span:
        yield span


class StageSpans:
    """A span for each stage, until the next stage or the end."""

    def __init__(self) -> None:
        self._stage = ""
        self._span: Span = INVALID_SPAN

    def reached(self, stage: str) -> None:
        """Note the stage that the job has reached."""
        if stage != self._stage:
            self.end()
            self._stage, self._span = stage, traces.begin(stage)

    def end(self, failed: str | None = None) -> None:
        """End the last span. failed: the type of the error that ended the last stage."""
        if failed is not None:
            traces.fail(self._span, failed)
        self._span.end()
        self._stage, self._span = "", INVALID_SPAN


@contextmanager
def answer_span(queued: WaitingRequest) -> Iterator[None]:
    """The span of an answer in progress; spans that start in the context become its children."""
    came_s = _came_s(queued)
    with traces.span(queued.request.kind, queued.trace or traces.NEW, since_s=came_s, job_id=queued.request.scene_id):
        traces.begin("wait for turn", since_s=came_s).end()
        yield


def shared_span(queued: WaitingRequest) -> None:
    """The span of a request that shares the answer to another, equal request."""
    attributes = traces.Attributes(job_id=queued.request.scene_id, shared=True)
    traces.begin(queued.request.kind, queued.trace or traces.NEW, since_s=_came_s(queued), **attributes).end()


def _came_s(queued: WaitingRequest) -> float:
    return time.time() - (time.monotonic() - queued.arrived_s)
