"""GET /metrics: figures that follow what happens, under labels that nobody outside can choose."""

from __future__ import annotations

from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from contract.access.keys import KeyFile, KeyScope
from contract.wire.job import JobError
from intrasplat.errors import UnavailableError
from intrasplat.version import version
from tests.service.under_test import CLIP, ServiceUnderTest, assert_problem, running_service

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def samples(service: ServiceUnderTest) -> Samples:
    response = service.http.get("/metrics")
    assert response.status_code == 200
    assert response.headers["content-type"].startswith("text/plain")
    families = text_string_to_metric_families(response.text)
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in families
        for sample in family.samples
    }


def value(found: Samples, name: str, **labels: str) -> float:
    return found.get((name, tuple(sorted(labels.items()))), 0.0)


def test_jobs_workers_and_the_version_are_told(service: ServiceUnderTest) -> None:
    service.finished_scene()
    service.upload()
    _, claim = service.claimed()
    service.queue.fail(claim, JobError(problem="no depth."))
    service.upload()
    service.claimed()
    service.upload()
    found = samples(service)
    assert value(found, "intrasplat_jobs_queued") == 1
    assert value(found, "intrasplat_jobs_running") == 1
    assert value(found, "intrasplat_jobs_ended_total", state="done") == 1
    assert value(found, "intrasplat_jobs_ended_total", state="failed") == 1
    assert value(found, "intrasplat_workers", device="cpu", trains="yes") == 1
    assert value(found, "intrasplat_queue_up") == 1
    assert value(found, "intrasplat_build_info", version=version()) == 1
    assert value(found, "intrasplat_free_bytes") > 0


def test_requests_are_counted_by_route_and_status_and_uploads_by_their_bytes(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    for path in (f"/jobs/{job_id}", f"/jobs/{'f' * 32}", "/nothing", "/nothing/else"):
        service.http.get(path)
    service.http.request("BREW", "/jobs")
    found = samples(service)
    name = "intrasplat_http_requests_total"
    assert value(found, name, method="GET", route="/jobs/{job_id}", status="200") == 1
    assert value(found, name, method="GET", route="/jobs/{job_id}", status="404") == 1
    assert value(found, name, method="GET", route="none", status="404") == 2
    assert sum(count for (each, labels), count in found.items() if each == name and ("method", "other") in labels) == 1
    assert value(found, "intrasplat_http_request_duration_seconds_count", method="GET", route="/jobs/{job_id}") == 2
    assert value(found, "intrasplat_http_received_bytes_total", route="/reconstruct") > len(CLIP)


def test_what_is_refused_is_counted_by_its_reason(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_upload_bytes=1000):
        service.upload()
        service.upload('{"colour": 1}', parts={"clip": ("a.mp4", b"x")})
        service.http.request("GET", "/jobs", headers={"X-API-Key": "no"})
        found = samples(service)
        reasons = {
            reason: value(found, "intrasplat_rejected_total", reason=reason) for reason in ("size", "input", "key")
        }
        assert reasons == {"size": 1, "input": 1, "key": 1}


def test_renders_are_timed(service: ServiceUnderTest) -> None:
    scene_id = service.finished_scene()
    service.http.get("/render", params={"scene": scene_id})
    assert value(samples(service), "intrasplat_render_duration_seconds_count", state="done") == 1


def test_no_label_holds_an_id_a_tenant_or_a_path(service: ServiceUnderTest) -> None:
    job_id = service.finished_scene()
    service.http.get(f"/jobs/{job_id}/{'secret' * 3}")
    service.http.get(f"/scenes/{job_id}")
    told = {text for _, labels in samples(service) for _, text in labels}
    assert not [text for text in told if job_id in text or "secret" in text or text == "local"]


def test_a_queue_that_is_away_is_told_and_the_rest_goes_on(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away() -> None:
        raise UnavailableError("The queue is away.", "Wait.")

    monkeypatch.setattr(service.queue, "figures", away)
    found = samples(service)
    assert value(found, "intrasplat_queue_up") == 0
    assert ("intrasplat_jobs_queued", ()) not in found
    assert value(found, "intrasplat_free_bytes") > 0


def test_on_a_network_only_a_key_for_it_reads_the_figures(tmp_path: Path) -> None:
    for service in running_service(tmp_path, host="0.0.0.0"):
        assert_problem(service.http.get("/metrics"), 401, "Authorization")
        keys = KeyFile(tmp_path)
        for scope, status in ((KeyScope.VIEW, 403), (KeyScope.OPERATE, 200)):
            _, key = keys.create("ward-3", {scope})
            assert service.http.request("GET", "/metrics", headers={"X-API-Key": key}).status_code == status
