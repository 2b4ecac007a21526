"""Lists: searched, and read page by page while jobs come and go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from contract.store.shelf import new_job_id
from contract.wire.errors import UnavailableError
from contract.wire.job import JobFiles, JobRecord
from contract.wire.labels import Labels
from contract.wire.options import JobOptions
from service import listing
from service.listing import NEXT_HEADER
from tests.memory_queue import MemoryQueue
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer, running_service


def submit(service: ServiceUnderTest, created_at_s: float, tenant: str = "local", **labels: Any) -> str:
    preset = labels.pop("preset", "fast")
    record = JobRecord(
        job_id=new_job_id(),
        files=JobFiles(clip="clip.mp4"),
        options=JobOptions(preset=preset),
        labels=Labels(**labels),
        tenant=tenant,
        created_at_s=created_at_s,
    )
    return service.queue.submit(record).job_id


def listed(service: ServiceUnderTest, path: str = "/jobs", **query: Any) -> list[str]:
    response = service.http.get(path, params=query)
    assert response.status_code == 200, response.text
    return [each["id"] for each in response.json()]


def pages(service: ServiceUnderTest, **query: Any) -> list[list[str]]:
    found: list[list[str]] = []
    while True:
        response = service.http.get("/jobs", params=query)
        found.append([each["id"] for each in response.json()])
        if NEXT_HEADER not in response.headers:
            return found
        query["cursor"] = response.headers[NEXT_HEADER]


def test_pages_go_through_all_jobs_once_also_those_of_one_moment(service: ServiceUnderTest) -> None:
    ids = [submit(service, 1000.0 + i // 3) for i in range(9)]
    found = pages(service, limit=2)
    assert [len(page) for page in found] == [2, 2, 2, 2, 1]
    assert sorted(each for page in found for each in page) == sorted(ids)
    assert pages(service, limit=9) == [listed(service)]


def test_jobs_that_come_and_go_meanwhile_repeat_and_hide_none(service: ServiceUnderTest) -> None:
    ids = [submit(service, 1000.0 + i) for i in range(6)]
    first = service.http.get("/jobs", params={"limit": 2})
    submit(service, 2000.0)
    service.queue.cancel(ids[4])
    service.queue.forget(ids[4])  # the last of the page
    rest = listed(service, cursor=first.headers[NEXT_HEADER])
    assert [each["id"] for each in first.json()] + rest == ids[::-1]


def test_jobs_are_found_by_words_metadata_preset_state_and_date(service: ServiceUnderTest) -> None:
    a = submit(service, 1000.0, label="Left Kidney", metadata={"ris": "17", "room": "OR 2"})
    b = submit(service, 2000.0, label="left lobe", metadata={"ris": "170"}, preset="instant")
    c = submit(service, 3000.0)
    service.queue.cancel(c)
    assert listed(service, q="LEFT") == [b, a]
    assert listed(service, q="left or") == [a]
    assert listed(service, q="ris") == []
    assert listed(service, q=c[:6].upper()) == [c]
    assert listed(service, q=c[:3]) in ([], [c])  # too short to be an id
    assert listed(service, metadata="ris=17") == [a]
    assert listed(service, metadata=["ris=17", "room=OR 2"]) == [a]
    assert listed(service, metadata=["ris=17", "room=OR 3"]) == []
    assert listed(service, preset="instant") == [b]
    assert listed(service, state="cancelled") == [c]
    assert listed(service, created_from_s=2000) == [c, b]
    assert listed(service, created_until_s=2000) == [b, a]
    assert listed(service, created_from_s=1500, created_until_s=2500) == [b]


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ({"cursor": "x"}, "cursor"),
        ({"cursor": "eA"}, "cursor"),
        ({"cursor": "é"}, "cursor"),
        ({"metadata": "ris"}, "metadata"),
        ({"preset": "fsat"}, "preset"),
        ({"created_from_s": "nan"}, "created_from_s"),
        ({"limit": 201}, "limit"),
        ({"q": "x" * 201}, "q"),
    ],
)
def test_a_search_that_cannot_be_names_its_field(service: ServiceUnderTest, query: dict[str, Any], field: str) -> None:
    for path in ("/jobs", "/scenes"):
        assert_problem(service.http.get(path, params=query), 422, field)


def test_a_cursor_is_its_tenants(tmp_path: Path) -> None:
    for service in running_service(tmp_path, host="0.0.0.0"):
        own, other = bearer(service, "ward-1"), bearer(service, "ward-2")
        for i in range(3):
            submit(service, 1000.0 + i, "ward-1", label="x")
        first = service.http.get("/jobs", params={"limit": 1}, headers=own)
        query = {"cursor": first.headers[NEXT_HEADER]}
        assert len(service.http.get("/jobs", params=query, headers=own).json()) == 2
        assert_problem(service.http.get("/jobs", params=query, headers=other), 422, "cursor")
        assert service.http.get("/jobs", params={"q": "x"}, headers=other).json() == []


def test_a_search_among_many_goes_on_in_the_next_page(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listing, "MAX_LISTED", 2)
    monkeypatch.setattr(listing, "MAX_LOOKED_AT", 4)
    wanted = submit(service, 1.0, label="wanted")
    for i in range(6):
        submit(service, 1000.0 + i)
    found = pages(service, q="wanted")
    assert found[0] == []
    assert [each for page in found for each in page] == [wanted]


def test_scenes_are_paged_and_found_alike_while_the_queue_is_away(tmp_path: Path) -> None:
    queue = MemoryQueue()
    for service in running_service(tmp_path, queue):
        scenes = [service.finished_scene() for _ in range(3)]
        change = {"label": "kidney", "metadata": {"ris": "17"}}
        assert service.http.request("PATCH", f"/jobs/{scenes[1]}", json=change).status_code == 200
        told = service.http.get("/scenes", params={"limit": 2})
        assert listed(service, "/scenes", cursor=told.headers[NEXT_HEADER]) == scenes[:1]
        assert listed(service, "/scenes", q="kid", metadata="ris=17") == [scenes[1]]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(queue, "records", _away)
            away = service.http.get("/scenes", params={"limit": 2})
            assert away.headers["x-intrasplat-queue"] == "away"
            assert [each["id"] for each in away.json()] == scenes[:0:-1]
            assert listed(service, "/scenes", cursor=away.headers[NEXT_HEADER]) == scenes[:1]
            assert listed(service, "/scenes", q="kid", metadata="ris=17") == [scenes[1]]


def _away(*_: object) -> None:
    raise UnavailableError("The queue does not answer.", "Start it.")
