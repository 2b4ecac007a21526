"""What only a real connection shows: refusals below the application, WebSockets turned away, a prompt end."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from websockets import Origin
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.server import MAX_CONNECTIONS, MAX_HEAD_BYTES, SPARE_FILES, max_connections
from tests.service.live import LiveService, live_service
from tests.service.under_test import CLIP

PATIENCE_S = 20.0


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveService]:
    with live_service(tmp_path) as running:
        yield running


def submitted(live: LiveService) -> str:
    """The id of a job that waits."""
    job_id: str = httpx.post(f"{live.url}/reconstruct", files={"clip": ("a.mp4", CLIP)}).json()["id"]
    return job_id


def answer_to(live: LiveService, request: bytes) -> tuple[bytes, dict[str, str], bytes]:
    """Status line, headers and body of what raw bytes are answered with, until the connection is closed."""
    with socket.create_connection(("127.0.0.1", live.port), timeout=PATIENCE_S) as connection:
        connection.sendall(request)
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
    head, _, body = answer.partition(b"\r\n\r\n")
    status, *lines = head.decode().split("\r\n")
    return status.encode(), dict(line.lower().split(": ", 1) for line in lines), body


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"nonsense\r\n\r\n",
        b"POST /reconstruct HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: ten\r\n\r\n",
        b"POST /reconstruct HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * MAX_HEAD_BYTES,  # and no end
    ],
)
def test_what_is_no_http_is_answered_with_a_problem(live: LiveService, request_bytes: bytes) -> None:
    status, headers, body = answer_to(live, request_bytes)
    assert status.startswith(b"HTTP/1.1 4")
    assert headers["content-type"] == "application/problem+json"
    assert json.loads(body)["status"] == 400


@pytest.mark.parametrize(
    ("address", "origin", "status"),
    [
        ("127.0.0.1/nothing", None, 404),
        ("127.0.0.1/stream", Origin("https://evil.example"), 403),
        ("rebound.example/stream", None, 403),
    ],
)
def test_a_websocket_that_is_turned_away_is_told_why_and_is_no_fault(
    live: LiveService, caplog: pytest.LogCaptureFixture, address: str, origin: Origin | None, status: int
) -> None:
    host, path = address.split("/")
    with (
        socket.create_connection(("127.0.0.1", live.port)) as connection,
        pytest.raises(InvalidStatus) as caught,
        connect(f"ws://{host}:{live.port}/{path}", sock=connection, origin=origin),
    ):
        pass
    answer = caught.value.response
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["x-request-id"]
    assert answer.body is not None
    assert json.loads(answer.body)["status"] == status
    assert [line for line in caplog.records if line.levelname == "ERROR"] == []


def test_an_upload_whose_caller_leaves_keeps_what_came(live: LiveService) -> None:
    tus = {"Tus-Resumable": "1.0.0"}
    announced = {**tus, "Upload-Length": "1000000", "Upload-Metadata": "part Y2xpcA==,suffix Lm1wNA=="}
    path = httpx.post(f"{live.url}/uploads", headers=announced).headers["location"]
    head = (
        f"PATCH {path} HTTP/1.1\r\nHost: 127.0.0.1:{live.port}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
        "Content-Type: application/offset+octet-stream\r\nContent-Length: 1000000\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", live.port), timeout=PATIENCE_S) as connection:
        connection.sendall(head.encode() + b"x" * 400_000)
        offset = 0
        while offset < 400_000:
            offset = int(httpx.head(live.url + path, headers=tus).headers["upload-offset"])
    piece = {**tus, "Upload-Offset": "400000", "Content-Type": "application/offset+octet-stream"}
    status = 423
    while status == 423:  # until the service has noticed
        status = httpx.patch(live.url + path, headers=piece, content=b"y" * 600_000).status_code
    assert status == 204


def test_a_stream_of_events_ends_when_the_service_is_asked_to(live: LiveService) -> None:
    job_id = submitted(live)
    with httpx.stream("GET", f"{live.url}/jobs/{job_id}/events", timeout=PATIENCE_S) as stream:
        lines = stream.iter_lines()
        assert next(line for line in lines if line.startswith("data"))
        live.server.handle_exit(signal.SIGTERM, None)
        assert list(lines)[-1:] == [""]
    live.thread.join(PATIENCE_S)
    assert not live.thread.is_alive()


def test_what_is_too_much_at_once_is_told_to_come_back(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.request_log.MAX_OPEN", 2)
    events = f"{live.url}/jobs/{submitted(live)}/events"
    with httpx.stream("GET", events) as first, httpx.stream("GET", events) as second:
        streams = [first.iter_lines(), second.iter_lines()]  # kept: one that is dropped closes its connection
        assert [next(lines) for lines in streams] == ["retry: 2000"] * 2
        refused = httpx.get(f"{live.url}/jobs")
        assert (refused.status_code, refused.headers["content-type"]) == (503, "application/problem+json")
        assert refused.headers["retry-after"]
        live.server.handle_exit(signal.SIGTERM, None)


def test_many_listeners_leave_the_service_free_for_others(live: LiveService) -> None:
    job_id = submitted(live)
    endings: list[str] = []

    def listen() -> None:
        endings.append(httpx.get(f"{live.url}/jobs/{job_id}/events", timeout=PATIENCE_S).text)

    listeners = [threading.Thread(target=listen) for _ in range(60)]  # more than the thread pool has threads
    for listener in listeners:
        listener.start()
    assert httpx.get(f"{live.url}/jobs/{job_id}", timeout=PATIENCE_S).status_code == 200
    assert httpx.delete(f"{live.url}/jobs/{job_id}", timeout=PATIENCE_S).json()["state"] == "cancelled"
    for listener in listeners:
        listener.join()
    assert len(endings) == 60
    assert all("cancelled" in ending for ending in endings)


@pytest.mark.parametrize("started", [b"", b"GET /healthz", b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n"])
@pytest.mark.parametrize("first", [b"", b"Content-Length: 9\r\n"])  # a body that no route reads, and never comes
def test_a_head_that_does_not_end_holds_no_connection(
    live: LiveService, monkeypatch: pytest.MonkeyPatch, first: bytes, started: bytes
) -> None:
    monkeypatch.setattr("service.server.HEAD_S", 0.1)
    with socket.create_connection(("127.0.0.1", live.port), timeout=PATIENCE_S) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n" + first + b"\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 200")
        if started:
            connection.sendall(started)
        while connection.recv(65536):
            pass


def test_a_long_answer_is_not_taken_for_a_silent_connection(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.server.HEAD_S", 0.05)
    job_id = submitted(live)
    with httpx.stream("GET", f"{live.url}/jobs/{job_id}/events", timeout=PATIENCE_S) as stream:
        lines = stream.iter_lines()
        assert next(line for line in lines if line.startswith("data"))
        time.sleep(0.3)
        httpx.delete(f"{live.url}/jobs/{job_id}")
        assert any("cancelled" in line for line in lines)


def test_connections_beyond_the_limit_are_closed_and_those_below_it_answered(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.server.BACKLOG", 0)
    live.server.config.limit_concurrency = 4  # read by each new connection
    with contextlib.ExitStack() as held:
        for _ in range(4):
            held.enter_context(socket.create_connection(("127.0.0.1", live.port), timeout=PATIENCE_S))
        fifth = held.enter_context(socket.create_connection(("127.0.0.1", live.port), timeout=PATIENCE_S))
        assert fifth.recv(1) == b""
    assert httpx.get(f"{live.url}/healthz").status_code == 200


def test_the_files_that_a_process_may_open_bound_its_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = [(1024, 524_288)]
    monkeypatch.setattr("resource.getrlimit", lambda kind: limits[-1])
    monkeypatch.setattr("resource.setrlimit", lambda kind, limit: limits.append(limit))
    assert max_connections() == MAX_CONNECTIONS
    assert limits[-1] == (MAX_CONNECTIONS + SPARE_FILES, 524_288)
    limits.append((1024, 1024))
    assert max_connections() == 1024 - SPARE_FILES
