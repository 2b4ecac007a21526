"""POST /jobs/{id}/deliveries: a webhook goes out again because somebody asks for it."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from contract.access.audit import AUDIT_FILE
from contract.access.keys import KeyScope
from contract.store.shelf import new_job_id
from contract.wire.errors import ErrorCode
from contract.wire.job import LOCAL_TENANT, JobError, JobFiles, JobRecord, JobState
from contract.wire.webhooks import MAX_TRIES_BEFORE_AGAIN, DeliveryStatus
from service import webhooks
from service.webhooks import MAX_TRIES
from tests.memory_queue import MemoryQueue
from tests.receiver import Receiver
from tests.service.telling import SECRET, accepted, cancelled, log_of, telling
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer, running_service


@pytest.fixture
def hardly_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Webhooks that were not delivered are tried again after a day."""
    monkeypatch.setattr(webhooks, "FIRST_WAIT_S", 86400.0)
    monkeypatch.setattr(webhooks, "MAX_WAIT_S", 86400.0)


def ended(service: ServiceUnderTest, job_id: str, status: str) -> dict[str, object]:
    return log_of(service, job_id, lambda delivery: delivery["status"] == status)


@pytest.mark.usefixtures("at_once")
def test_one_that_was_given_up_is_sent_again_under_its_id_and_that_stands_in_the_audit(tmp_path: Path) -> None:
    with Receiver(*[503] * MAX_TRIES) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/hook")
        ended(service, job_id, "failed")
        response = service.http.post(f"/jobs/{job_id}/deliveries")
        assert response.status_code == 202
        assert [(each["event_id"], each["forgiven_tries"]) for each in response.json()] == [
            (f"{job_id}.0.cancelled", MAX_TRIES)
        ]
        delivered = ended(service, job_id, "delivered")
        came = [receiver.next() for _ in range(MAX_TRIES + 1)]
        assert receiver.came.empty()
    assert {each.headers["webhook-id"] for each in came} == {delivered["event_id"]}
    assert came[-1].is_genuine(SECRET, LOCAL_TENANT)
    lines = [json.loads(line) for line in (tmp_path / AUDIT_FILE).read_text().splitlines()]
    assert [line["job_id"] for line in lines if line["action"] == "sent-again"] == [job_id]


@pytest.mark.usefixtures("at_once")
def test_one_that_is_sent_again_in_vain_has_its_schedule_anew(tmp_path: Path) -> None:
    with Receiver(*[503] * 3 * MAX_TRIES) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        for times in (1, 2):
            delivery = log_of(service, job_id, lambda delivery: delivery["status"] == "failed")
            assert len(delivery["tries"]) == times * MAX_TRIES
            assert service.http.post(f"/jobs/{job_id}/deliveries").status_code == 202


@pytest.mark.usefixtures("hardly_ever")
def test_one_that_waits_for_its_next_try_is_sent_at_once_and_after_its_delivery_as_often_as_asked_for(
    tmp_path: Path,
) -> None:
    with Receiver(500) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        receiver.next()
        log_of(service, job_id, lambda delivery: bool(delivery["tries"]))
        for _ in range(3):
            assert receiver.came.empty()
            assert service.http.post(f"/jobs/{job_id}/deliveries").status_code == 202
            assert receiver.next().headers["webhook-id"] == f"{job_id}.0.cancelled"
            ended(service, job_id, "delivered")
        metrics = service.http.get("/metrics").text
    assert 'intrasplat_webhooks_total{status="delivered"} 3.0' in metrics


def test_while_a_try_is_under_way_none_is_added(tmp_path: Path) -> None:
    with Receiver(waits=True) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        receiver.next()
        for _ in range(3):
            (delivery,) = service.http.post(f"/jobs/{job_id}/deliveries").json()
            assert (delivery["status"], delivery["tries"], delivery["next_try_at_s"]) == ("owed", [], None)
        receiver.go_on()
        ended(service, job_id, "delivered")
        told = cancelled(service, f"{receiver.origin}/")
        assert receiver.next().document["data"]["job_id"] == told
        assert receiver.came.empty()


