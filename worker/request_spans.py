"""Trace spans of a request at a worker: all of it since its arrival, and its wait (contract/runtime/traces.py)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from contract.runtime import traces
from worker.request_queue import WaitingRequest


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
