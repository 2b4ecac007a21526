"""Finished scenes while the queue is away: shown to their tenant, seen before or not."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from contract.queue.interface import MAX_LISTED, Place
from contract.wire.errors import UnavailableError
from contract.wire.job import JobRecord
from contract.wire.names import MANIFEST
from contract.wire.rendering import WorkerAddress
from tests.memory_queue import MemoryQueue
from tests.service.under_test import assert_problem, bearer, running_service


class LeavingQueue(MemoryQueue):
    """Goes away when it is told to."""

    is_away = False

    def get(self, job_id: str) -> JobRecord | None:
        self._stay()
        return super().get(job_id)

    def records(
        self, tenant: str | None = None, limit: int | None = MAX_LISTED, before: Place | None = None
    ) -> list[JobRecord]:
        self._stay()
        return super().records(tenant, limit, before)

    def workers(self) -> list[WorkerAddress]:
        self._stay()
        return super().workers()

    def _stay(self) -> None:
        if self.is_away:
            raise UnavailableError("The queue does not answer.", "Start it.")


def test_finished_scenes_are_shown_while_the_queue_is_away_seen_before_or_not_but_not_if_purged(tmp_path: Path) -> None:
    queue = LeavingQueue()
    for service in running_service(tmp_path, queue):
        seen, new, purged = (service.finished_scene() for _ in range(3))
        for scene in (seen, purged):
            assert service.http.get("/render", params={"scene": scene}).status_code == 200
        waiting = service.upload().json()["id"]
        queue.is_away = True
        service.store.purge(purged)
        for scene in (seen, new):
            assert service.http.get("/render", params={"scene": scene, "t": "0.3"}).status_code == 200
            for path in (f"/scenes/{scene}", f"/scenes/{scene}/curve", f"/scenes/{scene}/export"):
                assert service.http.get(path).status_code == 200, path
        assert_problem(service.http.get("/render", params={"scene": purged}), 404, "scene")
        assert_problem(service.http.get("/render", params={"scene": waiting}), 503)


def test_the_only_scene_needs_no_name_while_the_queue_is_away_but_one_of_two_does(tmp_path: Path) -> None:
    queue = LeavingQueue()
    for service in running_service(tmp_path, queue):
        scene, second = service.finished_scene(), service.finished_scene()
        assert service.http.get("/render", params={"scene": second}).status_code == 200
        queue.is_away = True
        assert_problem(service.http.get("/render"), 400, "scene")
        service.store.purge(second)
        assert service.http.get("/render").headers["X-Intrasplat-Scene"] == scene


def test_of_several_finished_attempts_none_is_shown_while_only_the_queue_knows_which_counts(tmp_path: Path) -> None:
    queue = LeavingQueue()
    for service in running_service(tmp_path, queue):
        scene, other = service.finished_scene(), service.finished_scene()
        assert service.http.get("/render", params={"scene": other}).status_code == 200
        (service.store.work_folder(scene, 2) / MANIFEST).write_text("{}")
        service.store.publish_scene(scene, 2)
        queue.is_away = True
        assert_problem(service.http.get("/render", params={"scene": scene}), 503)
        queue.is_away = False
        assert service.http.get("/render", params={"scene": scene}).status_code == 200


def test_a_tenant_sees_no_scene_of_another_while_the_queue_is_away(tmp_path: Path) -> None:
    queue = LeavingQueue()
    for service in running_service(tmp_path, queue, host="0.0.0.0", hosts=("127.0.0.1",)):
        own, other = (bearer(service, tenant) for tenant in ("ward-3", "ward-4"))
        seen, scene = service.finished_scene(own), service.finished_scene(own)
        assert service.http.get("/render", params={"scene": seen}, headers=own).status_code == 200
        queue.is_away = True
        assert service.http.get("/render", params={"scene": scene}, headers=own).status_code == 200
        assert_problem(service.http.get("/render", params={"scene": scene}, headers=other), 404, "scene")


def test_the_scenes_in_the_store_are_listed_while_the_queue_is_away(tmp_path: Path) -> None:
    queue = LeavingQueue()
    for service in running_service(tmp_path, queue, host="0.0.0.0", hosts=("127.0.0.1",)):
        own, other = (bearer(service, tenant) for tenant in ("ward-3", "ward-4"))
        scenes = [service.finished_scene(own) for _ in range(3)]
        service.finished_scene(other)
        service.upload(headers=own)
        told = service.http.get("/scenes", headers=own)
        queue.is_away = True
        service.store.purge(scenes[1])
        listed = service.http.get("/scenes", headers=own)
        assert [each["id"] for each in listed.json()] == [scenes[2], scenes[0]]
        assert listed.json()[0] == told.json()[0]
        assert (told.headers.get("X-Intrasplat-Queue"), listed.headers["X-Intrasplat-Queue"]) == (None, "away")


def test_a_queue_that_says_nothing_is_waited_for_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.done.PATIENCE_S", 0.2)
    queue = MuteQueue()
    for service in running_service(tmp_path, queue):
        scenes = [service.finished_scene() for _ in range(3)]
        assert service.http.get("/render", params={"scene": scenes.pop()}).status_code == 200
        queue.speaks.clear()
        for scene in scenes:
            assert service.http.get("/render", params={"scene": scene}).status_code == 200
        assert queue.asked == 1
        queue.speaks.set()


def test_a_service_that_starts_while_the_queue_is_away_shows_finished_scenes_and_says_that_it_is_not_ready(
    tmp_path: Path,
) -> None:
    queue = LeavingQueue()
    for service in running_service(tmp_path, queue):
        scene = service.finished_scene()
        assert service.http.get("/render", params={"scene": scene}).status_code == 200
    queue.is_away = True
    for service in running_service(tmp_path, queue):
        assert service.http.get("/healthz").status_code == 200
        assert_problem(service.http.get("/readyz"), 503, "queue")
        assert service.http.get("/render", params={"scene": scene}).status_code == 200
        assert_problem(service.http.get("/jobs"), 503)


class MuteQueue(MemoryQueue):
    """Takes every question for a record and answers none until it speaks again."""

    def __init__(self) -> None:
        super().__init__()
        self.speaks, self.asked = threading.Event(), 0
        self.speaks.set()

    def get(self, job_id: str) -> JobRecord | None:
        if not self.speaks.is_set():
            self.asked += 1
            assert self.speaks.wait(10)
        return super().get(job_id)
