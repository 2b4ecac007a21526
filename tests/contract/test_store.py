"""Folders appear whole or not at all, and leave nothing behind."""

from __future__ import annotations

import os
import stat
import time
from pathlib import Path

import pytest

from contract.errors import SceneError
from contract.job import JobFiles, JobRecord
from contract.store import ABANDONED_AFTER_S, MANIFEST, SUBMISSION, Store, is_job_id, new_job_id


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "data")


def accepted(store: Store) -> JobRecord:
    record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=5.0)
    (store.open_incoming(record.job_id) / "clip.mp4").write_bytes(b"frames")
    store.accept(record)
    return record


def published(store: Store) -> str:
    record = accepted(store)
    (store.work_folder(record.job_id, 1) / MANIFEST).write_text("{}")
    store.publish_scene(record.job_id, 1)
    return record.job_id


def test_an_accepted_upload_lies_in_the_spool_with_its_record(store: Store) -> None:
    record = accepted(store)
    folder = store.spool_folder(record.job_id)
    assert (folder / "clip.mp4").read_bytes() == b"frames"
    assert JobRecord.model_validate_json((folder / SUBMISSION).read_text()) == record
    assert list((store.data_dir / "incoming").iterdir()) == []


def test_the_data_directory_is_for_its_owner_only(store: Store) -> None:
    assert stat.S_IMODE(store.data_dir.stat().st_mode) == 0o700


def test_a_scene_is_there_only_once_it_is_published(store: Store) -> None:
    record = accepted(store)
    (store.work_folder(record.job_id, 1) / MANIFEST).write_text("{}")
    assert store.scene_ids() == []
    with pytest.raises(SceneError):
        store.scene_folder(record.job_id)
    store.publish_scene(record.job_id, 1)
    assert store.scene_ids() == [record.job_id]
    assert store.scene_folder(record.job_id).is_dir()


def test_an_attempt_starts_from_an_empty_folder(store: Store) -> None:
    job_id = new_job_id()
    (store.work_folder(job_id, 1) / "left-over").write_text("x")
    assert list(store.work_folder(job_id, 1).iterdir()) == []


def test_an_attempt_takes_over_the_one_file_to_go_on_from_and_removes_earlier_folders(store: Store) -> None:
    job_id = new_job_id()
    for name in ("kept", "half-written"):
        (store.work_folder(job_id, 9, keep="kept") / name).write_text(name)
    folder = store.work_folder(job_id, 10, keep="kept")
    assert [path.name for path in folder.iterdir()] == ["kept"]
    assert [path.name for path in (store.data_dir / "work").iterdir()] == [folder.name]


def test_publishing_leaves_no_work_of_any_attempt(store: Store) -> None:
    job_id = published(store)
    assert list((store.data_dir / "work").iterdir()) == []
    (store.work_folder(job_id, 2) / MANIFEST).write_text("{}")
    (store.data_dir / "work" / f"{job_id}.1").mkdir()
    store.publish_scene(job_id, 2)
    assert list((store.data_dir / "work").iterdir()) == []


def test_scratch_is_emptied_when_its_worker_starts_again_and_is_no_attempt(store: Store) -> None:
    (store.scratch_folder("worker-1") / "unpacked").write_text("frames")
    other = store.scratch_folder("worker-2") / "unpacked"
    other.write_text("frames")
    assert list(store.scratch_folder("worker-1").iterdir()) == []
    assert other.exists()


def test_uploads_that_stopped_a_day_ago_are_removed_and_younger_ones_are_not(store: Store) -> None:
    abandoned, paused, going_on = (store.open_incoming(new_job_id()) for _ in range(3))
    for folder, silent_s in ((abandoned, ABANDONED_AFTER_S + 60), (paused, ABANDONED_AFTER_S / 2), (going_on, 0.0)):
        (folder / "clip.mp4").write_bytes(b"half")
        then_s = time.time() - silent_s
        os.utime(folder / "clip.mp4", (then_s, then_s))
        os.utime(folder, (time.time() - ABANDONED_AFTER_S - 60,) * 2)
    store.remove_abandoned_uploads()
    assert {path.name for path in (store.data_dir / "incoming").iterdir()} == {paused.name, going_on.name}


def test_removing_a_job_leaves_no_file_of_it(store: Store) -> None:
    job_id = published(store)
    store.work_folder(job_id, 2)
    store.remove(job_id)
    assert [path for path in store.data_dir.rglob("*") if job_id in path.name] == []


@pytest.mark.parametrize("text", ["..", "../x", "", "A" * 32, "a" * 31, "a" * 32 + "\n", "a" * 32 + "/x"])
def test_nothing_but_our_own_ids_is_ever_part_of_a_path(store: Store, text: str) -> None:
    assert not is_job_id(text)
    with pytest.raises(SceneError):
        store.scene_folder(text)
    with pytest.raises(ValueError, match="not a job id"):
        store.spool_folder(text)
