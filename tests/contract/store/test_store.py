"""What the store promises, on a disk and in a bucket: folders appear whole or not at all, and leave nothing behind."""

from __future__ import annotations

import os
import stat
import time
from pathlib import Path

import pytest

from contract.store.shelf import ABANDONED_AFTER_S, is_job_id, new_job_id
from contract.store.store import Store
from contract.wire.job import JobRecord
from contract.wire.labels import Labels
from intrasplat.errors import SceneError, UnavailableError
from intrasplat.names import MANIFEST, PREPARED, RESUME, SUBMISSION
from tests.contract.store.conftest import MakeStore
from tests.contract.stores import accepted, published, received


def publish(store: Store, job_id: str, attempt: int, content: str = "{}") -> Path:
    (store.work_folder(job_id, attempt) / MANIFEST).write_text(content)
    return store.publish_scene(job_id, attempt)


def everything_of(store: Store, job_id: str) -> list[Path]:
    return [path for path in store.data_dir.rglob("*") if job_id in path.name]


def test_an_accepted_upload_lies_in_the_spool_with_its_record(store: Store) -> None:
    record = accepted(store)
    folder = store.fetch_clip(record.job_id)
    assert folder == store.spool_folder(record.job_id)
    assert (folder / "clip.mp4").read_bytes() == b"frames"
    assert JobRecord.model_validate_json((folder / SUBMISSION).read_text()) == record
    assert list((store.data_dir / "incoming").iterdir()) == []


def test_the_data_directory_is_for_its_owner_only(store: Store) -> None:
    assert stat.S_IMODE(store.data_dir.stat().st_mode) == 0o700


def test_the_accepted_clips_can_be_listed_and_read_again(store: Store) -> None:
    records = {record.job_id: record for record in (accepted(store), accepted(store))}
    store.open_incoming(new_job_id())
    assert store.spooled_ids() == sorted(records)
    assert {job_id: store.submission(job_id) for job_id in store.spooled_ids()} == records
    assert (store.fetch_clip(store.spooled_ids()[0]) / "clip.mp4").read_bytes() == b"frames"


def test_labels_lie_beside_the_clip_change_alone_and_go_with_it(machine: MakeStore) -> None:
    here, other = machine("service"), machine("other")
    record = received(here).model_copy(update={"labels": Labels(label="a")})
    here.accept(record)
    assert other.labels(record.job_id) == Labels(label="a")
    other.keep_labels(record.job_id, Labels(label="b", metadata={"c": "d"}))
    assert here.labelled_submission(record.job_id) == record.model_copy(update={"labels": other.labels(record.job_id)})
    assert here.labels(record.job_id) == Labels(label="b", metadata={"c": "d"})
    here.purge(record.job_id)
    other.keep_labels(record.job_id, Labels(label="late"))
    assert other.labels(record.job_id) == Labels()
    assert other.spooled_ids() == []
    unlabelled = accepted(here)
    assert here.labels(unlabelled.job_id) == Labels()


def test_a_clip_that_is_not_there_cannot_be_fetched(store: Store) -> None:
    with pytest.raises(UnavailableError, match="is not there"):
        store.fetch_clip(new_job_id())


def test_a_scene_is_there_only_once_it_is_published(store: Store) -> None:
    job_id = accepted(store).job_id
    (store.work_folder(job_id, 1) / MANIFEST).write_text("{}")
    assert store.scene_attempts(job_id) == []
    with pytest.raises(SceneError):
        store.scene_folder(job_id, 1)
    store.publish_scene(job_id, 1)
    assert store.scene_attempts(job_id) == [1]
    assert store.has_scene(job_id, 1)
    assert store.scene_folder(job_id, 1).is_dir()


