"""A restore gives back what the backup holds, or says what is wrong and leaves nothing."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from contract.access.audit import AUDIT_FILE, AuditAction, AuditEntry, AuditLog, utc_now
from contract.access.keys import KeyFile
from contract.backup.manifest import JOBS_FILE, MANIFEST_FILE, digest_of
from contract.backup.restore import Restored, restore_backup
from contract.backup.take import take_backup
from contract.queue.interface import IDEMPOTENCY_S, Queue
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.store.store import RESTORING, Store, open_store
from contract.wire.errors import InputError, UnavailableError
from contract.wire.job import JobFiles, JobRecord, JobState
from tests.contract.queues import ERROR, claimed, job, known
from tests.contract.stores import BUCKET_URL, SERVICE, files_no_larger_than, finished, given_to, published
from tests.memory_queue import MemoryQueue


class Site:
    """A data directory and its queue."""

    def __init__(self, folder: Path, store_url: str | None = None) -> None:
        self.settings = Settings(data_dir=folder, store_url=store_url)
        self.store = Store(folder, store_url)
        self.queue = MemoryQueue()

    def queued(self, created_at_s: float = 5.0, **changes: Any) -> str:
        record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=created_at_s, **changes)
        (self.store.open_incoming(record.job_id) / "clip.mp4").write_bytes(b"frames")
        self.store.accept(record)
        return self.queue.submit(record).job_id

    def done(self) -> str:
        return finished(self.store, self.queue, self.queued())

    def backup(self, shelf: Path) -> Path:
        return take_backup(self.settings, self.queue, shelf).path


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path / "old")


def restored(folder: Path, queue: Queue, source: Path, *audits: Path, store_url: str | None = None) -> Restored:
    settings = Settings(data_dir=folder, store_url=store_url)
    return restore_backup(settings, contextlib.nullcontext(queue), source, audits)


def test_every_job_comes_back_into_every_kind_of_queue(site: Site, queue: Queue, tmp_path: Path) -> None:
    site.queue.submit(job())
    record, claim = claimed(site.queue)
    site.queue.fail(claim, ERROR)
    site.queue.cancel(site.queued())
    done, running, cancelling = site.done(), site.queued(), site.queued()
    assert [claimed(site.queue, f"worker-{number}")[0].job_id for number in range(2)] == [running, cancelling]
    site.queue.cancel(cancelling)
    waiting = [site.queued(), site.queued()]
    site.store.spool_folder(record.job_id).mkdir()
    (site.store.spool_folder(record.job_id) / "submission.json").write_text(record.model_dump_json())
    backup = site.backup(tmp_path / "backups")
    told = restored(tmp_path / "new", queue, backup)
    assert told.jobs == {JobState.DONE: 1, JobState.FAILED: 1, JobState.CANCELLED: 2, JobState.QUEUED: 3}
    before = {each.job_id: each for each in site.queue.records(None, None)}
    after = {each.job_id: each for each in queue.records(None, None)}
    assert after.keys() == before.keys()
    assert all(after[job_id] == before[job_id] for job_id in (done, record.job_id))
    assert after[cancelling].state is JobState.CANCELLED
    assert [claimed(queue, f"worker-{number}")[0].job_id for number in range(3)] == [running, *waiting]
    assert known(queue, running).attempt == before[running].attempt + 1


def test_a_job_that_was_done_after_its_record_was_read_is_done(site: Site, tmp_path: Path) -> None:
    job_id = site.queued()
    claimed(site.queue)
    published(site.store, job_id, 1)
    queue = MemoryQueue()
    restored(tmp_path / "new", queue, site.backup(tmp_path / "backups"))
    assert (known(queue, job_id).state, known(queue, job_id).attempt) == (JobState.DONE, 1)


def test_modes_are_the_owners_alone_and_the_audit_tells_of_the_restore(site: Site, tmp_path: Path) -> None:
    site.done()
    new = tmp_path / "new"
    new.mkdir(mode=0o755)
    restored(new, MemoryQueue(), site.backup(tmp_path / "backups"))
    modes = {(path.is_dir(), path.stat().st_mode & 0o777) for path in [new, *new.rglob("*")]}
    assert modes == {(True, 0o700), (False, 0o600)}
    actions = [json.loads(line)["action"] for line in (new / AUDIT_FILE).read_text().splitlines()]
    assert actions == ["backed-up", "restored"]


@pytest.fixture
def volume() -> Iterator[Path]:
    """As a cluster gives it to a pod: root's, and writable by the group of the pod, which this process is meanwhile."""
    base = Path(tempfile.mkdtemp(prefix="intrasplat-test-"))
    base.chmod(0o755)
    made = base / "volume"
    made.mkdir()
    os.chown(made, 0, SERVICE)
    made.chmod(0o2775)
    (made / "lost+found").mkdir(mode=0o700)
    groups = os.getgroups()
    yield made
    os.seteuid(0)
    os.setegid(0)
    os.setgroups(groups)
    shutil.rmtree(base)


