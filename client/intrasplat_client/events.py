"""Follows a job by server-sent events, resumed where a stream was cut off; by polling where events do not arrive."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from dataclasses import dataclass, field

import httpx

from intrasplat_client.connection import Answer, Call
from intrasplat_client.errors import JobCancelled, JobFailed, JobRejected, ServiceUnavailable, Unreachable
from intrasplat_client.models import TERMINAL_STATES, JobState, JobView
from intrasplat_client.session import Session, error_of, parsed

POLL_S = 1.0
RECONNECT_S = 0.5
MAX_EMPTY_STREAMS = 3
"""After this many streams in a row without any event, a proxy is assumed to hold events back."""
NO_EVENTS_HERE = frozenset({404, 405, 406, 501})
"""Statuses of a service without events. A job that does not exist answers 404 as well; the poll then says so."""


@dataclass
class EventReader:
    """Joins lines of text/event-stream into events (WHATWG HTML, 9.2.6)."""

    last_id: str | None = None
    _data: list[str] = field(default_factory=list)

    def take(self, line: str) -> str | None:
        """The data of the event that ends with this line; None for any other line."""
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
        """Forget the event that a cut stream left incomplete."""
        self._data = []


async def watch(session: Session, path: str) -> AsyncGenerator[JobView, None]:
    """Yield the job at `path` after each change, the last time in its terminal state."""
    events, patience, empty, is_known = EventReader(), session.patience(), 0, False
    while empty < MAX_EMPTY_STREAMS:
        headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": events.last_id} if events.last_id else {})
        failure: ServiceUnavailable | None = None
        try:
            async with session.stream(Call("GET", f"{path}/events", headers=headers)) as answer:
                if has_events(answer.response):
                    empty += 1
                    async for line in answer.lines:
                        data = events.take(line)
                        if data is None:
                            continue
                        job = parsed(answer.response, JobView.model_validate_json, data)
                        yield job
                        if job.state in TERMINAL_STATES:
                            return
                        empty, is_known = 0, True
                        patience.renew()
                elif (failure := await _refusal(answer)) is None:
                    break
        except Unreachable as error:
            if error.is_nobody_there and not is_known:
                raise
            failure = error
        events.restart()
        if failure is None:
            await session.sleep(RECONNECT_S)
        else:
            await session.wait(patience, failure)
    async for job in _poll(session, path):
        yield job


async def _refusal(answer: Answer) -> ServiceUnavailable | None:
    """The failure, if another attempt may help; None: this service sends no events."""
    await answer.read()
    if answer.response.is_success or answer.response.status_code in NO_EVENTS_HERE:
        return None
    refusal = error_of(answer.response)
    if isinstance(refusal, ServiceUnavailable):
        return refusal
    raise refusal


def has_events(response: httpx.Response) -> bool:
    """Whether the response is a stream of events. 204: none will come; 200 of another type: another server answered."""
    content_type: str = response.headers.get("content-type", "")
    return response.status_code == httpx.codes.OK and content_type.startswith("text/event-stream")


async def _poll(session: Session, path: str) -> AsyncGenerator[JobView, None]:
    while True:
        response = await session.request(Call("GET", path, is_repeatable=True), is_there=True)
        job = parsed(response, JobView.model_validate_json, response.content)
        yield job
        if job.state in TERMINAL_STATES:
            return
        await session.sleep(POLL_S)


def finished(job: JobView) -> JobView:
    """Return an ended job if it is done.

    Raises:
        JobRejected, JobFailed, JobCancelled: it ended without a scene.
    """
    if job.state is JobState.CANCELLED:
        raise JobCancelled(job)
    if job.state is JobState.FAILED:
        if job.error is not None and job.error.field is not None:
            raise JobRejected(job, job.error.field, job.error.problem, job.error.remedy or "")
        raise JobFailed(job)
    return job
