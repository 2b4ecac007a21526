"""A purge leaves nothing and says so; retention purges in time; what was cut off is finished."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import redis

from contract.access.audit import AUDIT_FILE, RESERVE_FILE, AuditAction, AuditLog
from contract.queue.embedded import EmbeddedServer
from contract.queue.interface import Claim
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.store.store import PURGING, Store
from contract.wire.job import JobError, JobFiles, JobRecord
from intrasplat.errors import InputError, UnavailableError
from intrasplat.names import CURVE, MANIFEST, REPORT
from intrasplat.options import JobOptions
from service.audit import Audit
from service.done import DoneJobs
from service.purge import LOG_CLEARED_AFTER_S, Purger
from service.questions import Questions
from service.retention import HOUR_S, Retention, check_retention, retention_hours
from tests.service.test_tus import uploaded
from tests.service.under_test import CLIP, ServiceUnderTest, assert_problem, running_service

KEPT_FILES = {AUDIT_FILE, RESERVE_FILE}
"""What tells of a job after its purge: that it was purged."""


def files_of(data_dir: Path) -> list[Path]:
    """All files but those of the queue's server, whose log is looked into by itself."""
    found = [path for path in data_dir.rglob("*") if path.is_file() or not path.is_dir()]
    return [path for path in found if path.relative_to(data_dir).parts[0] not in ("valkey", "run")]


def traces_of(data_dir: Path, job_id: str) -> list[Path]:
    """Whatever names the job, or holds its id."""
    named = [path for path in data_dir.rglob("*") if job_id in path.name]
    holding = [path for path in files_of(data_dir) if path.name not in KEPT_FILES]
    return named + [path for path in holding if job_id.encode() in path.read_bytes()]


def upload_in_pieces(service: ServiceUnderTest) -> str:
    """A job whose clip came as a resumable upload."""
    job_id: str = service.http.post("/reconstruct", json={"clip": uploaded(service)}).json()["id"]
    return job_id


def failed_job(service: ServiceUnderTest, job_id: str) -> str:
    record, claim = service.claimed()
    assert record.job_id == job_id
    assert service.queue.fail(claim, JobError(problem="no depth."))
    return job_id


def parts(service: ServiceUnderTest) -> tuple[Purger, Retention]:
    settings = Settings(data_dir=service.store.data_dir, retention_hours=1.0)
    done = DoneJobs(service.queue, service.store, Questions())
    purger = Purger(service.queue, service.store, Audit(AuditLog(service.store.data_dir)), done)
    return purger, Retention(settings, service.queue, service.store, purger)


def test_a_purge_leaves_nothing_and_its_receipt_counts_what_there_was(service: ServiceUnderTest) -> None:
    scene_id = service.finished_scene()
    sizes = {
        area: sum(path.stat().st_size for path in (service.store.data_dir / area).rglob("*") if path.is_file())
        for area in ("spool", "scenes")
    }
    response = service.http.delete(f"/scenes/{scene_id}")
    assert response.status_code == 200
    receipt = response.json()
    assert (receipt["job_id"], receipt["record"], receipt["verified"]) == (scene_id, True, True)
    assert receipt["files"] == {"incoming": 0, "spool": 2, "work": 0, "kept": 0, "scenes": 3, "uploads": 0}
    assert (receipt["bytes"]["spool"], receipt["bytes"]["scenes"]) == (sizes["spool"], sizes["scenes"])
    assert receipt["purged_at"].startswith("20")
    assert traces_of(service.store.data_dir, scene_id) == []
    assert not [path for path in files_of(service.store.data_dir) if CLIP in path.read_bytes()]
    assert (service.queue.get(scene_id), service.queue.events(scene_id)) == (None, [])
    for path in (f"/scenes/{scene_id}", f"/jobs/{scene_id}", f"/render?scene={scene_id}"):
        assert_problem(service.http.get(path), 404, "job_id" if "jobs" in path else "scene")
    assert_problem(service.http.delete(f"/scenes/{scene_id}"), 404, "scene")


def test_a_purge_takes_resumable_uploads_along(service: ServiceUnderTest) -> None:
    job_id = failed_job(service, upload_in_pieces(service))
    receipt = service.http.delete(f"/scenes/{job_id}").json()
    assert receipt["files"]["uploads"] >= 1
    assert traces_of(service.store.data_dir, job_id) == []
    assert service.spooled() == []


