"""Labels and metadata over HTTP: given with the clip, changed later, purged, and nowhere else."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path

import pytest

from contract.access.audit import AUDIT_FILE
from contract.access.keys import KeyScope
from contract.wire.labels import Labels
from contract.wire.names import LABELS
from tests.memory_queue import MemoryQueue
from tests.service.under_test import CLIP, ServiceUnderTest, assert_problem, bearer, running_service

LABEL, METADATA = "series Quokka 3", {"ris": "Wombat-17"}
SECRET_WORDS = ("Quokka", "Wombat")


def sent(service: ServiceUnderTest, **texts: str) -> str:
    given = {"label": LABEL, "metadata": json.dumps(METADATA), **texts}
    response = service.http.post("/reconstruct", files={"clip": ("a.mp4", CLIP)}, data=given)
    assert response.status_code == 202, response.text
    job_id: str = response.json()["id"]
    return job_id


def labels_of(service: ServiceUnderTest, job_id: str) -> tuple[str | None, dict[str, str]]:
    job = service.http.get(f"/jobs/{job_id}").json()
    return job["label"], job["metadata"]


def patched(service: ServiceUnderTest, job_id: str, **change: object) -> tuple[str | None, dict[str, str]]:
    response = service.http.request("PATCH", f"/jobs/{job_id}", json=change)
    assert response.status_code == 200, response.text
    return response.json()["label"], response.json()["metadata"]


def finish(service: ServiceUnderTest, job_id: str) -> None:
    record, claim = service.claimed()
    assert record.job_id == job_id
    (service.store.work_folder(job_id, 1) / "manifest.json").write_text("{}")
    service.store.publish_scene(job_id, 1)
    assert service.queue.finish(claim)


def test_a_job_and_its_scene_have_the_labels_that_came_with_the_clip(service: ServiceUnderTest) -> None:
    job_id = sent(service)
    assert labels_of(service, job_id) == (LABEL, METADATA)
    (listed,) = service.http.get("/jobs").json()
    assert (listed["label"], listed["metadata"]) == (LABEL, METADATA)
    finish(service, job_id)
    (scene,) = service.http.get("/scenes").json()
    assert (scene["label"], scene["metadata"], scene["links"]["job"]) == (LABEL, METADATA, f"/jobs/{job_id}")


def test_a_job_of_uploads_and_one_of_an_earlier_clip_have_labels_of_their_own(service: ServiceUnderTest) -> None:
    first = sent(service)
    body = {"clip_of": first, "label": "again"}
    again = service.http.post("/reconstruct", json=body).json()
    assert (again["label"], again["metadata"]) == ("again", {})
    assert labels_of(service, first) == (LABEL, METADATA)


def test_labels_change_in_any_state_and_what_is_not_named_stays(service: ServiceUnderTest) -> None:
    job_id = sent(service)
    assert patched(service, job_id, label="b") == ("b", METADATA)
    assert patched(service, job_id, metadata={"c": "d"}) == ("b", {"c": "d"})
    finish(service, job_id)
    assert patched(service, job_id, label=None, metadata={}) == (None, {})
    assert patched(service, job_id) == (None, {})


def test_an_event_of_before_does_not_tell_a_label_that_was_removed(service: ServiceUnderTest) -> None:
    job_id = sent(service)
    finish(service, job_id)
    patched(service, job_id, label=None, metadata=None)
    events = service.http.get(f"/jobs/{job_id}/events").text
    assert "event: job" in events
    assert not any(word in events for word in SECRET_WORDS)


@pytest.mark.parametrize(
    ("texts", "field"),
    [
        ({"label": "x" * 81}, "label"),
        ({"label": "a\x07"}, "label"),
        ({"metadata": "{"}, "metadata"),
        ({"metadata": '{"a": 1}'}, "metadata"),
        ({"metadata": "[" * 70_000}, "metadata"),
    ],
)
def test_labels_that_cannot_be_are_refused_with_the_clip(
    service: ServiceUnderTest, texts: dict[str, str], field: str
) -> None:
    response = service.http.post("/reconstruct", files={"clip": ("a.mp4", CLIP)}, data=texts)
    assert_problem(response, 413 if len(texts[field]) > 60_000 else 422, field)
    assert service.spooled() == []


def test_labels_that_cannot_be_are_refused_as_a_change(service: ServiceUnderTest) -> None:
    job_id = sent(service)
    for change, field in (
        ({"label": "x" * 81}, "label"),
        ({"metadata": {"a b": "c"}}, "metadata.a b"),
        ({"metadata": {"ris": 815}}, "metadata.ris"),
        ({"lable": "x"}, "lable"),
    ):
        assert_problem(service.http.request("PATCH", f"/jobs/{job_id}", json=change), 422, field)
    assert labels_of(service, job_id) == (LABEL, METADATA)
    assert_problem(service.http.request("PATCH", f"/jobs/{'0' * 32}", json={}), 404, "job_id")


def test_only_its_tenant_changes_a_label_and_only_with_the_scope(tmp_path: Path) -> None:
    for service in running_service(tmp_path, host="0.0.0.0"):
        own, other = bearer(service, "ward-1"), bearer(service, "ward-2")
        viewer = bearer(service, "ward-1", {KeyScope.VIEW})
        job_id = service.upload(headers=own).json()["id"]
        path, change = f"/jobs/{job_id}", {"label": "x"}
        assert_problem(service.http.request("PATCH", path, json=change, headers=other), 404, "job_id")
        assert_problem(service.http.request("PATCH", path, json=change, headers=viewer), 403, "Authorization")
        assert service.http.request("PATCH", path, json=change, headers=own).status_code == 200


def test_labels_stand_in_no_log_audit_or_metric_and_go_with_the_job(
    service: ServiceUnderTest, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG):
        job_id = sent(service)
        finish(service, job_id)
        patched(service, job_id, label="Quokka 4")
        service.http.get("/jobs", params={"q": "Quokka", "metadata": "ris=Wombat-17"})
        service.http.request("PATCH", f"/jobs/{job_id}", json={"label": "Quokka\n"})
    audit = (service.store.data_dir / AUDIT_FILE).read_text()
    assert '"action":"labelled"' in audit
    logged = [each.__dict__ for each in caplog.records if each.name != "httpx"]  # that is this test's client
    assert logged
    told = repr(logged) + audit + service.http.get("/metrics").text
    assert not any(word in told for word in SECRET_WORDS)
    assert (service.store.spool_folder(job_id) / LABELS).is_file()
    assert service.http.delete(f"/scenes/{job_id}").json()["verified"]
    for path in service.store.data_dir.rglob("*"):
        assert not path.is_file() or not any(word.encode() in path.read_bytes() for word in SECRET_WORDS), path


def test_a_queue_that_lost_everything_gets_jobs_back_with_their_newest_labels(tmp_path: Path) -> None:
    for service in running_service(tmp_path):
        job_id = sent(service)
        patched(service, job_id, label="newer")
    queue = MemoryQueue()
    for _ in running_service(tmp_path, queue):
        while (record := queue.get(job_id)) is None:  # the sweep brings it back
            time.sleep(0.01)
        assert record.labels == Labels(label="newer", metadata=METADATA)
