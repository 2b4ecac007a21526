"""A service at work is backed up, and an empty machine goes on from the backup: job by job, scene by scene."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import redis

from client.cli import main
from contract.access.audit import AUDIT_FILE
from contract.access.keys import DEFAULT_SCOPES, KeyScope
from contract.backup.manifest import read_manifest
from contract.backup.restore import Restored, restore_backup
from contract.backup.take import Taken, take_backup
from contract.queue.embedded import EmbeddedServer
from contract.queue.installed import installed_queue
from contract.queue.redis_queue import PREFIX, RedisQueue
from contract.runtime.exits import ExitCode
from contract.runtime.settings import Settings
from contract.wire.job import TERMINAL_STATES, JobRecord, JobState
from tests.contract.queues import ERROR, TRAINING
from tests.service.under_test import ServiceUnderTest, another_clip, bearer, running_service

LABELS = {"label": "liver, left", "metadata": {"ris": "0815"}}
ALL = [*DEFAULT_SCOPES, KeyScope.PURGE, KeyScope.PRIORITY]


class Meanwhile(RedisQueue):
    """A queue of which each reading of all records is preceded by an act of somebody else."""

    def __init__(self, url: str, *acts: Callable[[], object]) -> None:
        super().__init__(url)
        self._acts = list(acts)

    def records(self, *arguments: Any, **named: Any) -> list[JobRecord]:
        if self._acts:
            self._acts.pop(0)()
        return super().records(*arguments, **named)


@contextmanager
def installation(data_dir: Path) -> Iterator[tuple[ServiceUnderTest, str]]:
    """A service with the embedded queue of its data directory, and the queue's address."""
    server = EmbeddedServer(data_dir)
    server.start()
    with ExitStack() as ended:
        ended.callback(server.stop)
        yield next(run := running_service(data_dir, RedisQueue(server.url))), server.url
        for _ in run:
            pass


class Ward:
    """A tenant's jobs in every state."""

    def __init__(self, service: ServiceUnderTest, headers: dict[str, str] | None = None) -> None:
        self.service = service
        self.headers = headers or bearer(service, "ward-3", ALL)
        self.sent = 0

    def send(self, options: str = "{}") -> str:
        self.sent += 1
        parts = {"clip": ("a.mp4", another_clip(str(self.sent).encode()))}
        answer = self.service.upload(options, parts, self.headers)
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def done(self) -> str:
        return self.service.finished_scene(self.headers)

    def failed(self) -> str:
        self.send()
        record, claim = self.service.claimed()
        assert self.service.queue.fail(claim, ERROR)
        return record.job_id

    def cancelled(self) -> str:
        job_id = self.send()
        assert self.service.http.request("DELETE", f"/jobs/{job_id}", headers=self.headers).is_success
        return job_id

    def label(self, job_id: str) -> None:
        answer = self.service.http.request("PATCH", f"/jobs/{job_id}", json=LABELS, headers=self.headers)
        assert answer.is_success, answer.text

    def purge(self, job_id: str) -> None:
        answer = self.service.http.request("DELETE", f"/scenes/{job_id}", headers=self.headers)
        assert answer.is_success, answer.text

    def views(self) -> dict[str, dict[str, Any]]:
        listed = self.service.http.get("/jobs", headers=self.headers, params={"limit": 200}).json()
        return {view["id"]: view for view in listed}


def kept(view: Mapping[str, Any]) -> dict[str, Any]:
    """What must be as it was of a job: of one that had ended, all of it."""
    names = ["id", "label", "metadata", "options", "input_bytes", "created_at_s", "clip_of"]
    if view["state"] in TERMINAL_STATES:
        names += ["state", "error", "attempt", "started_at_s", "finished_at_s", "stage", "links"]
    return {name: view[name] for name in names}


