"""What the service writes to its log: enough to find a fault, and nothing that may name a patient."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest

from contract.runtime.logs import configure
from contract.runtime.settings import Settings
from tests.service.test_tus import TUS, metadata
from tests.service.under_test import ServiceUnderTest, running_service

MARKER = "Smith-Jane-1961"


@pytest.fixture(autouse=True)
def _logging_as_it_was() -> Iterator[None]:
    root, hook, thread_hook = logging.getLogger(), sys.excepthook, threading.excepthook
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    sys.excepthook, threading.excepthook = hook, thread_hook
    logging.captureWarnings(False)
    logging.raiseExceptions = True


def say_it_everywhere(service: ServiceUnderTest) -> None:
    """Requests that carry the marker wherever a caller can put one; most are refused."""
    service.upload(parts={"clip": (f"{MARKER}.mp4", b"x")}, headers={"Idempotency-Key": MARKER})
    service.upload(parts={"clip": (f"{MARKER}.exe", b"x")})
    service.upload(parts={MARKER: ("a.mp4", b"x")})
    service.upload(f'{{"holdout": "{MARKER}", "{MARKER}": 1}}')
    service.http.post("/reconstruct", json={MARKER: MARKER, "clip": MARKER})
    for values in ({"part": "clip", "filename": f"{MARKER}.mp4"}, {"part": MARKER}):
        headers = {**TUS, "Upload-Length": "5", "Upload-Metadata": metadata(**values)}
        service.http.post("/uploads", headers=headers)
    for path in (f"/{MARKER}", f"/jobs/{MARKER}", f"/jobs/{MARKER}/events", f"/uploads/{MARKER}", f"/scenes/{MARKER}"):
        service.http.get(path, headers=TUS)
    service.http.get("/render", params={"t": MARKER, "scene": MARKER, MARKER: MARKER})
    for name in (
        "User-Agent",
        "X-Request-Id",
        "Authorization",
        "X-Api-Key",
        "Origin",
        "Host",
        "Last-Event-ID",
        "Cookie",
    ):
        service.http.get("/jobs", headers={name: MARKER})


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_nothing_a_caller_says_is_in_the_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], log_format: Literal["text", "json"]
) -> None:
    configure(Settings(data_dir=tmp_path, log_format=log_format), "service")
    for service in running_service(tmp_path):
        say_it_everywhere(service)
    log = capsys.readouterr().err
    assert "/jobs/{job_id}" in log
    assert MARKER not in log
    assert "Smith" not in log


def test_each_answer_is_a_line_with_the_id_that_the_caller_was_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configure(Settings(data_dir=tmp_path, log_format="json"), "service")
    for service in running_service(tmp_path):
        answer = service.http.get(f"/jobs/{'0' * 32}")
        service.http.get("/healthz")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    (line,) = [line for line in lines if line["message"] == "answered"]
    assert line.pop("duration_ms") >= 0
    assert line.pop("time")
    assert line == {
        "level": "info",
        "process": "service",
        "logger": "intrasplat.access",
        "message": "answered",
        "request_id": answer.headers["x-request-id"],
        "method": "GET",
        "route": "/jobs/{job_id}",
        "status": 404,
    }


def test_probes_are_logged_when_they_begin_to_fail_and_when_they_work_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configure(Settings(data_dir=tmp_path, log_format="json"), "service")
    for service in running_service(tmp_path):
        (worker,) = service.queue.workers()
        for status in (200, 503, 200):
            if status == 503:
                service.queue.withdraw(worker.name)
            else:
                service.queue.announce(worker)
            assert {service.http.get("/readyz").status_code for _ in range(3)} == {status}
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["status"] for line in lines if line["message"] == "answered"] == [503, 200]


def test_a_fault_is_logged_with_where_it_was_and_without_its_text(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    configure(Settings(data_dir=tmp_path, log_format="json"), "service")

    def broken(*_: object) -> None:
        raise RuntimeError(MARKER)

    for service in running_service(tmp_path):
        monkeypatch.setattr(service.queue, "workers", broken)
        answer = service.http.get("/readyz")
        assert (answer.status_code, answer.headers["content-type"]) == (500, "application/problem+json")
        assert MARKER not in answer.text
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    (fault,) = [line for line in lines if line["level"] == "error"]
    assert fault["error"] == "RuntimeError"
    assert fault["request_id"] == answer.headers["x-request-id"]
    assert any("test_logs.py" in place and "broken" in place for place in fault["trace"])
    assert MARKER not in json.dumps(lines)
    assert [line["status"] for line in lines if line["message"] == "answered"] == [500]


def test_of_other_libraries_the_template_is_logged_without_what_they_filled_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configure(Settings(data_dir=tmp_path, log_format="text"), "service")
    logging.getLogger("uvicorn.error").warning('%s - "WebSocket %s" [accepted]', "1.2.3.4", f"/stream?x={MARKER}")
    logging.getLogger("asyncio").error("Task exception was never retrieved\nfuture: %s", MARKER)
    logging.getLogger("intrasplat.service").info("hello", extra={"job_id": "a b\n", "patient": MARKER})
    log = capsys.readouterr().err
    assert MARKER not in log
    assert "Task exception was never retrieved" in log
    assert "job_id=a?b?" in log
    assert log.count("\n") == 3
