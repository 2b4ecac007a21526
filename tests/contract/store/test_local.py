"""A store on the disk: its folders, and what is left of removals that were cut off."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.store.shelf import new_job_id
from contract.store.store import Store
from intrasplat.names import MANIFEST, SUBMISSION
from tests.contract.stores import accepted


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "data")


def publish(store: Store, job_id: str, attempt: int) -> Path:
    (store.work_folder(job_id, attempt) / MANIFEST).write_text("{}")
    return store.publish_scene(job_id, attempt)


def everything_of(store: Store, job_id: str) -> list[Path]:
    return [path for path in store.data_dir.rglob("*") if job_id in path.name]


def test_a_damaged_submission_hides_no_other(store: Store) -> None:
    damaged, sound = accepted(store).job_id, accepted(store).job_id
    (store.spool_folder(damaged) / SUBMISSION).write_text('{"job_id": ')
    assert store.spooled_ids() == sorted([damaged, sound])
    assert store.submission(damaged) is None
    assert store.submission(sound) is not None
    assert store.submission(new_job_id()) is None


def test_a_purge_leaves_no_file_of_a_job_and_says_what_it_took(store: Store) -> None:
    job_id, other = accepted(store).job_id, accepted(store).job_id
    publish(store, job_id, 1)
    (store.work_folder(job_id, 2) / "resume").write_bytes(b"12345")
    store.open_incoming(job_id)
    removed = store.purge(job_id)
    assert everything_of(store, job_id) == []
    assert removed.files == {"incoming": 0, "spool": 2, "work": 1, "kept": 0, "scenes": 1}
    assert removed.bytes["work"] == 5
    assert removed.bytes["scenes"] == len("{}")
    assert store.spooled_ids() == [other]
    assert sum(store.purge(job_id).files.values()) == 0


def test_a_purge_that_was_cut_off_shows_nothing_and_is_completed(store: Store) -> None:
    job_id = accepted(store).job_id
    publish(store, job_id, 1)
    (store.spool_folder(job_id) / SUBMISSION).unlink()
    (store.scene_folder(job_id, 1) / MANIFEST).unlink()
    assert store.spooled_ids() == []
    assert store.scene_attempts(job_id) == []
    store.tidy()
    assert everything_of(store, job_id) == []
