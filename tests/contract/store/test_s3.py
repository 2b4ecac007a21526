"""A store in a bucket: what one machine stores, every other finds, and a purge holds everywhere."""

from __future__ import annotations

import json
import os
import shutil
import time
import zipfile
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from contract.runtime.settings import Settings
from contract.store.shelf import ABANDONED_AFTER_S, new_job_id
from contract.store.store import Store, open_store
from intrasplat.errors import SceneError, UnavailableError
from intrasplat.names import CURVE, MANIFEST, RECORDED, REPORT, RESUME, SUBMISSION
from intrasplat.scene.recorded_file import PICTURE, name_of, read_frame
from tests.contract.stores import BUCKET_URL, accepted, lead_to, published, received
from tests.reports import REPORT_OF_A_SCENE

pytest.importorskip("s3fs")
moto_server: Any = pytest.importorskip("moto.server")
boto3: Any = pytest.importorskip("boto3")

PREFIX = "of/all/"


def on(tmp_path: Path, name: str) -> Store:
    """The store as that machine sees it."""
    return Store(tmp_path / name, BUCKET_URL)


def keys(bucket: Any) -> list[str]:
    return sorted(each.key.removeprefix(PREFIX) for each in bucket.objects.all())


def test_the_settings_choose_the_store(tmp_path: Path, bucket: Any) -> None:
    accepted(open_store(Settings(data_dir=tmp_path)))
    assert keys(bucket) == []
    job_id = accepted(open_store(Settings(data_dir=tmp_path, store_url=BUCKET_URL))).job_id
    assert keys(bucket) == [f"spool/{job_id}/clip.mp4", f"spool/{job_id}/{SUBMISSION}"]


def test_a_clip_accepted_on_one_machine_can_be_fetched_on_another(tmp_path: Path, bucket: Any) -> None:
    service, worker = on(tmp_path, "service"), on(tmp_path, "worker")
    record = accepted(service)
    shutil.rmtree(service.data_dir)
    assert worker.spooled_ids() == [record.job_id]
    assert worker.submission(record.job_id) == record
    folder = worker.fetch_clip(record.job_id)
    assert folder == worker.spool_folder(record.job_id)
    assert sorted(path.name for path in folder.iterdir()) == ["clip.mp4", SUBMISSION]
    assert (folder / "clip.mp4").read_bytes() == b"frames"


def test_a_clip_without_its_submission_is_not_accepted_and_goes_in_the_end(tmp_path: Path, bucket: Any) -> None:
    store, job_id = on(tmp_path, "service"), new_job_id()
    bucket.put_object(Key=f"{PREFIX}spool/{job_id}/clip.mp4", Body=b"half of an acceptance")
    assert store.spooled_ids() == []
    assert store.submission(job_id) is None
    with pytest.raises(UnavailableError, match="is not there"):
        store.fetch_clip(job_id)
    store.tidy()
    assert keys(bucket) == [f"spool/{job_id}/clip.mp4"]  # its acceptance may still be going on


def test_a_scene_that_was_altered_in_the_bucket_is_not_shown(tmp_path: Path, bucket: Any) -> None:
    worker, other = on(tmp_path, "worker"), on(tmp_path, "other")
    job_id = new_job_id()
    published(worker, job_id, 1)
    bucket.put_object(Key=f"{PREFIX}scenes/{job_id}.1/scene.safetensors", Body=b"tenzors")
    with pytest.raises(SceneError, match="damaged"):
        other.scene_folder(job_id, 1)
    assert [path for path in other.data_dir.rglob("*") if path.is_file()] == []


def test_an_object_whose_name_leads_out_of_its_folder_is_refused(tmp_path: Path, bucket: Any) -> None:
    worker, job_id = on(tmp_path, "worker"), new_job_id()
    for name in ("../../../outside", MANIFEST):
        bucket.put_object(Key=f"{PREFIX}scenes/{job_id}.1/{name}", Body=b"{}")
    with pytest.raises(SceneError, match="its name is not ours"):
        worker.scene_folder(job_id, 1)
    assert not list(tmp_path.rglob("outside"))