def test_a_busy_service_comes_back_on_an_empty_machine_job_by_job(tmp_path: Path) -> None:
    old, new, shelf = tmp_path / "old", tmp_path / "new", tmp_path / "backups"
    with installation(old) as (service, url):
        ward = Ward(service)
        purged_before, done, purged_after, purged_meanwhile = (ward.done() for _ in range(4))
        failed, cancelled, running = ward.failed(), ward.cancelled(), ward.send()
        _, claim = service.claimed()
        service.queue.beat(claim, TRAINING)
        queued = [ward.send(), ward.send('{"priority": "high"}'), ward.send()]
        for job_id in (done, failed, queued[0]):
            ward.label(job_id)
        ward.purge(purged_before)

        def after_the_first_copy() -> None:
            queued.append(ward.send())
            ward.label(queued[2])

        def after_the_last_copy() -> None:
            too_late.append(ward.send())
            views.update(ward.views())
            ward.purge(purged_meanwhile)

        too_late: list[str] = []
        views: dict[str, dict[str, Any]] = {}
        queue = Meanwhile(url, after_the_first_copy, after_the_last_copy)
        taken = take_backup(Settings(data_dir=old), queue, shelf)
        queue.close()
        ward.purge(purged_after)
    assert (taken.purged, taken.without_files) == ((purged_meanwhile,), ())
    assert main(["restore", str(shelf), "--data-dir", str(new), "--audit", str(old / AUDIT_FILE)]) == ExitCode.OK

    gone = {purged_before, purged_meanwhile, purged_after}
    expected = {job_id: view for job_id, view in views.items() if job_id not in {*gone, *too_late}}
    with installation(new) as (service, _):
        found = Ward(service, ward.headers).views()  # the old key opens the restored service
        assert {job_id: kept(view) for job_id, view in found.items()} == {
            job_id: kept(view) for job_id, view in expected.items()
        }
        assert {found[job_id]["state"] for job_id in (running, *queued)} == {"queued"}
        for job_id in gone:
            assert service.http.get(f"/scenes/{job_id}", headers=ward.headers).status_code == 404
            assert list(new.glob(f"*/{job_id}*")) == []
        assert service.http.get(f"/render?scene={done}&t=0", headers=ward.headers).is_success
        assert (found[cancelled]["state"], found[failed]["state"]) == ("cancelled", "failed")
        claimed = [service.queue.claim(f"worker-{number}", 0.0) for number in range(5)]
        assert [record and record.job_id for record in claimed] == [queued[1], running, queued[0], *queued[2:]]
        assert service.http.post(f"/jobs/{failed}/retry", headers=ward.headers).is_success
    told = [json.loads(line)["action"] for line in (new / AUDIT_FILE).read_text().splitlines()]
    assert told.count("restored") == 1


def restored_into(folder: Path, source: Path, *audits: Path) -> tuple[Restored, dict[str, JobRecord]]:
    """Restore into a new data directory with its own queue; the records of that queue."""
    settings = Settings(data_dir=folder)
    restored = restore_backup(settings, installed_queue(settings), source, audits)
    with installed_queue(settings) as queue:
        return restored, {record.job_id: record for record in queue.records(None, None)}


