"""Spans of service, queue, worker and renders: where they go, how they hang together, and what they never hold."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from opentelemetry.sdk.trace.export import SpanExporter, SpanExportResult
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import INVALID_SPAN, SpanKind

from contract.queue.embedded import EmbeddedServer
from contract.runtime import traces
from contract.runtime.otlp import Recorder
from contract.runtime.settings import Settings
from intrasplat_client import Client
from lab.demo import free_port, started_service
from service import webhooks
from tests.collector import Seen, collecting
from tests.intrasplat.clip.hostile import CALIBRATION, VIDEO
from tests.receiver import Receiver
from tests.service.live import live_service
from tests.service.telling import cancelled, log_of, telling
from tests.service.test_logs import MARKER, say_it_everywhere
from tests.service.under_test import CLIP, Painter, ServiceUnderTest, running_service
from tests.test_repository import REPOSITORY

CALLERS_TRACE, CALLERS_SPAN = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
TRACEPARENT = f"00-{CALLERS_TRACE}-{CALLERS_SPAN}-01"
STAGES = {"fetch", "decode", "stereo", "motion", "fusion", "train", "finish", "publish", "score"}


@pytest.fixture
def exporter() -> Iterator[InMemorySpanExporter]:
    """Of the spans of this process; ended spans are in it after traces.flush()."""
    memory = InMemorySpanExporter()
    traces.use(Recorder("test", exporter=memory))
    yield memory
    traces.use(None)


@pytest.fixture
def service(tmp_path: Path, exporter: InMemorySpanExporter) -> Iterator[ServiceUnderTest]:
    del exporter  # traces are on
    yield from running_service(tmp_path)


def children(spans: list[Seen], parent: Seen) -> set[str]:
    return {each.name for each in spans if each.parent_id == parent.span_id}


def test_one_trace_leads_from_a_request_through_the_queue_and_every_stage_of_the_worker_and_one_through_a_render(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with collecting() as collector:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", collector.endpoint)
        monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "200")
        with started_service(tmp_path / "data", tmp_path / "service.log") as client:
            files = {"clip": (f"{MARKER}.mp4", VIDEO.read_bytes()), "calibration": (f"{MARKER}.json", CALIBRATION)}
            options = {"options": '{"iterations": 30}', "label": MARKER}
            headers = {"traceparent": TRACEPARENT}
            sent = httpx.post(f"{client.url}/reconstruct", files=files, data=options, headers=headers)
            job_id = sent.json()["id"]
            client.wait(job_id)
            view = httpx.get(f"{client.url}/render", params={"scene": job_id, "t": "0.25", "width": "64"}).headers
            collector.wait_for("score", "encode", "GET /render", "attempt")
    spans = collector.spans
    of_job = [each for each in spans if each.trace_id == CALLERS_TRACE]
    (request,) = [each for each in of_job if each.name == "POST /reconstruct"]
    (attempt,) = [each for each in of_job if each.name == "attempt"]
    assert request.parent_id == CALLERS_SPAN
    assert sent.headers["X-Request-Id"] == CALLERS_TRACE
    assert {"receive", "check", "spool", "enqueue", "wait in queue", "attempt", "score"} <= children(of_job, request)
    assert children(of_job, attempt) >= STAGES - {"score"}
    assert attempt.attributes == {
        "intrasplat.job_id": job_id,
        "intrasplat.attempt": 1,
        "intrasplat.worker": "worker-1",
        "intrasplat.outcome": "done",
    }
    (shown,) = [each for each in spans if each.name == "GET /render"]
    of_view = [each for each in spans if each.trace_id == shown.trace_id]
    assert shown.parent_id == ""
    assert shown.trace_id == view["X-Request-Id"] != CALLERS_TRACE
    (asked,) = [each for each in of_view if each.name == "ask worker"]
    (answered,) = [each for each in of_view if each.name == "render"]
    assert children(of_view, shown) == {"find", "ask worker"}
    assert children(of_view, asked) == {"render"}
    assert children(of_view, answered) == {"wait for turn", "load", "draw", "encode"}
    processes = {each.name: each.process for each in spans}
    assert processes["attempt"] == "intrasplat-worker"
    assert processes["render"] == "intrasplat-device"
    assert MARKER.encode() not in collector.content
    assert "trace_id=" + CALLERS_TRACE in (tmp_path / "service.log").read_text()


def test_spans_hold_nothing_that_a_caller_wrote(service: ServiceUnderTest, exporter: InMemorySpanExporter) -> None:
    scene = service.finished_scene()
    say_it_everywhere(service)
    query = {"scene": scene, "t": "0.123456", "pose": "orbit:1.5,2.5,1"}
    assert service.http.get("/render", params=query).status_code == 200
    service.http.request(MARKER, "/jobs")
    service.http.get("/jobs", headers={"traceparent": MARKER, "tracestate": MARKER, "baggage": MARKER})
    traces.flush()
    spans = exporter.get_finished_spans()
    assert {each.name for each in spans} >= {"POST /reconstruct", "GET /render", "render", "_OTHER /jobs"}
    told = " ".join(each.to_json() for each in spans)
    for private in (MARKER, "0.123456", "orbit", "a.mp4", "127.0.0.1"):
        assert private not in told


def test_a_fault_is_told_by_its_type_and_a_refusal_by_its_status(
    service: ServiceUnderTest, exporter: InMemorySpanExporter
) -> None:
    assert service.http.get("/render", params={"scene": service.finished_scene(), "width": "10"}).status_code == 500
    assert service.http.get("/jobs/no-such-job").status_code == 404
    traces.flush()
    spans = {each.name: each for each in exporter.get_finished_spans()}
    assert dict(spans["GET /render"].attributes or {})["error.type"] == "500"
    refused = dict(spans["GET /jobs/{job_id}"].attributes or {})
    assert refused["http.response.status_code"] == 404
    assert "error.type" not in refused
    assert not any(each.events for each in exporter.get_finished_spans())


def test_probes_have_no_spans(service: ServiceUnderTest, exporter: InMemorySpanExporter) -> None:
    for path in ("/healthz", "/readyz", "/metrics"):
        service.http.get(path)
    traces.flush()
    assert exporter.get_finished_spans() == ()


def test_a_job_of_the_queue_names_the_trace_and_no_json_of_it_does(
    service: ServiceUnderTest, exporter: InMemorySpanExporter
) -> None:
    """So older services and workers, which refuse unknown fields, read it."""
    del exporter
    headers = {"traceparent": TRACEPARENT}
    job_id = service.http.post("/reconstruct", files={"clip": ("a.mp4", CLIP)}, headers=headers).json()["id"]
    record, _ = service.claimed()
    assert record.trace is not None
    assert record.trace.split("-")[1] == CALLERS_TRACE
    assert CALLERS_TRACE not in record.model_dump_json()
    submission = service.store.submission(job_id)
    assert submission is not None
    assert submission.trace is None


def test_each_try_of_a_webhook_is_a_span_in_the_trace_of_its_job(
    tmp_path: Path, exporter: InMemorySpanExporter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhooks, "FIRST_WAIT_S", 0.001)
    with Receiver(503) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/{MARKER}?token={MARKER}", traceparent=TRACEPARENT)
        log_of(service, job_id, lambda delivery: delivery["status"] == "delivered")
    traces.flush()
    tries = [each for each in exporter.get_finished_spans() if each.name == "deliver webhook"]
    assert {each.context and format(each.context.trace_id, "032x") for each in tries} == {CALLERS_TRACE}
    assert {each.kind for each in tries} == {SpanKind.CLIENT}
    of_each = {"http.request.method": "POST", "server.address": "127.0.0.1", "intrasplat.job_id": job_id}
    assert [dict(each.attributes or {}) for each in tries] == [
        of_each | {"http.response.status_code": 503, "error.type": "status"},
        of_each | {"http.response.status_code": 204},
    ]
    assert not any(MARKER in each.to_json() for each in tries)


class Away(SpanExporter):
    """A collector that takes nothing, after a while."""

    def export(self, spans: object) -> SpanExportResult:
        time.sleep(0.2)
        return SpanExportResult.FAILURE


def test_a_collector_that_is_away_costs_spans_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_BSP_MAX_QUEUE_SIZE", "4")
    monkeypatch.setenv("OTEL_BSP_MAX_EXPORT_BATCH_SIZE", "2")
    traces.use(Recorder("test", exporter=Away()))
    try:
        for service in running_service(tmp_path):
            for _ in range(20):
                assert service.http.get("/jobs").status_code == 200
            traces.flush()
            (line,) = [
                each
                for each in service.http.get("/metrics").text.splitlines()
                if each.startswith("intrasplat_spans_dropped_total ")
            ]
            assert 14 <= float(line.split()[1]) == traces.dropped() <= 20
    finally:
        traces.use(None)


def test_a_caller_whose_trace_is_not_sampled_has_no_spans(
    service: ServiceUnderTest, exporter: InMemorySpanExporter
) -> None:
    service.http.get("/jobs", headers={"traceparent": TRACEPARENT.removesuffix("01") + "00"})
    traces.flush()
    assert exporter.get_finished_spans() == ()


def test_without_the_variables_no_span_is_made_and_no_sdk_imported() -> None:
    program = (
        "import sys, service.__main__, worker.supervisor; from contract.runtime import traces; "
        "traces.configure('service', environment={}); traces.begin('x').end(); "
        "print([each for each in ('contract.runtime.otlp', 'opentelemetry.sdk.trace') if each in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


def is_up(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


SERVICE_WITHOUT_THE_EXTRA = """
import sys
sys.modules["opentelemetry.sdk"] = sys.modules["opentelemetry.exporter"] = None
from service.__main__ import main
sys.exit(main())
"""


def test_a_service_without_the_extra_says_so_and_works(tmp_path: Path) -> None:
    server, log = EmbeddedServer(tmp_path), tmp_path / "service.log"
    server.start()
    settings = Settings(data_dir=tmp_path, port=free_port(), redis_url=server.url, min_free_bytes=0)
    environment = settings.to_environment() | {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}
    command = [sys.executable, "-c", SERVICE_WITHOUT_THE_EXTRA]
    with log.open("wb") as messages:
        process = subprocess.Popen(command, env=environment, cwd=REPOSITORY, stdout=messages, stderr=messages)
    try:
        with Client(f"http://127.0.0.1:{settings.port}") as client:
            while b"listening" not in log.read_bytes() or not is_up(settings.port):
                assert process.poll() is None
                time.sleep(0.05)
            assert client.reconstruct(VIDEO).state == "queued"
    finally:
        process.terminate()
        process.wait(20)
        server.stop()
    assert "traces are off: opentelemetry" in log.read_text()
    assert "pip install 'intrasplat-server[otel]'" in log.read_text()


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"OTEL_TRACES_EXPORTER": "jaeger"}, "OTEL_TRACES_EXPORTER names another exporter"),
        ({"OTEL_TRACES_EXPORTER": "otlp", "OTEL_EXPORTER_OTLP_PROTOCOL": "grpc"}, "another protocol"),
        ({"OTEL_TRACES_EXPORTER": "none", "OTEL_EXPORTER_OTLP_ENDPOINT": "http://x"}, ""),
        ({"OTEL_SDK_DISABLED": "true", "OTEL_EXPORTER_OTLP_ENDPOINT": "http://x"}, ""),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": ""}, ""),
    ],
)
def test_what_cannot_be_sent_is_said_and_what_is_switched_off_is_not(
    variables: dict[str, str], said: str, caplog: pytest.LogCaptureFixture
) -> None:
    traces.configure("service", environment=variables)
    assert traces.begin("x", TRACEPARENT) is INVALID_SPAN
    assert said in caplog.text
    assert bool(said) == bool(caplog.text)


def test_each_view_of_a_stream_is_a_trace(tmp_path: Path, exporter: InMemorySpanExporter) -> None:
    with live_service(tmp_path, Painter().answer) as running:
        scene = running.finished_scene()
        with Client(running.url) as client, client.stream(scene) as viewer:
            for t in (0.1, 0.2):
                viewer.render(t)
    traces.flush()
    spans = exporter.get_finished_spans()
    views = [each.context.trace_id for each in spans if each.name == "view of /stream" and each.context]
    rendered = [each.context.trace_id for each in spans if each.name == "render" and each.context]
    assert len(set(views)) == 2
    assert sorted(views) == sorted(rendered)