def test_the_scene_of_a_refused_attempt_goes_from_the_bucket_and_the_other_stays(tmp_path: Path, bucket: Any) -> None:
    zombie, worker = on(tmp_path, "zombie"), on(tmp_path, "worker")
    job_id = new_job_id()
    for store, attempt in ((zombie, 1), (worker, 10)):
        published(store, job_id, attempt)
    zombie.remove_attempt(job_id, 1)
    assert worker.scene_attempts(job_id) == [10]
    published(zombie, job_id, 1)
    worker.remove_other_attempts(job_id, 10)
    assert worker.scene_attempts(job_id) == [10]


@pytest.mark.parametrize("versioned", [False, True])
def test_a_purge_leaves_nothing_in_the_bucket_nor_on_any_machine_that_shows_it(
    tmp_path: Path, bucket: Any, versioned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if versioned:
        bucket.Versioning().enable()
    service, worker = on(tmp_path, "service"), on(tmp_path, "worker")
    job_id, other = accepted(service).job_id, accepted(service).job_id
    worker.fetch_clip(job_id)
    for content in (b"first", b"again"):
        scene = published(worker, job_id, 1, content)
    kept, work = worker.resume_folder(job_id, 2), worker.work_folder(job_id, 2)
    (kept / RESUME).write_bytes(b"state")
    (kept / "frames").write_bytes(b"tissue")
    goes_on = worker.work_folder(other, 1)
    worker.hand_over(job_id, 2)
    assert service.has_scene(job_id, 1)
    removed = service.purge(job_id)
    assert not service.has_scene(job_id, 1)
    assert removed.files["bucket"] == 5
    assert [each.key for each in bucket.object_versions.all() if job_id in each.key] == []
    assert service.spooled_ids() == [other]
    monkeypatch.setattr("contract.store.s3.SEEN_FOR_S", 0.0)
    with pytest.raises(SceneError):
        worker.scene_folder(job_id, 1)
    assert not scene.exists()
    worker.tidy()
    assert not worker.spool_folder(job_id).exists()
    assert (kept.exists(), work.exists(), goes_on.exists()) == (False, False, True)
    assert sum(service.purge(job_id).files.values()) == 0


def unscored(store: Store) -> tuple[str, Path]:
    """A scene that waits for its scores, and its folder on that machine."""
    job_id = new_job_id()
    work = store.work_folder(job_id, 1)
    first = REPORT_OF_A_SCENE.model_copy(update={"scored": False})
    contents = {"scene.safetensors": "tensors", REPORT: first.model_dump_json(), CURVE: "iteration\n0\n"}
    for name, content in contents.items():
        (work / name).write_text(content)
    hashes = {name: {"sha256": sha256(content.encode()).hexdigest()} for name, content in contents.items()}
    (work / MANIFEST).write_text(json.dumps({"files": hashes}))
    store.expect_scores("worker-1", job_id, 1)
    return job_id, store.publish_scene(job_id, 1)


def test_a_scene_purged_elsewhere_before_its_scores_come_does_not_come_back(tmp_path: Path, bucket: Any) -> None:
    service, worker = on(tmp_path, "service"), on(tmp_path, "worker")
    job_id, scene = unscored(worker)
    service.purge(job_id)
    worker.add_scores("worker-1", job_id, 1, REPORT_OF_A_SCENE)
    assert keys(bucket) == []
    assert not scene.exists()
    assert worker.unscored("worker-1") == []


def test_a_thumbnail_is_kept_in_the_bucket_and_goes_with_its_scene(tmp_path: Path, bucket: Any) -> None:
    service, worker = on(tmp_path, "service"), on(tmp_path, "worker")
    job_id, _ = unscored(worker)
    service.scene_folder(job_id, 1)
    worker.keep_thumbnail(job_id, 1, b"jpeg")
    assert service.thumbnail(job_id, 1) is None  # its copy is older
    assert on(tmp_path, "another").thumbnail(job_id, 1) == b"jpeg"
    service.purge(job_id)
    service.keep_thumbnail(job_id, 1, b"late")
    assert keys(bucket) == []


def test_recorded_frames_are_read_on_any_machine_unless_they_were_altered(tmp_path: Path, bucket: Any) -> None:
    worker, job_id = on(tmp_path, "worker"), new_job_id()
    folder = worker.work_folder(job_id, 1)
    with zipfile.ZipFile(folder / RECORDED, "w") as archive:
        archive.writestr(name_of("left", 3, PICTURE), b"jpeg")
    digest = sha256((folder / RECORDED).read_bytes()).hexdigest()
    (folder / MANIFEST).write_text(json.dumps({"files": {}, "beside": {RECORDED: {"sha256": digest}}}))
    worker.publish_scene(job_id, 1)
    service = on(tmp_path, "service")
    assert read_frame(service.scene_folder(job_id, 1), 12, 0.2) == (3, b"jpeg")
    bucket.put_object(Key=f"{PREFIX}scenes/{job_id}.1/{RECORDED}", Body=b"another patient's")
    with pytest.raises(SceneError, match="damaged"):
        on(tmp_path, "another").scene_folder(job_id, 1)
    service.purge(job_id)
    assert keys(bucket) == []


def test_an_unscored_scene_is_fetched_again_only_when_another_machine_has_scored_it(
    tmp_path: Path, bucket: Any
) -> None:
    service, worker = on(tmp_path, "service"), on(tmp_path, "worker")
    job_id, _ = unscored(worker)
    assert not service.newest_report(job_id, 1).scored
    copy = service.scene_folder(job_id, 1).stat().st_ino
    assert not service.newest_report(job_id, 1).scored
    assert service.scene_folder(job_id, 1).stat().st_ino == copy
    worker.add_scores("worker-1", job_id, 1, REPORT_OF_A_SCENE)
    assert service.newest_report(job_id, 1).scored


def test_copies_that_nobody_has_used_for_a_day_are_dropped_and_come_back(tmp_path: Path, bucket: Any) -> None:
    store, job_id = on(tmp_path, "worker"), new_job_id()
    scene = published(store, job_id, 1)
    store.tidy()
    assert scene.is_dir()
    os.utime(scene, (time.time() - ABANDONED_AFTER_S - 60,) * 2)
    store.tidy()
    assert not scene.exists()
    assert store.scene_folder(job_id, 1) == scene
    assert (scene / MANIFEST).is_file()


def test_a_bucket_that_is_not_there_is_noticed_at_once(tmp_path: Path, bucket: Any) -> None:
    with pytest.raises(UnavailableError, match="bucket"):
        Store(tmp_path, "s3://no-such-bucket")


def test_while_the_bucket_is_away_nothing_is_accepted_nor_taken_for_missing(tmp_path: Path) -> None:
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as environment:
        lead_to(environment, f"http://{host}:{port}")
        environment.setattr("contract.store.s3.RETRIES", {"mode": "standard", "total_max_attempts": 1})
        boto3.resource("s3").Bucket("elsewhere").create()
        store = Store(tmp_path, "s3://elsewhere")
        job_id = accepted(store).job_id
        published(store, job_id, 1)
        record = received(store)
        server.stop()
        for asked in (
            lambda: store.accept(record),
            lambda: store.submission(job_id),
            lambda: store.has_scene(job_id, 2),
            lambda: store.purge(job_id),
        ):
            with pytest.raises(UnavailableError, match="bucket does not answer"):
                asked()
    assert (store.incoming_folder(record.job_id) / "clip.mp4").read_bytes() == b"frames"


def test_a_listing_of_more_than_one_page_is_complete(
    tmp_path: Path, bucket: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("contract.store.s3.LISTING_PAGE", 2)
    store = on(tmp_path, "service")
    records = [accepted(store) for _ in range(4)]
    assert store.spooled_ids() == sorted(record.job_id for record in records)
    for record in records:
        store.purge(record.job_id)
    assert keys(bucket) == []
