"""What listeners hear of a job: everything, in order, once, and then the end."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from typing import Any

import httpx
import pytest

from contract.queue.interface import Event
from contract.store.shelf import new_job_id
from contract.wire.job import JobError, JobFiles, JobProgress, JobRecord
from intrasplat.errors import UnavailableError
from service.events import NOTHING_SEEN, JobChannels
from tests.memory_queue import MemoryQueue
from tests.service.under_test import ServiceUnderTest, assert_problem

PATIENCE_S = 20.0


def told(response: httpx.Response) -> list[dict[str, Any]]:
    """The events of a stream: their fields by name, `data` as the JSON it holds."""
    events = []
    for block in response.text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":") and ": " in line)
        if "data" in fields:
            events.append({**fields, "data": json.loads(fields["data"])})
    return events


def states(events: list[dict[str, Any]]) -> list[str]:
    return [event["data"]["state"] for event in events]


def ended_job(service: ServiceUnderTest) -> str:
    job_id: str = service.upload().json()["id"]
    _, claim = service.claimed()
    service.queue.beat(claim, JobProgress(stage="train", fraction=0.5, psnr_db=31.0))
    service.queue.fail(claim, JobError(problem="no depth."))
    return job_id


def test_a_stream_tells_all_that_happened_in_order_and_ends_with_the_job(service: ServiceUnderTest) -> None:
    job_id = ended_job(service)
    response = service.http.get(f"/jobs/{job_id}/events")
    assert response.headers["content-type"].startswith("text/event-stream")
    assert response.headers["x-accel-buffering"] == "no"
    assert response.headers["cache-control"] == "no-store"
    assert "retry: 2000" in response.text
    events = told(response)
    assert states(events) == ["queued", "running", "running", "failed"]
    assert events[2]["data"]["psnr_db"] == 31.0
    assert {event["event"] for event in events} == {"job"}


def test_whoever_comes_back_hears_what_it_missed_and_nothing_twice(service: ServiceUnderTest) -> None:
    job_id = ended_job(service)
    events = told(service.http.get(f"/jobs/{job_id}/events"))
    for index, event in enumerate(events[:-1]):
        rest = told(service.http.get(f"/jobs/{job_id}/events", headers={"Last-Event-ID": event["id"]}))
        assert rest == events[index + 1 :]
    known = service.http.get(f"/jobs/{job_id}/events", headers={"Last-Event-ID": events[-1]["id"]})
    assert known.status_code == 204


def test_a_last_event_that_never_was_is_no_fault(service: ServiceUnderTest) -> None:
    job_id = ended_job(service)
    for number in ("nonsense", "-1", "9" * 40, "1-", "\u00b2"):
        response = service.http.get(f"/jobs/{job_id}/events", headers={"Last-Event-ID": number.encode()})
        assert len(told(response)) == 4


def test_a_job_that_is_not_there_is_a_problem_and_no_stream(service: ServiceUnderTest) -> None:
    assert_problem(service.http.get(f"/jobs/{'0' * 32}/events"), 404, "job_id")


def test_a_stream_goes_on_while_the_job_does(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]

    def work() -> None:
        for _ in range(100):  # until somebody listens
            if service.queue.figures().queued == 0:
                break
            time.sleep(0.01)
        service.queue.fail(claim, JobError(problem="no depth."))

    _, claim = service.claimed()
    worker = threading.Timer(0.3, work)
    worker.start()
    events = told(service.http.get(f"/jobs/{job_id}/events"))
    worker.join()
    assert states(events)[-1] == "failed"


def test_a_purged_job_ends_the_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.events.LOOK_PERIOD_S", 0.0)
    queue, job_id = submitted()

    async def listen() -> list[bytes]:
        pieces = []
        async for piece in JobChannels(queue).stream(job_id, NOTHING_SEEN):
            pieces.append(piece)
            if b"queued" in piece:
                queue.cancelled_and_forgotten(job_id)
        return pieces

    assert b"cancelled" not in asyncio.run(limited(listen()))[-1]


def test_a_position_in_the_queue_that_moves_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.events.LOOK_PERIOD_S", 0.0)
    queue, first = submitted()
    second = new_job_id()
    queue.submit(record(second))

    async def listen() -> list[int]:
        positions: list[int] = []
        async for piece in JobChannels(queue).stream(second, NOTHING_SEEN):
            if b"data:" not in piece:
                continue
            position = json.loads(piece.split(b"data: ", 1)[1].splitlines()[0])["position"]
            positions += [] if position is None else [position]
            if positions[-1:] == [1]:
                queue.cancel(first)
            if positions[-1:] == [0]:
                break
        return positions

    assert asyncio.run(limited(listen())) == [1, 0]


def test_many_listeners_share_one_poller_and_a_silent_queue_costs_them_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.events.POLL_PERIOD_S", 0.01)
    queue, job_id = submitted()
    channels = JobChannels(queue)

    async def listen() -> bytes:
        return b"".join([piece async for piece in channels.stream(job_id, NOTHING_SEEN)])

    async def all_of_them() -> list[bytes]:
        listeners = [asyncio.create_task(listen()) for _ in range(50)]
        await asyncio.sleep(0.1)
        queue.is_away = True
        await asyncio.sleep(0.05)
        queue.is_away = False
        assert queue.most_at_once == 1
        queue.cancel(job_id)
        return await asyncio.gather(*listeners)

    heard = asyncio.run(limited(all_of_them()))
    assert all(each.count(b"cancelled") == heard[0].count(b"cancelled") > 0 for each in heard)
    assert channels._channels == {}


def test_the_end_of_the_service_ends_every_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.events.POLL_PERIOD_S", 0.01)
    queue, job_id = submitted()
    channels = JobChannels(queue)

    async def listen() -> int:
        count = 0
        async for _ in channels.stream(job_id, NOTHING_SEEN):
            count += 1
            channels.end()
        return count

    assert asyncio.run(limited(listen())) > 0


def test_silence_is_filled_with_heartbeats(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.events.HEARTBEAT_S", 0.01)
    queue, job_id = submitted()

    async def listen() -> bytes:
        async for piece in JobChannels(queue).stream(job_id, NOTHING_SEEN):
            if piece.startswith(b":"):
                return piece
        return b""

    assert asyncio.run(limited(listen())).endswith(b"\n\n")


class WatchedQueue(MemoryQueue):
    """Counts how many ask it for events at once, and can be away."""

    is_away = False
    most_at_once = 0
    _asking = 0

    def events(self, job_id: str, after: str = "0") -> list[Event]:
        if self.is_away:
            raise UnavailableError("The queue does not answer.", "Start it.")
        self._asking += 1
        self.most_at_once = max(self.most_at_once, self._asking)
        try:
            return super().events(job_id, after)
        finally:
            self._asking -= 1

    def cancelled_and_forgotten(self, job_id: str) -> None:
        """Purge it."""
        self.cancel(job_id)
        self.forget(job_id)


def record(job_id: str) -> JobRecord:
    return JobRecord(job_id=job_id, files=JobFiles(clip="clip.mp4"), created_at_s=time.time())


def submitted() -> tuple[WatchedQueue, str]:
    queue, job_id = WatchedQueue(), new_job_id()
    queue.submit(record(job_id))
    return queue, job_id


async def limited(work: Any) -> Any:
    """What the work comes to; TimeoutError if it does not end."""
    async with asyncio.timeout(PATIENCE_S):
        return await work