def test_of_a_job_that_ended_twice_the_last_end_is_told_again(receiver: Receiver, tmp_path: Path) -> None:
    with telling(receiver, tmp_path) as service:
        job_id = accepted(service, f"{receiver.origin}/")
        assert service.queue.fail(service.claimed()[1], JobError(code=ErrorCode.INPUT, problem="It is dark."))
        assert receiver.next().document["type"] == "job.failed"
        service.queue.retry(job_id)
        assert service.queue.finish(service.claimed()[1])
        assert receiver.next().document["type"] == "job.done"
        while service.queue.figures().webhooks[DeliveryStatus.OWED]:
            time.sleep(0.02)
        assert service.http.post(f"/jobs/{job_id}/deliveries").status_code == 202
        assert receiver.next().headers["webhook-id"] == f"{job_id}.2.done"
        assert receiver.came.empty()


def test_one_that_the_queue_has_lost_is_sent_again(receiver: Receiver, tmp_path: Path) -> None:
    queue = MemoryQueue()
    long_ago = {"state": JobState.DONE, "attempt": 1, "finished_at_s": 2000.0, "callback_url": f"{receiver.origin}/"}
    record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=1.0)
    queue.restore(record.model_copy(update=long_ago))
    with telling(receiver, tmp_path, queue) as service:
        assert service.http.get(f"/jobs/{record.job_id}/deliveries").json() == []
        assert service.http.post(f"/jobs/{record.job_id}/deliveries").status_code == 202
        assert receiver.next().document["timestamp"] == "1970-01-01T00:33:20.000+00:00"


def test_a_job_without_a_callback_and_one_that_has_not_ended_have_none_to_send(
    receiver: Receiver, tmp_path: Path
) -> None:
    with telling(receiver, tmp_path) as service:
        silent = service.upload().json()["id"]
        service.http.delete(f"/jobs/{silent}")
        problem = assert_problem(service.http.post(f"/jobs/{silent}/deliveries"), 409, "job_id")
        assert "callback_url" in problem["detail"]
        queued = accepted(service, f"{receiver.origin}/")
        for state in (JobState.QUEUED, JobState.RUNNING):
            problem = assert_problem(service.http.post(f"/jobs/{queued}/deliveries"), 409, "job_id")
            assert state.value in problem["detail"]
            service.queue.claim("worker-1", 0.0)
        assert_problem(service.http.post(f"/jobs/{new_job_id()}/deliveries"), 404, "job_id")
        assert receiver.came.empty()


def test_who_may_not_cancel_a_job_may_not_send_its_webhook_again(receiver: Receiver, tmp_path: Path) -> None:
    with telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        receiver.next()
        path = f"/jobs/{job_id}/deliveries"
        assert_problem(service.http.post(path, headers=bearer(service, "ward-9")), 404, "job_id")
        looking = bearer(service, LOCAL_TENANT, {KeyScope.VIEW})
        assert service.http.post(path, headers=looking).status_code == 403
        ended(service, job_id, "delivered")
        assert receiver.came.empty()


def test_a_receiver_that_is_no_longer_allowed_is_named_at_once(receiver: Receiver, tmp_path: Path) -> None:
    queue = MemoryQueue()
    with telling(receiver, tmp_path, queue) as service:
        job_id = cancelled(service, f"{receiver.origin}/?token=quokka")
        receiver.next()
        ended(service, job_id, "delivered")
    for hosts in ((), ("his.example",)):
        for service in running_service(tmp_path, queue, webhook_secret=SECRET, webhook_hosts=hosts):
            problem = assert_problem(service.http.post(f"/jobs/{job_id}/deliveries"), 422, "callback_url")
            assert "INTRASPLAT_WEBHOOK_HOSTS" in problem["remedy"]
            assert "quokka" not in json.dumps(problem)


@pytest.mark.usefixtures("at_once")
def test_the_log_of_one_webhook_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhooks, "MAX_TRIES", MAX_TRIES_BEFORE_AGAIN)
    with Receiver(*[500] * MAX_TRIES_BEFORE_AGAIN) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        ended(service, job_id, "failed")
        problem = assert_problem(service.http.post(f"/jobs/{job_id}/deliveries"), 409, "job_id")
        assert str(MAX_TRIES_BEFORE_AGAIN) in problem["detail"]
