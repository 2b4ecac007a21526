"""Following a job: server-sent events, taken up again where they were cut off, or polling where none come through."""

from __future__ import annotations

from dataclasses import dataclass, field

import httpx

from client.errors import JobCancelled, JobFailed, JobRejected, ServiceUnavailable, Unreachable
from client.steps import Call, Listen, NextLine, Patience, Pause, Show, Steps, answered, error_of
from contract.wire.job import TERMINAL_STATES, JobState, JobView

POLL_S = 1.0
RECONNECT_S = 0.5
FRUITLESS_STREAMS = 3
"""Streams in a row that bring nothing: something in between keeps events back."""
NO_EVENTS_HERE = frozenset({404, 405, 406, 501})
"""Statuses of a service without events; of a job that is not there too, which the poll then tells."""


@dataclass
class EventReader:
    """Puts lines of text/event-stream together (WHATWG HTML, 9.2.6)."""

    last_id: str | None = None
    _data: list[str] = field(default_factory=list)

    def take(self, line: str) -> str | None:
        """The data of the event that ends with this line; comments and other fields pass."""
        if not line:
            data, self._data = "\n".join(self._data), []
            return data or None
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if name == "data":
            self._data.append(value)
        elif name == "id" and "\0" not in value:
            self.last_id = value
        return None

    def restart(self) -> None:
        """The stream was cut off: what has come of an event is void."""
        self._data = []


def watch(job_id: str, patience_s: float) -> Steps[None]:
    """Show the job whenever something happens to it, the last time in its terminal state."""
    events, patience, fruitless, is_known = EventReader(), Patience(patience_s), 0, False
    while fruitless < FRUITLESS_STREAMS:
        headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": events.last_id} if events.last_id else {})
        try:
            response: httpx.Response = yield Listen(Call("GET", f"/jobs/{job_id}/events", headers=headers))
            if not has_events(response):
                if response.is_success or response.status_code in NO_EVENTS_HERE:
                    break
                refusal = error_of(response)
                if not isinstance(refusal, ServiceUnavailable):
                    raise refusal
                yield patience.pause(refusal)
                continue
            fruitless += 1
            while (line := (yield NextLine())) is not None:
                data = events.take(line)
                if data is not None:
                    job = JobView.model_validate_json(data)
                    yield Show(job)
                    if job.state in TERMINAL_STATES:
                        return
                    fruitless, is_known = 0, True
                    patience.renew()
            yield Pause(RECONNECT_S)
        except Unreachable as failure:
            if failure.is_nobody_there and not is_known:
                raise
            yield patience.pause(failure)
        events.restart()
    yield from _poll(job_id, patience_s)


def has_events(response: httpx.Response) -> bool:
    """Whether it is a stream of events; 204 says that there is none to come, 200 of another type is not ours."""
    content_type: str = response.headers.get("content-type", "")
    return response.status_code == httpx.codes.OK and content_type.startswith("text/event-stream")


def _poll(job_id: str, patience_s: float) -> Steps[None]:
    patience = Patience(patience_s)
    while True:
        try:
            response = yield from answered(Call("GET", f"/jobs/{job_id}"), patience_s=0.0)
        except ServiceUnavailable as failure:
            yield patience.pause(failure)
            continue
        patience.renew()
        job = JobView.model_validate_json(response.content)
        yield Show(job)
        if job.state in TERMINAL_STATES:
            return
        yield Pause(POLL_S)


def settled(job: JobView) -> JobView:
    """A job that has ended, if it is done.

    Raises:
        JobRejected, JobFailed, JobCancelled: it did not come to a scene.
    """
    if job.state is JobState.CANCELLED:
        raise JobCancelled(job)
    if job.state is JobState.FAILED:
        if job.error is not None and job.error.field is not None:
            raise JobRejected(job, job.error.field, job.error.problem, job.error.remedy or "")
        raise JobFailed(job)
    return job