def test_an_upload_that_its_job_had_not_noted_yet_is_found_by_its_file(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    failed_job(service, job_id)
    upload = service.store.open_incoming("e" * 32)
    declaration = {"tenant": "local", "part": "clip", "suffix": ".mp4", "length_bytes": len(CLIP), "created_at_s": 1.0}
    (upload / "upload.json").write_text(json.dumps(declaration))
    os.link(service.store.spool_folder(job_id) / "clip.mp4", upload / "clip.mp4")
    assert service.http.delete(f"/scenes/{job_id}").json()["files"]["uploads"] == 2
    assert traces_of(service.store.data_dir, job_id) == []


def test_a_live_job_is_not_purged(service: ServiceUnderTest) -> None:
    job_id = service.upload().json()["id"]
    assert "Cancel it first" in assert_problem(service.http.delete(f"/scenes/{job_id}"), 409, "scene_id")["remedy"]
    service.claimed()
    assert_problem(service.http.delete(f"/scenes/{job_id}"), 409, "scene_id")
    assert service.spooled() != []
    assert not (service.store.data_dir / PURGING).exists()


@pytest.mark.parametrize("cut_at", ["store.purge", "queue.forget"])
@pytest.mark.parametrize("finisher", ["again", "retention"])
def test_a_purge_that_was_cut_off_is_finished(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch, cut_at: str, finisher: str
) -> None:
    scene_id = service.finished_scene()
    part, method = cut_at.split(".")
    with monkeypatch.context() as patch:

        def cut(*arguments: Any) -> None:
            raise UnavailableError("The power went.", "Wait.")

        patch.setattr(getattr(service, part), method, cut)
        assert_problem(service.http.delete(f"/scenes/{scene_id}"), 503)
    if finisher == "again":
        assert service.http.delete(f"/scenes/{scene_id}").json()["verified"] is True
    else:
        _, retention = parts(service)
        retention.purge_due(time.time())
        assert service.queue.get(scene_id) is not None  # so young a note may be of a purge that is under way
        note = service.store.data_dir / PURGING / scene_id
        os.utime(note, (1.0, 1.0))
        retention.purge_due(time.time())
        assert not note.exists()
    assert service.queue.get(scene_id) is None
    assert traces_of(service.store.data_dir, scene_id) == []


def test_a_job_that_is_retried_during_its_purge_is_not_reported_as_purged(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = failed_job(service, service.upload().json()["id"])
    purge = service.store.purge

    def purge_while_somebody_retries(purged_id: str) -> Any:
        service.queue.retry(purged_id)
        return purge(purged_id)

    monkeypatch.setattr(service.store, "purge", purge_while_somebody_retries)
    assert_problem(service.http.delete(f"/scenes/{job_id}"), 409, "scene_id")
    assert (service.store.data_dir / PURGING / job_id).exists()


def test_several_services_may_purge_the_same_job_at_once(service: ServiceUnderTest) -> None:
    for _ in range(10):
        job_id = failed_job(service, upload_in_pieces(service))
        purgers = [parts(service)[0] for _ in range(4)]
        with ThreadPoolExecutor(len(purgers)) as pool:
            purges = [pool.submit(purger.purge, job_id, None) for purger in purgers]
        assert all(purge.result().verified for purge in purges)
        assert traces_of(service.store.data_dir, job_id) == []


def test_retention_purges_in_time_and_nothing_before_and_nothing_live(service: ServiceUnderTest) -> None:
    own = service.upload('{"retention_hours": 3}').json()["id"]
    failed_job(service, own)
    usual = failed_job(service, service.upload().json()["id"])
    waiting = service.upload().json()["id"]
    _, retention = parts(service)
    now_s = time.time()
    assert retention.purge_due(now_s + 0.9 * HOUR_S) == 0
    assert retention.purge_due(now_s + 1.1 * HOUR_S) == 1
    assert [service.queue.get(job_id) is None for job_id in (own, usual, waiting)] == [False, True, False]
    assert retention.purge_due(now_s + 3.1 * HOUR_S) == 1
    assert [service.queue.get(job_id) is None for job_id in (own, usual, waiting)] == [True, True, False]
    assert traces_of(service.store.data_dir, own) == []
    lines = [json.loads(line) for line in (service.store.data_dir / AUDIT_FILE).read_text().splitlines()]
    purged = [line for line in lines if line["action"] == AuditAction.PURGED and line["job_id"] == own]
    assert [line["outcome"] for line in purged] == ["begun (retention)", "done (retention)"]
    assert "tenant" not in purged[0]


def test_one_job_that_cannot_be_purged_keeps_no_other(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck = failed_job(service, service.upload().json()["id"])
    other = failed_job(service, service.upload().json()["id"])
    purge = service.store.purge

    def purge_but_one(job_id: str) -> Any:
        if job_id == stuck:
            raise UnavailableError("The disk fails.", "Mend it.")
        return purge(job_id)

    monkeypatch.setattr(service.store, "purge", purge_but_one)
    _, retention = parts(service)
    assert retention.purge_due(time.time() + 2 * HOUR_S) == 1
    assert service.queue.get(other) is None
    assert service.queue.get(stuck) is not None


@pytest.mark.parametrize(
    ("asked", "usual", "most", "kept"),
    [
        (None, None, None, None),
        (5.0, None, None, 5.0),
        (5.0, 2.0, None, 5.0),
        (None, 2.0, None, 2.0),
        (None, None, 7.0, 7.0),
        (None, 9.0, 7.0, 7.0),
        (5.0, 9.0, 7.0, 5.0),
    ],
)
def test_a_job_is_kept_as_long_as_it_asks_else_as_usual_and_never_longer_than_the_maximum(
    asked: float | None, usual: float | None, most: float | None, kept: float | None
) -> None:
    settings = Settings(retention_hours=usual, max_retention_hours=most)
    assert retention_hours(JobOptions(retention_hours=asked), settings) == kept
    check_retention(JobOptions(retention_hours=asked), settings)


def test_asking_to_be_kept_longer_than_the_maximum_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="7 hours"):
        check_retention(JobOptions(retention_hours=8.0), Settings(max_retention_hours=7.0))
    for service in running_service(tmp_path, max_retention_hours=7.0):
        assert_problem(service.upload('{"retention_hours": 8}'), 422, "options.retention_hours")
        assert service.spooled() == []


@pytest.fixture
def valkey(tmp_path: Path) -> Iterator[EmbeddedServer]:
    server = EmbeddedServer(tmp_path / "data")
    server.start()
    yield server
    server.stop()


def test_a_purge_leaves_no_key_in_the_queues_server_that_names_the_job(valkey: EmbeddedServer, tmp_path: Path) -> None:
    queue, store = RedisQueue(valkey.url), Store(tmp_path / "data")
    purger = Purger(queue, store, Audit(AuditLog(store.data_dir)), DoneJobs(queue, store, Questions()))
    kept, purged = new_job_id(), new_job_id()
    for job_id in (kept, purged):
        files = JobFiles(clip="clip.mp4")
        record = JobRecord(job_id=job_id, files=files, created_at_s=time.time(), idempotency_key=job_id * 2)
        (store.open_incoming(job_id) / "clip.mp4").write_bytes(CLIP)
        store.accept(record)
        queue.submit(record)
        claimed = queue.claim("worker-1", 0.0)
        assert claimed is not None
        folder = store.work_folder(job_id, claimed.attempt)
        for name in (MANIFEST, REPORT, CURVE):
            (folder / name).write_text("{}")
        store.publish_scene(job_id, claimed.attempt)
        assert queue.finish(Claim(job_id, claimed.attempt, "worker-1"))
    assert naming(valkey, purged)
    assert purger.purge(purged, None).verified
    assert naming(valkey, kept)
    assert traces_of(store.data_dir, purged) == []
    with redis.Redis.from_url(valkey.url) as client:
        for key in naming(valkey, purged):  # for a minute the queue may know that this id is gone, and nothing else
            assert b"forgotten" in key
            assert 0 < client.pttl(key) <= 60_000
            client.delete(key)
    purger.clear_log(time.monotonic() + LOG_CLEARED_AFTER_S + 1.0)
    assert comes_true(lambda: not log_names(store.data_dir, purged))
    assert log_names(store.data_dir, kept)
    queue.close()


def log_names(data_dir: Path, job_id: str) -> bool:
    """Whether the server's log on disk holds the id."""
    return any(job_id.encode() in path.read_bytes() for path in files_below(data_dir / "valkey"))


def files_below(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def comes_true(is_so: Callable[[], bool]) -> bool:
    """Whether it is so within ten seconds."""
    deadline_s = time.monotonic() + 10.0
    while time.monotonic() < deadline_s:
        with contextlib.suppress(FileNotFoundError):  # files come and go while the log is rewritten
            if is_so():
                return True
        time.sleep(0.05)
    return False


def naming(server: EmbeddedServer, job_id: str) -> list[bytes]:
    """Keys of the server whose name or content holds the id."""
    with redis.Redis.from_url(server.url) as client:
        return [key for key in client.scan_iter() if job_id.encode() in key + b"%r" % [content(client, key)]]


def content(client: Any, key: bytes) -> Any:
    match client.type(key):
        case b"hash":
            return client.hgetall(key)
        case b"stream":
            return client.xrange(key)
        case b"zset":
            return client.zrange(key, 0, -1)
        case b"set":
            return client.smembers(key)
        case b"list":
            return client.lrange(key, 0, -1)
        case _:
            return client.get(key)
