"""Nobody reaches a route, a job or a scene that is not theirs; nothing tells of a patient or of another tenant."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute, APIWebSocketRoute
from starlette.routing import BaseRoute, Route

from contract.access.audit import AUDIT_FILE, RESERVE_FILE
from contract.access.keys import DAY_S, KEYS_FILE, KeyFile, KeyScope
from contract.runtime.settings import Settings
from contract.store.store import Store
from contract.wire.job import JobError
from intrasplat.errors import ErrorCode
from intrasplat.names import MANIFEST
from service import deps
from service.app import create_app
from tests.service.under_test import CLIP, ServiceUnderTest, assert_problem, running_service

OPEN_TO_ALL = {"/healthz", "/readyz", "/info", "/openapi.json", "OPTIONS /uploads"}
"""They tell of nobody's work. The page's own files are the only others."""
TELLS_KEYS_MORE = {"/readyz"}

NETWORK = "0.0.0.0"
ALL_SCOPES = frozenset(KeyScope)
MARKER = "SMITH-1957-05-24"


@dataclass(frozen=True)
class Ward:
    """A key holder."""

    http: Any
    key: str

    @property
    def headers(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.key}"}

    def request(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        headers = {**arguments.pop("headers", {}), **self.headers}
        response: httpx.Response = self.http.request(method, path, headers=headers, **arguments)
        return response

    def upload(self, name: str = "a.mp4") -> str:
        response = self.request("POST", "/reconstruct", files={"clip": (name, CLIP)})
        assert response.status_code == 202, response.text
        job_id: str = response.json()["id"]
        return job_id


@pytest.fixture
def open_service(tmp_path: Path) -> Iterator[ServiceUnderTest]:
    """A service that listens to the network, and so asks for keys."""
    yield from running_service(tmp_path, host=NETWORK)


def ward(service: ServiceUnderTest, tenant: str, scopes: frozenset[KeyScope] = ALL_SCOPES) -> Ward:
    return Ward(service.http, KeyFile(service.store.data_dir).create(tenant, scopes)[1])


def audit(service: ServiceUnderTest) -> list[dict[str, Any]]:
    path = service.store.data_dir / AUDIT_FILE
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def acts(service: ServiceUnderTest) -> list[tuple[str, str, str | None]]:
    return [(line["action"], line["outcome"], line.get("job_id")) for line in audit(service)]


def routes_of(routes: list[BaseRoute]) -> Iterator[BaseRoute]:
    for route in routes:
        included = getattr(route, "original_router", None)
        if included is None:
            yield route
        else:
            yield from routes_of(included.routes)


def all_routes(data_dir: Path) -> list[BaseRoute]:
    for service in running_service(data_dir):
        app: FastAPI = create_app(Settings(data_dir=data_dir), service.queue, service.store, None)  # type: ignore[arg-type]
        return list(routes_of(app.routes))
    raise AssertionError("no service")


def requests_of(data_dir: Path, job_id: str) -> list[tuple[str, str]]:
    """Method and path of every HTTP route that is not open to all, for one job."""
    asked = []
    for route in all_routes(data_dir):
        if isinstance(route, Route):
            path = route.path.format(job_id=job_id, scene_id=job_id, upload_id=job_id, feed_id=job_id, name=MANIFEST)
            if route.path == "/render":
                path += f"?scene={job_id}"
            if route.path.endswith("/measure"):
                path += "?points=1,1"
            asked += [(method, path) for method in sorted(route.methods or ())]
    return [(method, path) for method, path in asked if not {path, f"{method} {path}"} & OPEN_TO_ALL]


def calls(dependant: Dependant) -> set[Any]:
    return {dependant.call}.union(*(calls(each) for each in dependant.dependencies))


def test_no_route_is_without_the_question_who_calls(tmp_path: Path) -> None:
    routes = all_routes(tmp_path)
    assert sum(isinstance(route, APIRoute | APIWebSocketRoute) for route in routes) >= 15
    forgotten = []
    for route in routes:
        if isinstance(route, APIRoute | APIWebSocketRoute):
            if deps._caller_if_known not in calls(route.dependant):
                methods = "".join(sorted(getattr(route, "methods", ["WS"])))
                forgotten.append(route.path if {route.path} & OPEN_TO_ALL else f"{methods} {route.path}")
        else:
            forgotten.append(str(getattr(route, "path", route)))
    assert set(forgotten) == OPEN_TO_ALL - TELLS_KEYS_MORE


@pytest.mark.parametrize("key", [None, "isp_000000000000_00", "nonsense"])
def test_without_a_known_key_every_route_answers_401_and_tells_nothing(
    open_service: ServiceUnderTest, tmp_path: Path, key: str | None
) -> None:
    job_id = open_service.finished_scene(ward(open_service, "ward-3").headers)
    headers = {} if key is None else {"X-API-Key": key}
    asked = requests_of(tmp_path / "other", job_id)
    assert len(asked) >= 14
    bodies = set()
    for method, path in asked:
        headers["Tus-Resumable"] = "1.0.0"
        response = open_service.http.request(method, path, headers=headers)
        assert response.status_code in (401, 429), f"{method} {path}: {response.status_code}"
        assert "www-authenticate" in response.headers or response.status_code == 429
        bodies.add(response.text)
    assert not [body for body in bodies if job_id in body]
    assert [line["action"] for line in audit(open_service)].count("refused") == 1


def test_another_tenants_job_is_answered_exactly_like_one_that_is_not_there(
    open_service: ServiceUnderTest, tmp_path: Path
) -> None:
    mine, theirs = ward(open_service, "ward-3"), ward(open_service, "ward-4")
    job_id = open_service.finished_scene(mine.headers)
    missing = "f" * 32
    named = [
        (method, path)
        for method, path in requests_of(tmp_path / "other", job_id)
        if job_id in path and "/uploads" not in path
    ]
    assert len(named) >= 8
    for method, path in named:
        body = {"json": {"label": "mine"}} if method == "PATCH" else {}
        foreign = theirs.request(method, path, **body)
        absent = theirs.request(method, path.replace(job_id, missing), **body)
        assert foreign.status_code == 404, f"{method} {path}: {foreign.status_code}"
        assert foreign.text == absent.text.replace(missing, job_id)
        assert {*foreign.headers} == {*absent.headers}
    assert theirs.request("GET", "/jobs").json() == theirs.request("GET", "/scenes").json() == []
    assert mine.request("GET", f"/render?scene={job_id}").status_code == 200
    refused = [line for line in audit(open_service) if line["action"] == "refused"]
    assert {(line["tenant"], line["job_id"], line["outcome"]) for line in refused} == {("ward-4", job_id, "404")}


def test_another_tenants_upload_is_not_there_either(open_service: ServiceUnderTest) -> None:
    mine, theirs = ward(open_service, "ward-3"), ward(open_service, "ward-4")
    tus = {"Tus-Resumable": "1.0.0"}
    created = {**tus, "Upload-Length": str(len(CLIP)), "Upload-Metadata": "part Y2xpcA==,suffix Lm1wNA=="}
    path = mine.request("POST", "/uploads", headers=created).headers["location"]
    upload_id = path.rsplit("/", 1)[1]
    assert mine.request("HEAD", f"/uploads/{upload_id}", headers=tus).status_code == 200
    sending = {**tus, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    for method, headers in (("HEAD", tus), ("DELETE", tus), ("PATCH", sending)):
        content = CLIP if method == "PATCH" else None
        response = theirs.request(method, f"/uploads/{upload_id}", headers=headers, content=content)
        assert response.status_code == 404, method
    sent = mine.request("PATCH", f"/uploads/{upload_id}", headers=sending, content=CLIP)
    assert sent.status_code == 204
    assert theirs.request("POST", "/reconstruct", json={"clip": upload_id}).status_code in (404, 422)
    assert mine.request("POST", "/reconstruct", json={"clip": upload_id}).status_code == 202


@pytest.mark.parametrize("scope", list(KeyScope))
def test_a_key_does_what_its_scope_says_and_nothing_else(
    open_service: ServiceUnderTest, tmp_path: Path, scope: KeyScope
) -> None:
    job_id = open_service.finished_scene(ward(open_service, "ward-3").headers)
    limited = ward(open_service, "ward-3", frozenset({scope}))
    needed = {"/metrics": KeyScope.OPERATE, "DELETE /scenes": KeyScope.PURGE}
    for method, path in requests_of(tmp_path / "other", job_id):
        if path.endswith("/cut"):  # needs two scopes
            continue
        is_sent = path in ("/reconstruct", "/reconstruct/check") or (method, path) == ("POST", "/scenes")
        writes = "/uploads" in path or is_sent or (path.startswith("/jobs") and method in ("POST", "DELETE"))
        usual = KeyScope.RECONSTRUCT if writes else KeyScope.DOWNLOAD if "/files/" in path else KeyScope.VIEW
        usual = KeyScope.FEEDS if path.startswith("/feeds") and method in ("POST", "PUT", "DELETE") else usual
        wanted = needed.get(path) or needed.get(f"{method} {path.rpartition('/')[0]}") or usual
        response = limited.request(method, path, headers={"Tus-Resumable": "1.0.0"})
        if wanted is scope or path == "/key":  # every key may ask what it may do
            assert response.status_code not in (401, 403), f"{method} {path}"
        else:
            assert response.status_code in (403, 422), f"{method} {path}: {response.status_code}"
            assert response.status_code == 422 or method == "HEAD" or wanted.value in response.json()["detail"]


def test_a_revoked_key_is_refused_with_the_next_request(open_service: ServiceUnderTest) -> None:
    holder = ward(open_service, "ward-3")
    assert holder.request("GET", "/jobs").status_code == 200
    keys = KeyFile(open_service.store.data_dir)
    keys.revoke(keys.list()[0].key_id)
    assert_problem(holder.request("GET", "/jobs"), 401, "Authorization")


def test_a_key_that_has_expired_is_refused_and_only_its_holder_hears_why(open_service: ServiceUnderTest) -> None:
    holder = ward(open_service, "ward-3")
    keys = KeyFile(open_service.store.data_dir)
    (key,) = keys.list()
    assert holder.request("GET", "/key").json()["expires_at"] is None
    keys.rotate(key.key_id, keys.successor(key.key_id)[0], 4e9)
    assert holder.request("GET", "/key").json()["expires_at"] == "2096-10-02T07:06:40+00:00"
    keys.rotate(key.key_id, keys.successor(key.key_id)[0], time.time())
    problem = assert_problem(holder.request("GET", "/jobs"), 401, "Authorization")
    assert problem["code"] == ErrorCode.KEY_EXPIRED
    guessed = open_service.http.get("/jobs", headers={"X-API-Key": f"isp_{key.key_id}_{'0' * 64}"})
    assert "code" not in assert_problem(guessed, 401, "Authorization")
    refused = [line for line in audit(open_service) if line["action"] == "refused"]
    assert [line.get("key_id") for line in refused] == [key.key_id, None]


def test_metrics_count_the_keys_that_expire_within_14_days(open_service: ServiceUnderTest) -> None:
    operator = ward(open_service, "ward-3", frozenset({KeyScope.OPERATE}))
    keys = KeyFile(open_service.store.data_dir)
    assert "intrasplat_keys_expiring 0.0" in operator.request("GET", "/metrics").text
    keys.create("ward-4", expires_at_s=time.time() + 13 * DAY_S)
    keys.create("ward-5", expires_at_s=time.time() + 15 * DAY_S)
    assert "intrasplat_keys_expiring 1.0" in operator.request("GET", "/metrics").text


def test_a_damaged_file_of_keys_lets_nobody_in(open_service: ServiceUnderTest) -> None:
    holder = ward(open_service, "ward-3")
    assert holder.request("GET", "/jobs").status_code == 200
    (open_service.store.data_dir / KEYS_FILE).write_text("{")
    assert_problem(holder.request("GET", "/jobs"), 503)
    assert_problem(open_service.http.get("/jobs"), 401, "Authorization")


def test_on_loopback_no_key_is_needed_a_wrong_one_is_refused_and_a_right_one_counts(service: ServiceUnderTest) -> None:
    local_id = service.finished_scene()
    assert_problem(service.http.request("GET", "/jobs", headers={"X-API-Key": "isp_1_2"}), 401, "Authorization")
    holder = ward(service, "ward-3")
    assert holder.request("GET", "/jobs").json() == []
    assert holder.request("GET", f"/scenes/{local_id}").status_code == 404
    assert service.http.get(f"/scenes/{local_id}").status_code == 200


def test_no_scene_is_shown_unasked_when_several_are_owned_and_none_of_others_ever(
    open_service: ServiceUnderTest,
) -> None:
    mine, theirs = ward(open_service, "ward-3"), ward(open_service, "ward-4")
    first = open_service.finished_scene(mine.headers)
    assert_problem(theirs.request("GET", "/render"), 400, "scene")
    assert mine.request("GET", "/render").headers["x-intrasplat-scene"] == first
    open_service.finished_scene(mine.headers)
    assert_problem(mine.request("GET", "/render"), 400, "scene")


def test_a_caller_that_asks_too_often_hears_when_to_come_back_and_others_are_served(tmp_path: Path) -> None:
    for service in running_service(tmp_path, host=NETWORK, requests_per_s=3.0):
        hasty, calm = ward(service, "ward-3"), ward(service, "ward-4")
        responses = [hasty.request("GET", "/jobs") for _ in range(8)]
        assert responses[0].status_code == 200
        assert_problem(responses[-1], 429)
        assert int(responses[-1].headers["retry-after"]) >= 1
        assert "ratelimit" in responses[-1].headers
        assert calm.request("GET", "/jobs").status_code == 200


def test_what_is_done_is_in_the_audit_and_a_view_once_a_minute(open_service: ServiceUnderTest) -> None:
    holder = ward(open_service, "ward-3")
    done = open_service.finished_scene(holder.headers)
    for _ in range(5):
        assert holder.request("GET", f"/render?scene={done}").status_code == 200
    holder.request("GET", f"/scenes/{done}")
    holder.request("GET", f"/scenes/{done}/export")
    failed = holder.upload()
    _, claim = open_service.claimed()
    open_service.queue.fail(claim, JobError(problem="no depth."))
    holder.request("POST", f"/jobs/{failed}/retry")
    holder.request("DELETE", f"/jobs/{failed}")
    holder.request("DELETE", f"/scenes/{done}")
    recorded = acts(open_service)
    views = recorded.count(("viewed", "ok", done))
    assert views in (1, 2)  # a minute may have ended in between
    assert [act for act in recorded if act[0] != "viewed"] == [
        ("accepted", "ok", done),
        ("exported", "ok", done),
        ("accepted", "ok", failed),
        ("retried", "ok", failed),
        ("cancelled", "ok", failed),
        ("purged", "begun (request)", done),
        ("purged", "done (request)", done),
    ]
    key_id = KeyFile(open_service.store.data_dir).list()[0].key_id
    assert {(line["tenant"], line["key_id"]) for line in audit(open_service)} == {("ward-3", key_id)}
    assert all(line["request_id"] for line in audit(open_service))


def test_what_cannot_be_recorded_does_not_happen(service: ServiceUnderTest) -> None:
    scene_id = service.finished_scene()
    queued = service.upload().json()["id"]
    path = service.store.data_dir / AUDIT_FILE
    path.rename(path.with_suffix(".away"))
    path.mkdir()
    for method, asked in (
        ("GET", f"/render?scene={scene_id}"),
        ("GET", f"/scenes/{scene_id}"),
        ("GET", f"/scenes/{scene_id}/export"),
        ("DELETE", f"/scenes/{scene_id}"),
        ("DELETE", f"/jobs/{queued}"),
    ):
        assert_problem(service.http.request(method, asked), 503)
    before = service.spooled()
    assert_problem(service.upload(), 503)
    assert service.spooled() == before
    assert service.painter.requests == []
    path.rmdir()
    assert service.http.get(f"/scenes/{scene_id}").status_code == 200
    assert service.http.get(f"/jobs/{queued}").json()["state"] == "queued"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_on_a_full_disk_without_a_reserve_nothing_is_shown_and_the_answer_says_why(service: ServiceUnderTest) -> None:
    scene_id = service.finished_scene()
    (service.store.data_dir / AUDIT_FILE).unlink()
    (service.store.data_dir / RESERVE_FILE).unlink(missing_ok=True)
    (service.store.data_dir / AUDIT_FILE).symlink_to("/dev/full")
    assert_problem(service.http.get(f"/render?scene={scene_id}"), 507)
    assert service.painter.requests == []


def test_a_callers_words_appear_in_no_metric_audit_problem_event_log_or_file_name(
    open_service: ServiceUnderTest, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    holder = ward(open_service, "ward-3")
    caplog.set_level(0)
    job_id = holder.upload(f"{MARKER}.mp4")
    told = [holder.request("GET", f"/jobs/{job_id}").text]
    refused = holder.request("POST", "/reconstruct", files={"clip": (f"{MARKER}.{MARKER}", CLIP)})
    assert refused.status_code == 422
    holder.request("GET", f"/{MARKER}", headers={"User-Agent": MARKER, "X-Request-Id": f"{MARKER} {MARKER}"})
    holder.request("POST", f"/jobs/{job_id}/{MARKER}")
    record, claim = open_service.claimed()
    open_service.queue.fail(claim, JobError(problem="no depth."))
    told.append(holder.request("GET", f"/jobs/{job_id}/events").text)
    told.append(holder.request("GET", "/metrics").text)
    told += [event.record.model_dump_json() for event in open_service.queue.events(job_id)]
    told.append(record.model_dump_json())
    told.append((open_service.store.data_dir / AUDIT_FILE).read_text())
    told += [str(path) for path in open_service.store.data_dir.rglob("*")]
    told += [path.read_text() for path in open_service.store.data_dir.rglob("*.json")]
    told += ["".join(capfd.readouterr())]
    assert "intrasplat_http_requests_total" in told[2]
    assert not [text for text in told if MARKER in text]
    assert not [line for line in caplog.records if line.name.startswith("intrasplat") and MARKER in line.getMessage()]


def test_folders_and_files_are_their_owners_alone(open_service: ServiceUnderTest) -> None:
    ward(open_service, "ward-3").upload()
    data_dir = Store(open_service.store.data_dir).data_dir
    assert data_dir.stat().st_mode & 0o077 == 0
    for name in (AUDIT_FILE, KEYS_FILE):
        assert (data_dir / name).stat().st_mode & 0o077 == 0