def test_a_scene_published_on_one_machine_is_shown_on_another(machine: MakeStore) -> None:
    worker, other = machine("worker"), machine("other")
    job_id = accepted(worker).job_id
    published(worker, job_id, 2)
    assert other.scene_attempts(job_id) == [2]
    assert other.published_attempt(job_id) == 2
    assert other.has_scene(job_id, 2)
    assert not other.has_scene(job_id, 1)
    assert (other.scene_folder(job_id, 2) / "scene.safetensors").read_bytes() == b"tensors"
    with pytest.raises(SceneError, match="no scene"):
        other.scene_folder(job_id, 1)


def test_publishing_may_be_repeated(store: Store) -> None:
    job_id = new_job_id()
    scene = publish(store, job_id, 1)
    assert store.publish_scene(job_id, 1) == scene
    assert publish(store, job_id, 1, "another") == scene
    assert (scene / MANIFEST).read_text() == "another"


def test_an_attempt_thought_dead_replaces_no_scene_and_removes_only_its_own(store: Store) -> None:
    job_id = new_job_id()
    zombie = store.work_folder(job_id, 1)
    publish(store, job_id, 2, "of attempt 2")
    assert not zombie.exists()
    with pytest.raises(SceneError):
        store.publish_scene(job_id, 1)
    publish(store, job_id, 1, "of the zombie")
    assert store.scene_attempts(job_id) == [1, 2]
    assert (store.scene_folder(job_id, 2) / MANIFEST).read_text() == "of attempt 2"
    store.remove_attempt(job_id, 1)
    assert store.scene_attempts(job_id) == [2]
    assert store.published_attempt(job_id) == 2
    assert store.published_attempt(new_job_id()) is None


def test_an_attempt_starts_from_an_empty_folder(store: Store) -> None:
    job_id = new_job_id()
    (store.work_folder(job_id, 1) / "left-over").write_text("x")
    assert list(store.work_folder(job_id, 1).iterdir()) == []


def test_an_attempt_takes_over_what_was_kept_to_go_on_from_and_removes_earlier_folders(store: Store) -> None:
    job_id = new_job_id()
    for name in (RESUME, "half-written"):
        (store.resume_folder(job_id, 9) / name).write_text(name)
    (store.resume_folder(job_id, 9) / PREPARED).mkdir()
    (store.resume_folder(job_id, 9) / PREPARED / "left_rgb.npy").write_text("frames")
    store.work_folder(job_id, 9)
    kept, work = store.resume_folder(job_id, 10), store.work_folder(job_id, 10)
    assert {path.name for path in kept.iterdir()} == {RESUME, PREPARED}
    assert (kept / PREPARED / "left_rgb.npy").read_text() == "frames"
    assert list(work.iterdir()) == []
    for area in ("kept", "work"):
        assert [path.name for path in (store.data_dir / area).iterdir()] == [f"{job_id}.10"]


def test_each_thing_that_was_kept_is_of_the_latest_attempt_that_kept_it(store: Store) -> None:
    job_id = new_job_id()
    for attempt, name in ((1, PREPARED), (1, RESUME), (2, RESUME)):
        folder = store.data_dir / "kept" / f"{job_id}.{attempt}"
        folder.mkdir(exist_ok=True)
        (folder / name).write_text(f"of attempt {attempt}")
    kept = store.resume_folder(job_id, 3)
    assert {path.name: path.read_text() for path in kept.iterdir()} == {
        PREPARED: "of attempt 1",
        RESUME: "of attempt 2",
    }


def test_what_an_attempt_goes_on_from_is_the_latest_that_any_earlier_one_left(store: Store) -> None:
    job_id = new_job_id()
    for attempt, left in ((1, True), (2, True), (3, False)):
        folder = store.data_dir / "kept" / f"{job_id}.{attempt}"
        folder.mkdir()
        if left:
            (folder / RESUME).write_text(f"of attempt {attempt}")
    assert (store.resume_folder(job_id, 4) / RESUME).read_text() == "of attempt 2"
    assert (store.resume_folder(job_id, 4) / RESUME).read_text() == "of attempt 2"