def become_service() -> None:
    os.setgroups([])
    os.setegid(SERVICE)
    os.seteuid(SERVICE)


@pytest.mark.skipif(os.getuid() != 0, reason="only root may become another user")
def test_the_volume_of_a_pod_is_filled_though_it_is_its_groups_alone(site: Site, volume: Path) -> None:
    site.done()
    backup = site.backup(volume.parent / "backups")
    given_to(SERVICE, backup.parent)
    become_service()
    assert restored(volume, MemoryQueue(), backup).jobs[JobState.DONE] == 1


def test_what_later_audits_tell_was_purged_or_revoked_does_not_come_back(site: Site, tmp_path: Path) -> None:
    key, text = KeyFile(site.settings.data_dir).create("ward-3")
    other, _ = KeyFile(site.settings.data_dir).create("ward-4")
    purged, stays = site.done(), site.done()
    backup = site.backup(tmp_path / "backups")
    later = tmp_path / "later"
    later.mkdir()
    for about in (
        {"action": AuditAction.PURGED, "job_id": purged},
        {"action": AuditAction.KEY_REVOKED, "key_id": key.key_id},
    ):
        AuditLog(later).append(AuditEntry(time=utc_now(), **about))
    with (later / AUDIT_FILE).open("a") as file:
        file.write('{"chain":"cut o')
    queue, new = MemoryQueue(), tmp_path / "new"
    told = restored(new, queue, backup, later / AUDIT_FILE)
    assert (told.purged, told.revoked_keys) == ([purged], [key.key_id])
    assert [record.job_id for record in queue.records()] == [stays]
    assert list(new.rglob(f"*{purged}*")) == []
    assert KeyFile(new).find(text) is None
    assert KeyFile(new).list() == (other,)


def test_an_audit_that_cannot_be_read_is_named(site: Site, tmp_path: Path) -> None:
    site.done()
    backup = site.backup(tmp_path / "backups")
    damaged = bytearray(gzip.compress(b"a line of an audit\n" * 100))
    damaged[14] ^= 0xFF
    (tmp_path / "damaged.gz").write_bytes(damaged)
    (tmp_path / "audit.gz").write_bytes(b"no gzip")
    for name in ("audit.gz", "damaged.gz", "absent", "."):
        with pytest.raises(InputError, match="cannot be read"):
            restored(tmp_path / "new", MemoryQueue(), backup, tmp_path / name)


def test_a_backup_with_a_head_of_the_audit_is_restored(site: Site, tmp_path: Path) -> None:
    """Builds of 0.3 before its release wrote the file."""
    site.done()
    backup = site.backup(tmp_path / "backups")
    (backup / "audit.head").write_text("0" * 64)
    document = json.loads((backup / MANIFEST_FILE).read_text())
    document["files"]["audit.head"] = {"bytes": 64, "sha256": digest_of(backup / "audit.head"), "changed_ns": 0}
    (backup / MANIFEST_FILE).write_text(json.dumps(document))
    assert restored(tmp_path / "new", MemoryQueue(), backup).jobs == {JobState.DONE: 1}


@pytest.mark.parametrize("text", ["audit\n", "12\n[]\n", '{"name": "a file of another kind"}\n'])
def test_an_audit_that_is_none_is_refused_before_anything_comes_back(text: str, site: Site, tmp_path: Path) -> None:
    site.done()
    backup, queue, wrong = site.backup(tmp_path / "backups"), MemoryQueue(), tmp_path / "wrong.json"
    wrong.write_text(text)
    with pytest.raises(InputError, match="no line of an audit"):
        restored(tmp_path / "new", queue, backup, site.settings.data_dir / AUDIT_FILE, wrong)
    assert queue.records() == []
    assert not (tmp_path / "new").exists()
    wrong.write_text("")
    assert restored(tmp_path / "new", queue, backup, wrong).jobs == {JobState.DONE: 1}


