"""A queue's server that is stopped (SIGSTOP) and answers nothing: callers hear so soon, and scenes are shown."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from contract.queue.redis_queue import RedisQueue
from service.__main__ import QUEUE_PATIENCE_S
from tests.contract.queues import RunningServer, valkey_binary
from tests.service.under_test import ServiceUnderTest, assert_problem, running_service

TOLD_WITHIN_S = 3.5
READY_WITHIN_S = 1.0


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RunningServer]:
    running = RunningServer(valkey_binary(), tmp_path / "queue")
    yield running
    running.freeze(signal.SIGCONT)
    running.stop()


@pytest.fixture
def service(tmp_path: Path, server: RunningServer) -> Iterator[ServiceUnderTest]:
    queue = RedisQueue(server.url, patience_s=QUEUE_PATIENCE_S)
    yield from running_service(tmp_path / "data", queue)


def timed(service: ServiceUnderTest, method: str, path: str, **arguments: Any) -> tuple[httpx.Response, float]:
    began_s = time.monotonic()
    response = service.http.request(method, path, **arguments)
    return response, time.monotonic() - began_s


def test_callers_hear_within_seconds_that_the_queue_does_not_answer(
    service: ServiceUnderTest, server: RunningServer
) -> None:
    scene = service.finished_scene()
    waiting = service.upload().json()["id"]
    assert service.http.get("/render", params={"scene": scene}).status_code == 200
    server.freeze()
    for path in ("/jobs", f"/jobs/{waiting}", f"/jobs/{waiting}/events"):
        response, seconds = timed(service, "GET", path)
        assert_problem(response, 503)
        assert response.headers["Retry-After"]
        assert seconds < TOLD_WITHIN_S, path
    began_s = time.monotonic()
    response = service.upload()
    assert assert_problem(response, 503, "queue")["job_id"]
    assert time.monotonic() - began_s < TOLD_WITHIN_S
    assert service.http.get("/render", params={"scene": scene}).status_code == 200


def test_readyz_says_within_a_second_that_the_queue_does_not_answer(
    service: ServiceUnderTest, server: RunningServer
) -> None:
    assert service.http.get("/readyz").status_code == 200
    server.freeze()
    for _ in range(2):
        response, seconds = timed(service, "GET", "/readyz")
        assert_problem(response, 503, "queue")
        assert seconds < READY_WITHIN_S
    server.freeze(signal.SIGCONT)
    deadline_s = time.monotonic() + 10
    while service.http.get("/readyz").status_code != 200:
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
