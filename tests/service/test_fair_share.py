"""What one tenant may take of a service that others share, and what needs a scope of its own."""

from __future__ import annotations

import base64
import contextlib
from pathlib import Path

import pytest

from contract.access.keys import DEFAULT_SCOPES, KeyScope
from contract.runtime.settings import Settings
from contract.store.store import Store
from service.intake import Intake
from service.problems import Problem
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer, running_service

OPEN = {"host": "0.0.0.0", "hosts": ("127.0.0.1",)}
GIB = 2**30


def announced(service: ServiceUnderTest, headers: dict[str, str], length_bytes: int) -> int:
    metadata = f"part {base64.b64encode(b'clip').decode()},suffix {base64.b64encode(b'.mp4').decode()}"
    asked = {"Tus-Resumable": "1.0.0", "Upload-Length": str(length_bytes), "Upload-Metadata": metadata}
    response = service.http.post("/uploads", headers=headers | asked)
    if response.status_code == 429:
        assert_problem(response, 429, "uploads")
        assert response.headers["retry-after"]
    return response.status_code


def test_one_tenant_holds_half_of_the_places_of_uploads_and_another_finds_one(tmp_path: Path) -> None:
    intake = Intake(Settings(data_dir=tmp_path, max_uploads=4, min_free_bytes=0), Store(tmp_path))
    with contextlib.ExitStack() as held:
        for _ in range(2):
            held.enter_context(intake.slot("ward-3"))
        with pytest.raises(Problem) as refused:
            held.enter_context(intake.slot("ward-3"))
        assert (refused.value.status, refused.value.field) == (429, "uploads")
        for _ in range(2):
            held.enter_context(intake.slot("ward-4"))
        with pytest.raises(Problem) as refused:
            held.enter_context(intake.slot("ward-5"))
        assert refused.value.status == 503
    with intake.slot("ward-3"):
        pass


def test_where_there_is_one_place_anybody_may_have_it(tmp_path: Path) -> None:
    intake = Intake(Settings(data_dir=tmp_path, max_uploads=1, min_free_bytes=0), Store(tmp_path))
    with intake.slot("ward-3"), pytest.raises(Problem) as refused, intake.slot("ward-4"):
        pass
    assert refused.value.status == 503


def test_uploads_of_one_tenant_are_promised_half_of_the_disk_and_those_of_another_find_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for service in running_service(tmp_path, **OPEN, max_upload_bytes=60 * GIB):
        monkeypatch.setattr(service.store, "free_bytes", lambda: 40 * GIB)
        one, other = (bearer(service, tenant) for tenant in ("ward-3", "ward-4"))
        assert [announced(service, one, 4 * GIB) for _ in range(7)] == [201] * 5 + [429] * 2
        assert announced(service, other, 4 * GIB) == 201


def test_the_first_upload_of_a_tenant_may_need_more_than_half_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for service in running_service(tmp_path, max_upload_bytes=60 * GIB):
        monkeypatch.setattr(service.store, "free_bytes", lambda: 40 * GIB)
        assert announced(service, {}, 30 * GIB) == 201
        assert announced(service, {}, 1) == 429


@pytest.mark.parametrize(
    ("options", "scope"),
    [
        ('{"priority": "high"}', KeyScope.PRIORITY),
        ('{"budget_s": 601}', KeyScope.LONG),
        ('{"iterations": 6001}', KeyScope.LONG),
    ],
)
def test_high_priority_and_long_trainings_need_a_scope(tmp_path: Path, options: str, scope: KeyScope) -> None:
    for service in running_service(tmp_path, **OPEN):
        without, having = (bearer(service, "ward-3", DEFAULT_SCOPES | more) for more in (set(), {scope}))
        assert scope.value in assert_problem(service.upload(options, headers=without), 403, "Authorization")["detail"]
        assert service.queue.records() == []
        assert service.spooled() == []
        assert service.upload(options, headers=having).status_code == 202
        assert service.upload('{"budget_s": 600}', headers=without).status_code == 202