def flip(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(bytes([content[0] ^ 1]) + content[1:])


def rename_in_manifest(backup: Path, name: str) -> None:
    document = json.loads((backup / MANIFEST_FILE).read_text())
    document["files"][name] = document["files"].pop(JOBS_FILE)
    (backup / MANIFEST_FILE).write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda backup: flip(next(backup.glob("scenes/*/scene.safetensors"))), "its hash differs"),
        (lambda backup: flip(backup / JOBS_FILE), "its hash differs"),
        (lambda backup: next(backup.glob("spool/*/clip.mp4")).unlink(), "is missing"),
        (lambda backup: (backup / MANIFEST_FILE).write_text("{"), "cannot be read"),
        (lambda backup: (backup / MANIFEST_FILE).unlink(), "holds no finished backup"),
        (lambda backup: rename_in_manifest(backup, "../escaped"), "cannot be read"),
        (lambda backup: rename_in_manifest(backup, "valkey/log"), "cannot be read"),
        (lambda backup: rename_in_manifest(backup, "spool//jobs.jsonl"), "cannot be read"),
    ],
    ids=["scene", "jobs", "missing", "manifest", "no manifest", "outside", "foreign", "not plain"],
)
def test_a_backup_that_is_not_whole_is_refused_and_nothing_is_left(
    site: Site, tmp_path: Path, spoil: Callable[[Path], object], told: str
) -> None:
    site.done()
    backup = site.backup(tmp_path / "backups")
    spoil(backup)
    new, queue = tmp_path / "new", MemoryQueue()
    with pytest.raises(InputError, match=told):
        restored(new, queue, backup)
    assert not new.exists() or list(new.iterdir()) == []
    assert queue.records() == []


def test_a_data_directory_that_is_not_empty_is_refused_and_stays_as_it_is(site: Site, tmp_path: Path) -> None:
    backup, other = site.backup(tmp_path / "backups"), Site(tmp_path / "other")
    job_id = other.queued()
    with pytest.raises(UnavailableError, match="not empty"):
        restored(tmp_path / "other", MemoryQueue(), backup)
    assert other.store.spooled_ids() == [job_id]
    (tmp_path / "disk" / "lost+found").mkdir(parents=True)
    restored(tmp_path / "disk", MemoryQueue(), backup)


def test_a_queue_that_is_not_empty_is_refused_and_nothing_is_left(site: Site, queue: Queue, tmp_path: Path) -> None:
    backup = site.backup(tmp_path / "backups")
    queue.submit(job())
    with pytest.raises(UnavailableError, match=r"queue is not empty.*REDIS_URL"):
        restored(tmp_path / "new", queue, backup)
    assert list((tmp_path / "new").iterdir()) == []


class Failing(MemoryQueue):
    """A queue that goes away after so many more submissions."""

    takes = 0

    def submit(self, *arguments: Any) -> JobRecord:
        if not self.takes:
            raise UnavailableError("The queue does not answer.", "Start it.")
        self.takes -= 1
        return super().submit(*arguments)


def elsewhere(folder: Path, queue: Queue, source: Path, *audits: Path) -> Restored:
    """Restore with a queue that does not lie in the data directory."""
    settings = Settings(data_dir=folder, redis_url="redis://queue")
    return restore_backup(settings, contextlib.nullcontext(queue), source, audits)


def test_a_restore_that_failed_while_jobs_were_entered_goes_on_when_it_is_run_again(site: Site, tmp_path: Path) -> None:
    done, queued, new = site.done(), [site.queued() for _ in range(4)], tmp_path / "new"
    backup, queue = site.backup(tmp_path / "backups"), Failing()
    AuditLog(site.settings.data_dir).append(AuditEntry(time=utc_now(), action=AuditAction.PURGED, job_id=queued[1]))
    written_ns = set()
    for queue.takes in (2, 3):  # those that the queue has are counted again
        with pytest.raises(UnavailableError, match="does not answer"):
            elsewhere(new, queue, backup)
        assert [each.name for each in new.iterdir()] == [RESTORING]
        written_ns.add((new / RESTORING).stat().st_mtime_ns)
        with pytest.raises(UnavailableError, match="restore again"):
            open_store(Settings(data_dir=new))
    assert len(written_ns) == 1  # a kill while it is written anew would leave records that no restore goes on from
    assert {record.job_id for record in queue.records()} == {done, *queued[:3]}
    queue.takes = 9
    told = elsewhere(new, queue, backup, site.settings.data_dir / AUDIT_FILE)
    assert (told.jobs, told.purged) == ({JobState.DONE: 1, JobState.QUEUED: 3}, [queued[1]])
    assert [claimed(queue, f"worker-{number}")[0].job_id for number in range(3)] == [queued[0], *queued[2:]]
    assert {record.job_id for record in queue.records()} == {done, queued[0], *queued[2:]}
    open_store(Settings(data_dir=new))


