"""What the client makes of answers that a real service seldom gives: every status, a busy one, another server's."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest

from intrasplat_client import (
    Client,
    Conflict,
    Forbidden,
    IntrasplatError,
    JobState,
    NotFound,
    RateLimited,
    RequestRefused,
    ServiceFault,
    ServiceUnavailable,
    Unauthorized,
)

JOB_ID = "0" * 32
JOB = {
    "id": JOB_ID,
    "state": "queued",
    "options": {},
    "input_bytes": 1,
    "created_at_s": 0.0,
    "links": {},
}


def test_the_job_is_polled_where_a_proxy_holds_events_back() -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("/events"):
            return httpx.Response(200, text="<html>proxy</html>", headers={"content-type": "text/html"})
        return httpx.Response(200, json={**JOB, "state": "done"})

    with Client(transport=httpx.MockTransport(answer)) as client:
        assert client.wait(JOB_ID).state is JobState.DONE


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (400, RequestRefused),
        (401, Unauthorized),
        (403, Forbidden),
        (404, NotFound),
        (409, Conflict),
        (413, RequestRefused),
        (422, RequestRefused),
        (429, RateLimited),
        (500, ServiceFault),
        (503, ServiceUnavailable),
        (507, RequestRefused),
    ],
)
def test_every_status_is_an_error_with_field_remedy_and_request_id(status: int, kind: type[IntrasplatError]) -> None:
    document = {"status": status, "detail": "It rains.", "field": "sky", "remedy": "Wait."}
    headers = {"x-request-id": "r1", "retry-after": "3600"}
    transport = httpx.MockTransport(lambda request: httpx.Response(status, json=document, headers=headers))
    with Client(transport=transport) as client, pytest.raises(kind) as caught:
        client.jobs()
    assert type(caught.value) is kind
    told = {name: getattr(caught.value, name) for name in ("status", "field", "remedy", "request_id")}
    assert told == {"status": status, "field": "sky", "remedy": "Wait.", "request_id": "r1"}
    assert "It rains." in str(caught.value)


def test_an_answer_that_is_no_problem_document_is_a_fault_of_the_service() -> None:
    transport = httpx.MockTransport(lambda request: httpx.Response(502, text="<html>proxy</html>"))
    with Client(transport=transport) as client, pytest.raises(ServiceFault, match="502"):
        client.jobs()


def test_another_server_at_the_address_is_a_fault_and_not_a_crash(clip: Path) -> None:
    transport = httpx.MockTransport(lambda request: httpx.Response(200, text="<html>It works!</html>"))
    with Client(transport=transport) as client:
        for ask in (
            client.jobs,
            client.info,
            lambda: client.wait(JOB_ID),
            lambda: client.render(scene=JOB_ID),
            lambda: client.reconstruct(clip),
            lambda: client.reconstruct(clip, in_pieces=True),
        ):
            with pytest.raises(ServiceFault, match="not an intrasplat service"):
                ask()


class Busy:
    """Refuses the first requests, then answers."""

    def __init__(self, status: int, times: int, **extensions: str) -> None:
        self.status = status
        self.document = {"status": status, "detail": "Busy.", "remedy": "Wait.", **extensions}
        self.left = times
        self.requests: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.requests.append(request)
        self.left -= 1
        if self.left >= 0:
            return httpx.Response(self.status, json=self.document, headers={"retry-after": "0"})
        return httpx.Response(200, json=[] if request.url.path == "/jobs" else JOB)


@pytest.mark.parametrize("status", [429, 503])
def test_a_busy_service_is_asked_again_until_patience_ends(status: int) -> None:
    busy = Busy(status, times=2)
    waits: list[str] = []
    on_wait = lambda error, pause_s: waits.append(str(error))  # noqa: E731
    with Client(transport=httpx.MockTransport(busy), on_wait=on_wait) as client:
        assert client.jobs() == []
    assert len(busy.requests) == 3
    assert len(waits) == 2
    assert all("Busy." in wait for wait in waits)
    busy = Busy(status, times=9)
    with Client(transport=httpx.MockTransport(busy), patience_s=0.3) as client, pytest.raises(ServiceUnavailable):
        client.jobs()
    assert len(busy.requests) == 2


def test_a_clip_is_sent_again_whole_and_under_the_same_key(clip: Path) -> None:
    busy = Busy(503, times=1)
    with Client(transport=httpx.MockTransport(busy)) as client:
        client.reconstruct(clip)
    first, second = busy.requests
    assert first.content == second.content
    assert first.headers["idempotency-key"] == second.headers["idempotency-key"]


def test_an_accepted_clip_is_not_sent_again_while_the_queue_is_away(clip: Path) -> None:
    busy = Busy(503, times=2, job_id=JOB_ID)
    with Client(transport=httpx.MockTransport(busy)) as client:
        assert client.reconstruct(clip).id == JOB_ID
    assert [request.method for request in busy.requests] == ["POST", "GET", "GET"]


class Restarting:
    """A service that takes one piece of an upload, and is gone for the next `away` requests."""

    def __init__(self, away: int) -> None:
        self.away = away
        self.came = b""
        self.cut = False

    def __call__(self, request: httpx.Request) -> httpx.Response:
        body = request.read()
        if self.cut and self.away > 0:
            self.away -= 1
            raise httpx.ConnectError("refused", request=request)
        if request.url.path == "/uploads":
            return httpx.Response(201, headers={"location": "/uploads/u1"})
        if request.method == "PATCH" and not self.cut:
            self.came, self.cut = body[:1000], True
            raise httpx.WriteError("lost", request=request)
        if request.method == "PATCH":
            assert int(request.headers["upload-offset"]) == len(self.came)
            self.came += body
        if request.url.path == "/reconstruct":
            assert json.loads(body) == {"clip": "u1", "options": {"seed": 3}}
            return httpx.Response(202, json=JOB)
        return httpx.Response(200, headers={"upload-offset": str(len(self.came))})


def test_an_upload_outlives_a_restart_of_the_service_but_not_its_end(clip: Path) -> None:
    service = Restarting(away=2)
    with Client(transport=httpx.MockTransport(service)) as client:
        assert client.reconstruct(clip, in_pieces=True, seed=3).id == JOB_ID
    assert service.came == clip.read_bytes()
    service = Restarting(away=1000)
    with Client(transport=httpx.MockTransport(service), patience_s=0.5) as client, pytest.raises(ServiceUnavailable):
        client.reconstruct(clip, in_pieces=True)