def test_whatever_happens_while_backups_are_taken_each_holds_all_that_was_acknowledged(tmp_path: Path) -> None:
    old, chance, ended = tmp_path / "old", random.Random(7), threading.Event()
    over: list[str] = []
    asked: list[str] = []  # to be purged
    purged: list[str] = []  # of them, those whose purge was acknowledged
    faults: list[BaseException] = []

    with installation(old) as (service, url):
        ward = Ward(service)

        def work() -> None:
            try:
                while not ended.is_set():
                    act = chance.choice(("send", "done", "failed", "cancelled", "purge", "label"))
                    if act == "send":
                        ward.send()
                    elif act == "purge" and over:
                        asked.append(over.pop(chance.randrange(len(over))))
                        ward.purge(asked[-1])
                        purged.append(asked[-1])
                    elif act == "label" and over:
                        ward.label(chance.choice(over))
                    elif act in ("done", "failed", "cancelled"):
                        over.append(getattr(ward, act)())
            except BaseException as error:
                faults.append(error)

        thread = threading.Thread(target=work)
        thread.start()
        kept: list[tuple[Taken, set[str], set[str]]] = []
        queue = RedisQueue(url)
        for number in range(1, 7):
            while len(purged) < number and thread.is_alive():
                time.sleep(0.01)
            before, gone_before = {record.job_id for record in queue.records(None, None)}, set(purged)
            taken = take_backup(Settings(data_dir=old), queue, tmp_path / "backups")
            kept.append((taken, before - set(asked), gone_before))
        ended.set()
        thread.join()
        queue.close()
        gone_at_last = set(purged)
    assert faults == []
    for number, (taken, acknowledged, gone) in enumerate(kept):
        restored, records = restored_into(tmp_path / f"new-{number}", taken.path)
        assert (restored.lost, taken.without_files) == ([], ())
        assert acknowledged - records.keys() == set()
        assert gone & records.keys() == set()
        assert {record.state for record in records.values()} <= {JobState.QUEUED, *TERMINAL_STATES}
    _, records = restored_into(tmp_path / "newest", tmp_path / "backups", old / AUDIT_FILE)
    assert gone_at_last & records.keys() == set()
    assert [path for job_id in gone_at_last for path in (tmp_path / "newest").glob(f"*/{job_id}*")] == []


def restore_and_be_killed(source: Path, folder: Path) -> None:
    submit = RedisQueue.submit

    class Deadly(RedisQueue):
        entered = 0

        def submit(self, *arguments: Any) -> JobRecord:
            if self.entered == 2:
                os._exit(9)
            self.entered += 1
            return submit(self, *arguments)

    @contextmanager
    def deadly(settings: Settings) -> Iterator[RedisQueue]:
        server = EmbeddedServer(settings.data_dir)
        server.start()
        yield Deadly(server.url)

    settings = Settings(data_dir=folder)
    restore_backup(settings, deadly(settings), source)


def test_a_restore_that_was_killed_goes_on_when_it_is_run_again(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    with installation(old) as (service, url):
        ward = Ward(service)
        done, queued = ward.done(), [ward.send() for _ in range(4)]
        queue = RedisQueue(url)
        taken = take_backup(Settings(data_dir=old), queue, tmp_path / "backups")
        queue.close()
    new.mkdir()
    kill = multiprocessing.get_context("spawn").Process(target=restore_and_be_killed, args=(taken.path, new))
    kill.start()
    kill.join()
    assert kill.exitcode == 9
    restored, records = restored_into(new, taken.path)
    assert restored.jobs == {JobState.DONE: 1, JobState.QUEUED: 4}
    assert records.keys() == {done, *queued}
    with installed_queue(Settings(data_dir=new)) as queue:
        claimed = [queue.claim(f"worker-{number}", 0.0) for number in range(4)]
    assert [record and record.job_id for record in claimed] == queued


def test_jobs_whose_records_cannot_be_read_are_named_and_come_back_from_their_clips(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new, shelf = tmp_path / "old", tmp_path / "new", tmp_path / "backups"
    with installation(old) as (service, url):
        ward = Ward(service)
        sound, damaged, left = ward.send(), ward.send(), ward.cancelled()
        with redis.Redis.from_url(url) as client:
            for job_id in (damaged, left):
                client.hset(f"{PREFIX}job:{job_id}", "document", "{")
        assert main(["backup", str(shelf), "--data-dir", str(old)]) == ExitCode.FAILED
    told, names = capsys.readouterr(), ", ".join(sorted([damaged, left]))
    assert "1 jobs (1 queued)" in told.err
    assert re.search(f"2 jobs have records that cannot be read.*: {names}", told.err)
    backup = Path(told.out.strip())
    assert set(read_manifest(backup).unreadable) == {damaged, left}
    assert main(["restore", str(backup), "--data-dir", str(new)]) == ExitCode.OK
    assert names in capsys.readouterr().err
    with installation(new) as (service, _):
        found = Ward(service, ward.headers).views
        deadline_s = time.monotonic() + 30.0
        while found().keys() != {sound, damaged} and time.monotonic() < deadline_s:
            time.sleep(0.05)
        assert found().keys() == {sound, damaged}