def test_an_attempt_goes_on_from_what_one_on_another_machine_handed_over(machine: MakeStore) -> None:
    job_id = new_job_id()
    for name, attempt in (("first", 1), ("second", 2), ("first", 3)):
        store = machine(name)
        folder = store.resume_folder(job_id, attempt)
        before = (folder / RESUME).read_text() if (folder / RESUME).exists() else ""
        assert before == "".join(f"{n} " for n in range(1, attempt))
        (folder / RESUME).write_text(f"{before}{attempt} ")
        store.hand_over(job_id, attempt)
    published(store, job_id, 3)
    store.remove_other_attempts(job_id, 3)
    assert not (machine("third").resume_folder(job_id, 4) / RESUME).exists()


def test_what_lies_here_from_a_later_attempt_is_preferred_to_what_was_handed_over(store: Store) -> None:
    job_id = new_job_id()
    for attempt in (1, 2):
        (store.resume_folder(job_id, attempt) / RESUME).write_text(f"of attempt {attempt}")
        if attempt == 1:
            store.hand_over(job_id, attempt)
    assert (store.resume_folder(job_id, 3) / RESUME).read_text() == "of attempt 2"


def test_an_attempt_that_starts_late_leaves_a_later_one_alone(store: Store) -> None:
    job_id = new_job_id()
    (store.resume_folder(job_id, 2) / RESUME).write_text("of attempt 2")
    assert list(store.resume_folder(job_id, 1).iterdir()) == []
    assert (store.data_dir / "kept" / f"{job_id}.2" / RESUME).is_file()


def test_after_a_scene_is_reported_nothing_else_is_left_of_its_attempts(store: Store) -> None:
    job_id = new_job_id()
    for attempt in (1, 2):
        publish(store, job_id, attempt)
    store.work_folder(job_id, 3)
    (store.resume_folder(job_id, 3) / RESUME).write_text("state")
    store.remove_other_attempts(job_id, 2)
    assert [path.name for path in everything_of(store, job_id)] == [f"{job_id}.2"]
    assert store.scene_attempts(job_id) == [2]


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
    store.tidy()
    assert {path.name for path in (store.data_dir / "incoming").iterdir()} == {paused.name, going_on.name}


def test_what_a_worker_unpacked_and_never_came_back_for_is_removed_after_a_day(store: Store) -> None:
    scratch = store.scratch_folder("worker-1")
    for name, silent_s in (("of a dead job", ABANDONED_AFTER_S + 60), ("in use", 0.0)):
        (scratch / name).mkdir()
        (scratch / name / "frames").write_bytes(b"frames")
        for path in (scratch / name / "frames", scratch / name, scratch):
            os.utime(path, (time.time() - silent_s,) * 2)
    store.tidy()
    assert [path.name for path in scratch.iterdir()] == ["in use"]


def test_a_purge_on_one_machine_leaves_nothing_of_a_job_and_nothing_of_it_is_found(machine: MakeStore) -> None:
    service, worker = machine("service"), machine("worker")
    job_id, other = accepted(service).job_id, accepted(service).job_id
    published(worker, job_id, 1)
    (worker.resume_folder(job_id, 2) / RESUME).write_bytes(b"12345")
    worker.hand_over(job_id, 2)
    service.open_incoming(job_id)
    assert sum(service.purge(job_id).files.values()) == 5
    assert everything_of(service, job_id) == []
    assert service.spooled_ids() == [other]
    assert service.scene_attempts(job_id) == []
    assert sum(service.purge(job_id).files.values()) == 0


@pytest.mark.parametrize("text", ["..", "../x", "", "A" * 32, "a" * 31, "a" * 32 + "\n", "a" * 32 + "/x"])
def test_nothing_but_our_own_ids_is_ever_part_of_a_path(store: Store, text: str) -> None:
    assert not is_job_id(text)
    with pytest.raises(SceneError):
        store.scene_folder(text, 1)
    for method in (store.spool_folder, store.incoming_folder, store.purge):
        with pytest.raises(ValueError, match="not a job id"):
            method(text)
