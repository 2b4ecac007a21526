"""A backup is whole or is not there, costs what has changed, and says what stands in its way."""

from __future__ import annotations

import json
import multiprocessing
import os
from pathlib import Path

import pytest

from contract.access.audit import AUDIT_FILE, AuditLog
from contract.access.keys import KEYS_FILE, KeyFile
from contract.backup.manifest import JOBS_FILE, MANIFEST_FILE, UNFINISHED, finished_backups, read_jobs, read_manifest
from contract.backup.take import Taken, take_backup
from contract.queue.interface import Queue
from contract.runtime.settings import Settings
from contract.store.store import PURGING, UNSCORED, Store
from contract.wire.errors import InputError, UnavailableError
from contract.wire.job import JobRecord, JobState
from contract.wire.labels import Labels
from tests.contract.stores import accepted, files_no_larger_than, finished
from tests.memory_queue import MemoryQueue


class Site:
    """A data directory, its queue, and a folder of backups."""

    def __init__(self, folder: Path) -> None:
        self.store = Store(folder / "data")
        self.queue: Queue = MemoryQueue()
        self.settings = Settings(data_dir=folder / "data")
        self.shelf = folder / "backups"

    def queued(self) -> str:
        return self.queue.submit(accepted(self.store)).job_id

    def done(self) -> str:
        return finished(self.store, self.queue, self.queued())

    def backup(self, *, full: bool = False) -> Taken:
        return take_backup(self.settings, self.queue, self.shelf, full=full)


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_a_backup_is_a_folder_for_its_owner_alone_with_every_hash(site: Site) -> None:
    KeyFile(site.settings.data_dir).create("ward-3")
    job_id = site.done()
    site.store.expect_scores("worker-1", job_id, 1)
    taken = site.backup()
    manifest = read_manifest(taken.path)
    on_disk = {path.relative_to(taken.path).as_posix() for path in taken.path.rglob("*") if path.is_file()}
    assert on_disk - {MANIFEST_FILE} == manifest.files.keys()
    assert {f"spool/{job_id}/clip.mp4", f"scenes/{job_id}.1/manifest.json", KEYS_FILE, AUDIT_FILE, JOBS_FILE} < on_disk
    assert f"{UNSCORED}/worker-1/{job_id}.1" in on_disk
    assert (taken.files, taken.jobs[JobState.DONE]) == (len(manifest.files), 1)
    modes = {path.is_dir(): path.stat().st_mode & 0o777 for path in [taken.path, *taken.path.rglob("*")]}
    assert modes == {True: 0o700, False: 0o600}
    assert json.loads((site.settings.data_dir / AUDIT_FILE).read_text())["action"] == "backed-up"


def test_what_has_not_changed_is_the_file_of_the_backup_before(site: Site) -> None:
    job_id, queued = site.done(), site.queued()
    first = site.backup()
    site.store.keep_labels(queued, Labels(label="liver"))
    second = site.backup()
    for name in (f"spool/{job_id}/clip.mp4", f"scenes/{job_id}.1/scene.safetensors"):
        assert (first.path / name).stat().st_ino == (second.path / name).stat().st_ino
    assert (second.path / f"spool/{queued}/labels.json").is_file()
    assert first.linked == 0
    assert second.linked > 0
    assert site.backup(full=True).linked == 0
    assert len(finished_backups(site.shelf)) == 3


def test_the_copy_of_a_scene_that_gets_its_scores_meanwhile_is_of_one_moment(site: Site) -> None:
    job_id = site.done()
    folder = site.store.scene_folder(job_id, 1)

    class Scored(MemoryQueue):
        def records(self, *_: object, **__: object) -> list[JobRecord]:
            (folder / "report.json").write_text("{}")
            return site.queue.records(None, None)

    taken = take_backup(site.settings, Scored(), site.shelf)
    assert (taken.path / f"scenes/{job_id}.1/report.json").read_text() == "{}"


def test_a_job_whose_removal_has_begun_is_left_out_and_its_note_is_kept(site: Site) -> None:
    job_id, other = site.done(), site.done()
    notes = site.settings.data_dir / PURGING
    notes.mkdir()
    (notes / job_id).touch()
    taken = site.backup()
    assert taken.purged == (job_id,)
    assert [record.job_id for record in read_jobs(taken.path)] == [other]
    assert [path.relative_to(taken.path).as_posix() for path in taken.path.rglob(f"*{job_id}*")] == [
        f"{PURGING}/{job_id}"
    ]


def test_a_job_without_files_is_told_and_left_out(site: Site) -> None:
    job_id = site.done()
    site.store.purge(job_id)
    taken = site.backup()
    assert (taken.without_files, sum(taken.jobs.values())) == ((job_id,), 0)


def end_at_once(folder: Path) -> None:
    class Deadly(MemoryQueue):
        def records(self, *_: object, **__: object) -> list[JobRecord]:
            os._exit(9)

    site = Site(folder)
    take_backup(site.settings, Deadly(), site.shelf)


def test_a_backup_that_was_killed_is_none_and_the_next_one_removes_it(site: Site, tmp_path: Path) -> None:
    job_id = site.done()
    process = multiprocessing.get_context("spawn").Process(target=end_at_once, args=(tmp_path,))
    process.start()
    process.join()
    assert process.exitcode == 9
    (left,) = site.shelf.glob(f"{UNFINISHED}*")
    assert (left / "spool" / job_id / "clip.mp4").is_file()
    assert finished_backups(site.shelf) == []
    taken = site.backup()
    assert not left.exists()
    assert finished_backups(site.shelf) == [taken.path]


def test_a_full_disk_is_named_and_nothing_of_the_backup_is_left(site: Site) -> None:
    record = accepted(site.store)
    site.queue.submit(record)
    (site.store.spool_folder(record.job_id) / "clip.mp4").write_bytes(bytes(100_000))
    with files_no_larger_than(50_000), pytest.raises(UnavailableError, match=r"no room left on the disk of .*backups"):
        site.backup()
    assert [each.name for each in site.shelf.iterdir()] == [".lock"]
    assert sum(site.backup().jobs.values()) == 1


def test_a_file_that_cannot_be_read_is_named(site: Site) -> None:
    (site.settings.data_dir / KEYS_FILE).mkdir()
    with pytest.raises(UnavailableError, match=f"{KEYS_FILE} cannot be read .*user of the service"):
        site.backup()
    assert finished_backups(site.shelf) == []


def test_a_backup_that_cannot_be_recorded_is_not_taken(site: Site) -> None:
    (site.settings.data_dir / AUDIT_FILE).mkdir()
    with pytest.raises(UnavailableError):
        site.backup()
    assert finished_backups(site.shelf) == []


def test_two_backups_do_not_write_to_one_folder_at_once(site: Site) -> None:
    class Second(MemoryQueue):
        def records(self, *_: object, **__: object) -> list[JobRecord]:
            with pytest.raises(UnavailableError, match="Another backup is being written"):
                site.backup()
            return []

    assert take_backup(site.settings, Second(), site.shelf).path in finished_backups(site.shelf)


def test_a_folder_in_the_data_directory_is_refused(site: Site) -> None:
    with pytest.raises(InputError, match="lost with it"):
        take_backup(site.settings, site.queue, site.settings.data_dir / "backups")


def test_a_destination_that_is_a_file_is_refused(site: Site) -> None:
    site.shelf.write_text("")
    with pytest.raises(UnavailableError, match="cannot be written"):
        site.backup()
    assert not AuditLog(site.settings.data_dir)._path.exists()
