"""Webhooks from the real service to a real receiver: signed, with a log, as often as it takes."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from client.cli import main as command_line
from contract.access.keys import KeyScope
from contract.access.webhook_secrets import tenant_secret
from contract.queue.deliveries import ClaimedDelivery
from contract.store.shelf import new_job_id
from contract.wire.job import LOCAL_TENANT, JobError, JobFiles, JobRecord, JobState
from intrasplat.errors import ErrorCode, UnavailableError
from service import webhooks
from service.webhooks import MAX_TRIES
from tests.memory_queue import MemoryQueue
from tests.receiver import Receiver, Webhook
from tests.service.telling import LOG_WITHIN_S, PATIENT, SECRET, accepted, cancelled, failure_of, log_of, sent, telling
from tests.service.under_test import ServiceUnderTest, another_clip, assert_problem, bearer, running_service


@pytest.fixture
def service(receiver: Receiver, tmp_path: Path) -> Iterator[ServiceUnderTest]:
    with telling(receiver, tmp_path) as service:
        yield service


def is_genuine(webhook: Webhook, tenant: str = LOCAL_TENANT) -> bool:
    return webhook.is_genuine(SECRET, tenant)


def test_a_done_job_is_told_and_the_documented_sample_verifies_it(
    service: ServiceUnderTest, receiver: Receiver
) -> None:
    job_id = accepted(service, f"{receiver.origin}/hook?from=intrasplat")
    _, claim = service.claimed()
    assert service.queue.finish(claim)
    webhook = receiver.next()
    assert webhook.path == "/hook?from=intrasplat"
    assert is_genuine(webhook)
    assert not is_genuine(webhook, "another-tenant")
    assert not is_genuine(Webhook(webhook.path, webhook.headers, webhook.body + b" "))
    for name in ("webhook-id", "webhook-timestamp", "webhook-signature"):
        assert not is_genuine(Webhook(webhook.path, {**webhook.headers, name: "1"}, webhook.body))
        assert not is_genuine(Webhook(webhook.path, {**webhook.headers, name: "v1,é 9"}, webhook.body))
        others = {each: value for each, value in webhook.headers.items() if each != name}
        assert not is_genuine(Webhook(webhook.path, others, webhook.body))
    document = webhook.document
    assert document.pop("timestamp").startswith("20")
    assert document == {
        "id": f"{job_id}.1.done",
        "type": "job.done",
        "data": {"job_id": job_id, "state": "done", "error_code": None},
    }
    assert webhook.headers["webhook-id"] == f"{job_id}.1.done"
    assert webhook.headers["content-type"] == "application/json"
    delivery = log_of(service, job_id, lambda delivery: delivery["status"] == "delivered")
    assert [(each["status_code"], each["failure"]) for each in delivery["tries"]] == [(204, None)]
    assert delivery["next_try_at_s"] is None
    assert service.http.get(f"/jobs/{job_id}").json()["links"]["deliveries"] == f"/jobs/{job_id}/deliveries"


def test_failed_and_cancelled_jobs_are_told_and_a_running_one_is_not(
    service: ServiceUnderTest, receiver: Receiver
) -> None:
    failing, running, gone = (accepted(service, f"{receiver.origin}/") for _ in range(3))
    assert service.queue.fail(service.claimed()[1], JobError(code=ErrorCode.INPUT, problem=PATIENT, field="clip"))
    service.claimed()
    service.http.delete(f"/jobs/{gone}")
    told = [receiver.next().document for _ in range(2)]
    ends = {each["data"]["job_id"]: (each["type"], each["data"]["error_code"]) for each in told}
    assert ends == {failing: ("job.failed", "input"), gone: ("job.cancelled", None)}
    assert PATIENT not in json.dumps(told)
    assert service.http.get(f"/jobs/{running}/deliveries").json() == []
    assert receiver.came.empty()


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("status", [302, 404, 500])
def test_what_is_not_accepted_is_sent_again_with_the_same_id_and_redirects_are_not_followed(
    tmp_path: Path, status: int
) -> None:
    with Receiver(status, status) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/hook")
        came = [receiver.next() for _ in range(3)]
        assert {each.headers["webhook-id"] for each in came} == {f"{job_id}.0.cancelled"}
        assert {each.path for each in came} == {"/hook"}
        assert all(is_genuine(each) for each in came)
        delivery = log_of(service, job_id, lambda delivery: delivery["status"] == "delivered")
        answers = [(each["failure"], each["status_code"]) for each in delivery["tries"]]
        assert answers == [("status", status), ("status", status), (None, 204)]


@pytest.mark.usefixtures("at_once")
def test_a_webhook_is_given_up_after_the_last_try_and_that_is_logged_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Receiver(*[503] * MAX_TRIES) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        delivery = log_of(service, job_id, lambda delivery: delivery["status"] == "failed")
        assert len(delivery["tries"]) == receiver.came.qsize() == MAX_TRIES
        metrics = service.http.get("/metrics").text
        assert 'intrasplat_webhooks_total{status="failed"} 1.0' in metrics
        assert "intrasplat_webhooks_owed 0.0" in metrics
    (record,) = [each for each in caplog.records if each.levelno == logging.ERROR]
    assert (record.__dict__["job_id"], record.__dict__["status"]) == (job_id, 503)
    assert receiver.origin not in caplog.text


def test_a_receiver_that_wants_no_more_hears_no_more(tmp_path: Path) -> None:
    with Receiver(410) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        assert len(log_of(service, job_id, lambda delivery: delivery["status"] == "failed")["tries"]) == 1


def test_a_receiver_that_does_not_answer_costs_one_try(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhooks, "TRY_S", 0.3)
    with Receiver(waits=True) as receiver, telling(receiver, tmp_path) as service:
        assert failure_of(service, cancelled(service, f"{receiver.origin}/")) == ("timeout", None)


def test_of_an_answer_without_end_little_is_read(tmp_path: Path) -> None:
    with Receiver(200, floods=True) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        log_of(service, job_id, lambda delivery: delivery["status"] == "delivered")
        assert receiver.flooded_bytes.get(timeout=LOG_WITHIN_S) < 2**24  # what buffers of the system hold


def test_what_one_receiver_sets_as_a_cookie_is_sent_to_nobody(service: ServiceUnderTest, receiver: Receiver) -> None:
    for _ in range(2):
        log_of(service, cancelled(service, f"{receiver.origin}/"), lambda delivery: delivery["status"] == "delivered")
        assert "cookie" not in receiver.next().headers


def test_a_service_that_starts_delivers_what_is_owed(receiver: Receiver, tmp_path: Path) -> None:
    queue = MemoryQueue()
    for service in running_service(tmp_path, queue, webhook_secret=SECRET, webhook_hosts=(receiver.origin,)):
        job_id = accepted(service, f"{receiver.origin}/")
    queue.cancel(job_id)
    with telling(receiver, tmp_path, queue):
        assert receiver.next().document["data"]["job_id"] == job_id


def test_several_services_share_the_work_and_deliver_each_webhook_once(receiver: Receiver, tmp_path: Path) -> None:
    queue = MemoryQueue()
    with ExitStack() as services:
        several = [services.enter_context(telling(receiver, tmp_path / str(number), queue)) for number in range(3)]
        ended = {cancelled(several[number % 3], f"{receiver.origin}/") for number in range(12)}
        for job_id in ended:
            log_of(several[0], job_id, lambda delivery: delivery["status"] == "delivered")
        told = [receiver.next().document["data"]["job_id"] for _ in ended]
        assert sorted(told) == sorted(ended)
        assert receiver.came.empty()


def test_while_the_queue_is_away_nothing_is_lost(
    receiver: Receiver, service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id, claim_delivery = accepted(service, f"{receiver.origin}/"), service.queue.claim_delivery
    asked = []

    def away(*arguments: object) -> None:
        asked.append(arguments)
        raise UnavailableError("The queue is away.", "Wait.")

    monkeypatch.setattr(service.queue, "claim_delivery", away)
    service.queue.cancel(job_id)
    while len(asked) < 3:
        time.sleep(0.01)
    assert receiver.came.empty()
    monkeypatch.setattr(service.queue, "claim_delivery", claim_delivery)
    assert receiver.next().document["data"]["job_id"] == job_id


def test_a_tenant_whose_receivers_hang_holds_up_no_other_tenant(tmp_path: Path) -> None:
    with (
        Receiver(waits=True) as hanging,
        Receiver() as receiver,
        telling(receiver, tmp_path, webhook_hosts=(hanging.origin, receiver.origin)) as service,
    ):
        own = {accepted(service, f"{hanging.origin}/{n}", **bearer(service, "ward-1")) for n in range(20)}
        for job_id in own:
            service.queue.cancel(job_id)
        for _ in range(webhooks.MAX_OF_TENANT):
            hanging.next()
        job_id = accepted(service, f"{receiver.origin}/", **bearer(service, "ward-2"))
        service.queue.cancel(job_id)
        assert receiver.next().document["data"]["job_id"] == job_id
        assert hanging.came.empty()
        hanging.go_on()
        told = {webhook.document["data"]["job_id"] for webhook in hanging.all}
        told |= {hanging.next().document["data"]["job_id"] for _ in range(20 - webhooks.MAX_OF_TENANT)}
        assert told == own


def test_while_a_try_is_under_way_no_next_one_is_told(tmp_path: Path) -> None:
    with Receiver(500, waits=True) as receiver, telling(receiver, tmp_path) as service:
        job_id = cancelled(service, f"{receiver.origin}/")
        receiver.next()
        under_way = log_of(service, job_id, lambda delivery: True)
        assert (under_way["status"], under_way["tries"], under_way["next_try_at_s"]) == ("owed", [], None)
        receiver.go_on()
        failed = log_of(service, job_id, lambda delivery: bool(delivery["tries"]))
        assert failed["status"] == "owed"
        assert failed["next_try_at_s"] > failed["tries"][0]["at_s"]


def test_while_the_queue_takes_no_notes_requests_have_threads_of_their_own(
    receiver: Receiver, service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, noting, at_once = threading.Event(), [], []

    def slow(*arguments: object) -> bool:
        noting.append(arguments)
        at_once.append(len(noting))
        go_on.wait()
        noting.remove(arguments)
        return False

    monkeypatch.setattr(service.queue, "record_try", slow)
    tenants = 2 * webhooks.MAX_CALLS // webhooks.MAX_OF_TENANT
    for number in range(2 * webhooks.MAX_CALLS):
        job_id = accepted(service, f"{receiver.origin}/", **bearer(service, f"ward-{number % tenants}"))
        service.queue.cancel(job_id)
    try:
        for _ in range(webhooks.MAX_CALLS):
            receiver.next()
        assert service.http.get("/jobs").status_code == 200
    finally:
        go_on.set()
    for _ in range(webhooks.MAX_CALLS):
        receiver.next()
    assert max(at_once) == webhooks.MAX_CALLS


def ended_after_the_last_day(queue: MemoryQueue, url: str) -> str:
    """A job whose webhook no service can write: no calendar has the day on which it ended."""
    ended = {"state": JobState.DONE, "attempt": 1, "finished_at_s": 1e20, "callback_url": url}
    record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=1.0).model_copy(update=ended)
    queue.restore(record)
    return record.job_id


def test_a_fault_in_one_try_ends_neither_the_loop_nor_the_tries_under_way(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    queue = MemoryQueue()
    with Receiver(waits=True) as slow, Receiver() as receiver:
        with telling(receiver, tmp_path, queue, webhook_hosts=(slow.origin, receiver.origin)) as service:
            under_way = cancelled(service, f"{slow.origin}/")
            slow.next()
            faulty = ended_after_the_last_day(queue, f"{receiver.origin}/")
            assert failure_of(service, faulty) == ("fault", None)
            job_id = cancelled(service, f"{receiver.origin}/")
            assert receiver.next().document["data"]["job_id"] == job_id
            slow.go_on()
            delivery = log_of(service, under_way, lambda delivery: delivery["status"] == "delivered")
            assert len(delivery["tries"]) == 1
        assert slow.came.empty()
    (tried,) = queue.deliveries(faulty)
    assert (tried.status, [each.failure for each in tried.tries]) == ("owed", ["fault"])
    (fault,) = [each for each in caplog.records if each.exc_info]
    assert fault.__dict__["job_id"] == faulty


def test_a_fault_in_a_claim_is_logged_and_webhooks_go_out(
    receiver: Receiver,
    service: ServiceUnderTest,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    claim_delivery, left = service.queue.claim_delivery, [ValueError("a fault")]

    def damaged(*arguments: Any) -> ClaimedDelivery | None:
        if left:
            raise left.pop()
        return claim_delivery(*arguments)

    monkeypatch.setattr(service.queue, "claim_delivery", damaged)
    with caplog.at_level(logging.ERROR, "intrasplat.service"):
        job_id = cancelled(service, f"{receiver.origin}/")
        assert receiver.next().document["data"]["job_id"] == job_id
    assert [each.getMessage() for each in caplog.records] == ["a fault while a webhook was claimed"]


def test_the_same_idempotency_key_with_another_callback_is_refused(
    service: ServiceUnderTest, receiver: Receiver
) -> None:
    key = {"Idempotency-Key": "one"}
    job_id = accepted(service, f"{receiver.origin}/a", **key)
    assert accepted(service, f"{receiver.origin}/a", **key) == job_id
    problem = assert_problem(sent(service, f"{receiver.origin}/b", **key), 422, "Idempotency-Key")
    assert "callback_url" in problem["detail"]
    assert_problem(service.upload(headers=key), 422, "Idempotency-Key")
    assert sent(service, f"{receiver.origin}/b", another_clip(b"x")).json()["id"] != job_id


def test_a_job_of_uploads_or_of_an_earlier_clip_has_the_callback_that_is_named_with_it(
    service: ServiceUnderTest, receiver: Receiver
) -> None:
    first = accepted(service, f"{receiver.origin}/first")
    for callback in ({}, {"callback_url": f"{receiver.origin}/second"}):
        response = service.http.post("/reconstruct", json={"clip_of": first, **callback})
        service.http.delete(f"/jobs/{response.json()['id']}")
    assert receiver.next().path == "/second"
    assert_problem(
        service.http.post("/reconstruct", json={"clip_of": first, "callback_url": "https://evil.example"}),
        422,
        "callback_url",
    )


def test_the_log_of_deliveries_is_purged_with_the_job_and_closed_to_other_tenants(
    service: ServiceUnderTest, receiver: Receiver
) -> None:
    job_id = cancelled(service, f"{receiver.origin}/")
    receiver.next()
    path = f"/jobs/{job_id}/deliveries"
    stranger = service.http.get(path, headers=bearer(service, "ward-9"))
    assert_problem(stranger, 404, "job_id")
    blind = bearer(service, LOCAL_TENANT, {KeyScope.RECONSTRUCT})
    assert service.http.get(path, headers=blind).status_code == 403
    assert service.http.delete(f"/scenes/{job_id}").status_code == 200
    assert_problem(service.http.get(path), 404, "job_id")
    assert service.queue.deliveries(job_id) == []


def test_each_tenant_has_a_secret_of_its_own_which_the_command_line_prints(
    service: ServiceUnderTest, receiver: Receiver, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    job_id = accepted(service, f"{receiver.origin}/", **bearer(service, "ward-3"))
    service.queue.cancel(job_id)
    webhook = receiver.next()
    assert is_genuine(webhook, "ward-3")
    assert not is_genuine(webhook, LOCAL_TENANT)
    monkeypatch.setenv("INTRASPLAT_WEBHOOK_SECRET", SECRET)
    assert command_line(["keys", "webhook-secret", "--tenant", "ward-3"]) == 0
    assert capsys.readouterr().out.strip() == tenant_secret(SECRET, "ward-3")
    assert command_line(["keys", "webhook-secret", "--tenant", "Ward 3"]) != 0
    monkeypatch.delenv("INTRASPLAT_WEBHOOK_SECRET")
    assert command_line(["keys", "webhook-secret", "--tenant", "ward-3"]) != 0
    assert "INTRASPLAT_WEBHOOK_SECRET" in capsys.readouterr().err


def test_while_the_secret_is_changed_receivers_with_either_verify_webhooks(receiver: Receiver, tmp_path: Path) -> None:
    with telling(receiver, tmp_path, webhook_secret="n" * 32, webhook_old_secret=SECRET) as service:
        cancelled(service, f"{receiver.origin}/")
        webhook = receiver.next()
    assert webhook.is_genuine("n" * 32, LOCAL_TENANT)
    assert webhook.is_genuine(SECRET, LOCAL_TENANT)
    assert not webhook.is_genuine("x" * 32, LOCAL_TENANT)


def test_the_api_describes_what_is_sent(service: ServiceUnderTest, receiver: Receiver) -> None:
    document = service.http.get("/openapi.json").json()
    described = document["webhooks"]["jobEnded"]["post"]
    schema = described["requestBody"]["content"]["application/json"]["schema"]["$ref"].rpartition("/")[2]
    cancelled(service, f"{receiver.origin}/")
    webhook = receiver.next()
    schemas = document["components"]["schemas"]
    assert webhook.document.keys() == schemas[schema]["properties"].keys()
    assert webhook.document["data"].keys() == schemas["EndedJob"]["properties"].keys()
    assert {each["name"] for each in described["parameters"]} <= webhook.headers.keys()
    for form in ("ClipForm", "ClipOfUploads", "SceneForm"):
        assert "callback_url" in schemas[form]["properties"]