def test_only_the_same_restore_goes_on_and_only_into_the_queue_of_its_own_jobs(site: Site, tmp_path: Path) -> None:
    site.queued(), site.queued()
    first, new, queue = site.backup(tmp_path / "backups"), tmp_path / "new", Failing()
    second = site.backup(tmp_path / "backups")
    queue.takes = 1
    with pytest.raises(UnavailableError, match="does not answer"):
        elsewhere(new, queue, first)
    begun = json.loads((new / RESTORING).read_text())["backup"]
    with pytest.raises(UnavailableError, match=rf"not empty.*Restore the backup of {re.escape(begun)} again"):
        elsewhere(new, queue, second)
    with pytest.raises(UnavailableError, match="not empty"):
        restored(new, queue, first)  # that would be the queue of the data directory
    queue.takes = 9
    with pytest.raises(UnavailableError, match="not empty"):
        elsewhere(tmp_path / "other", queue, first)
    queue.submit(job())
    elsewhere(new, MemoryQueue(), second)


def test_two_restores_do_not_fill_one_folder_at_once(site: Site, tmp_path: Path) -> None:
    new = tmp_path / "new"

    class Second(MemoryQueue):
        def records(self, *_: Any, **__: Any) -> list[JobRecord]:
            with pytest.raises(UnavailableError, match="Another restore"):
                elsewhere(new, MemoryQueue(), backup)
            return []

    backup = site.backup(tmp_path / "backups")
    elsewhere(new, Second(), backup)


def test_a_full_disk_is_named_and_nothing_is_left(site: Site, tmp_path: Path) -> None:
    job_id = site.queued()
    (site.store.spool_folder(job_id) / "clip.mp4").write_bytes(bytes(100_000))
    backup = site.backup(tmp_path / "backups")
    with files_no_larger_than(50_000), pytest.raises(UnavailableError, match=r"no room left on the disk of .*new"):
        restored(tmp_path / "new", MemoryQueue(), backup)
    assert list((tmp_path / "new").iterdir()) == []


def test_neither_service_nor_worker_starts_on_a_restore_that_was_cut_off(tmp_path: Path) -> None:
    (tmp_path / RESTORING).touch()
    with pytest.raises(UnavailableError, match=r"cut off.*restore again"):
        open_store(Settings(data_dir=tmp_path))
    (tmp_path / RESTORING).unlink()
    open_store(Settings(data_dir=tmp_path))


def test_two_jobs_that_had_one_idempotency_key_days_apart_both_come_back(site: Site, tmp_path: Path) -> None:
    long_ago_s = time.time() - 3 * IDEMPOTENCY_S
    first = site.queued(long_ago_s, idempotency_key="k")
    site.queue._idempotent.clear()  # a day has passed
    second = site.queued(long_ago_s + 2 * IDEMPOTENCY_S, idempotency_key="k")
    queue = MemoryQueue()
    restored(tmp_path / "new", queue, site.backup(tmp_path / "backups"))
    assert {record.job_id for record in queue.records()} == {first, second}


def test_the_newest_backup_of_a_folder_is_restored_also_when_older_ones_are_gone(site: Site, tmp_path: Path) -> None:
    site.done()
    first = site.backup(tmp_path / "backups")
    job_id = site.done()
    second = site.backup(tmp_path / "backups")
    shutil.rmtree(first)
    queue = MemoryQueue()
    assert restored(tmp_path / "new", queue, tmp_path / "backups").backup == second
    assert known(queue, job_id).state is JobState.DONE


def test_with_a_bucket_clips_and_scenes_stay_in_it_and_purges_reach_it(bucket: Any, tmp_path: Path) -> None:
    site = Site(tmp_path / "old", BUCKET_URL)
    purged, done, queued = site.done(), site.done(), site.queued()
    backup = site.backup(tmp_path / "backups")
    assert not (backup / "spool").exists()
    assert len(list(bucket.objects.all())) > 3
    AuditLog(site.settings.data_dir).append(AuditEntry(time=utc_now(), action=AuditAction.PURGED, job_id=purged))
    with pytest.raises(InputError, match=r"INTRASPLAT_STORE_URL: .*in the bucket"):
        restored(tmp_path / "new", MemoryQueue(), backup)
    queue, audit = MemoryQueue(), site.settings.data_dir / AUDIT_FILE
    restored(tmp_path / "new", queue, backup, audit, store_url=BUCKET_URL)
    assert {record.job_id: record.state for record in queue.records()} == {
        done: JobState.DONE,
        queued: JobState.QUEUED,
    }
    assert Site(tmp_path / "third", BUCKET_URL).store.finished_scenes().keys() == {done}


def test_a_backup_of_a_folder_is_not_restored_beside_a_bucket(site: Site, tmp_path: Path) -> None:
    backup = site.backup(tmp_path / "backups")
    with pytest.raises(InputError, match="Unset it"):
        restored(tmp_path / "new", MemoryQueue(), backup, store_url=BUCKET_URL)
