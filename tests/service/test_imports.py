"""POST /scenes and format=scene: what goes out, what comes in, whose it is, and what becomes of it when things fail."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from contract.access.audit import AUDIT_FILE, AuditLog
from contract.access.keys import DEFAULT_SCOPES, KeyScope
from contract.runtime.settings import Settings
from contract.store.store import Store
from contract.wire.job import JobState
from intrasplat.names import REPORT, SCENE
from intrasplat.notices import NoticeCode
from intrasplat.report import Report
from intrasplat.scene.archive import archive_parts
from intrasplat.scene.checkpoint import load_scene
from service.audit import Audit
from service.done import DoneJobs
from service.purge import Purger
from service.questions import Questions
from service.retention import Retention
from service.sweep import Sweep
from tests.archives import HOSTILE, ORIGIN, archived, files_of, small_scene, stored
from tests.memory_queue import MemoryQueue
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer, running_service
from worker.channel import Channel, Task
from worker.device import obey
from worker.orders import Failed, Finished, RunJob, Scored, ScoreScene
from worker.pace import RenderPace
from worker.snapshot import Snapshots


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return archived(tmp_path_factory.mktemp("there") / "scene", small_scene())


def sent(service: ServiceUnderTest, content: bytes, **more: Any) -> httpx.Response:
    name = more.pop("name", "Smith 1957.zip")
    return service.http.post("/scenes", files={"scene": (name, content)}, **more)


class Told(Channel):
    """Keeps what a device process reports."""

    def __init__(self) -> None:
        self.reports: list[object] = []

    def send(self, message: object) -> None:
        self.reports.append(message)


def worked_off(service: ServiceUnderTest) -> list[object]:
    """The next job, done as a worker's two processes do it; what the device process reported."""
    record, claim = service.claimed()
    out, told = service.store.work_folder(record.job_id, record.attempt), Told()
    order = RunJob(record=record, spool=service.store.fetch_clip(record.job_id), out=out, resume_dir=out)
    obey(Task(order), Settings(data_dir=service.store.data_dir), Snapshots(), RenderPace(), told)
    for report in told.reports:
        if isinstance(report, Finished):
            service.store.publish_scene(record.job_id, record.attempt)
            assert service.queue.finish(claim)
        elif isinstance(report, Scored):
            service.store.add_scores("worker-1", record.job_id, record.attempt, report.report)
        elif isinstance(report, Failed):
            assert service.queue.fail(claim, report.error)
    return told.reports


def audited(service: ServiceUnderTest, action: str) -> list[dict[str, Any]]:
    lines = (json.loads(line) for line in (service.store.data_dir / AUDIT_FILE).read_text().splitlines())
    return [line for line in lines if line["action"] == action]


def test_a_scene_goes_out_of_one_site_and_into_another(
    service: ServiceUnderTest, tmp_path_factory: pytest.TempPathFactory, archive: bytes
) -> None:
    more = {"data": {"label": "demo", "metadata": '{"study": "7"}'}, "headers": {"Idempotency-Key": "once"}}
    answer = sent(service, archive, **more)
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert job["id"] != ORIGIN
    assert answer.headers["location"] == f"/jobs/{job['id']}"
    assert (job["state"], job["label"], job["imported"], job["options"]["preset"]) == ("queued", "demo", True, "fast")
    assert sent(service, archive, **more).json()["id"] == job["id"]
    assert "Smith" not in " ".join(path.name for path in service.store.data_dir.rglob("*"))
    worked_off(service)

    scene = f"/scenes/{job['id']}"
    (listed,) = service.http.get("/scenes").json()
    assert (listed["id"], listed["label"], listed["psnr_tissue_db"]) == (job["id"], "demo", 36.2)
    report = Report.model_validate(service.http.get(scene).json())
    assert report.imported is not None
    assert (report.imported.scene_id, report.imported.imported_at_s) == (ORIGIN, job["created_at_s"])
    assert report.assumptions[0].code is NoticeCode.IMPORTED
    assert service.http.get(f"{scene}/curve").text.splitlines()[-1] == "2.5,36.2000,"

    exported = service.http.get(f"{scene}/export", params={"format": "scene"})
    assert exported.headers["content-disposition"] == 'attachment; filename="demo.scene.zip"'
    assert files_of(exported.content)[SCENE] == files_of(archive)[SCENE]
    for second in running_service(tmp_path_factory.mktemp("second")):
        taken_in = sent(second, exported.content).json()
        again = taken_in["id"]
        assert taken_in["label"] == "demo"  # as it is called where it comes from
        worked_off(second)
        kept = Report.model_validate(second.http.get(f"/scenes/{again}").json())
        assert kept.imported is not None
        assert kept.imported.scene_id == job["id"]
        folder, before = second.store.scene_folder(again, 1), service.store.scene_folder(job["id"], 1)
        assert (folder / SCENE).read_bytes() == (before / SCENE).read_bytes()
        assert load_scene(folder).settings["pose_warnings"] == []

    receipt = service.http.request("DELETE", scene).json()
    assert receipt["verified"]
    assert {name: count for name, count in receipt["files"].items() if count} == {"spool": 3, "scenes": 4}
    assert [path for path in service.store.data_dir.rglob("*") if job["id"] in path.name] == []
    assert audited(service, "imported")[0]["job_id"] == job["id"]
    assert [line["job_id"] for line in audited(service, "downloaded")] == [job["id"]]


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_archive_is_refused_and_leaves_nothing(service: ServiceUnderTest, archive: bytes, name: str) -> None:
    make, _ = HOSTILE[name]
    problem = assert_problem(
        sent(service, make(files_of(archive))), 413 if "large" in name or "bomb" in name else 422, "scene"
    )
    assert problem["remedy"]
    assert service.spooled() == []
    assert service.queue.records() == []


def test_numbers_that_cannot_be_shown_fail_the_job_with_field_and_remedy(
    service: ServiceUnderTest, tmp_path: Path
) -> None:
    folder = stored(tmp_path / "there", small_scene(50), frame_count=7)
    job = sent(service, b"".join(archive_parts(folder))).json()
    worked_off(service)
    failed = service.http.get(f"/jobs/{job['id']}").json()
    assert failed["state"] == "failed"
    assert (failed["error"]["field"], failed["error"]["code"]) == ("scene", "input")
    assert "frame_count 7" in failed["error"]["problem"]
    assert failed["error"]["remedy"]
    assert_problem(service.http.get(f"/scenes/{job['id']}"), 409, "scene")
    assert service.http.request("DELETE", f"/scenes/{job['id']}").json()["verified"]


@pytest.mark.parametrize(
    ("form", "status", "field"),
    [
        ({"files": {"clip": ("a.zip", b"x")}}, 422, "clip"),
        ({"files": {"scene": ("a.mp4", b"x")}}, 422, "scene"),
        ({"files": {"scene": ("a.zip", b"")}}, 422, "scene"),
        ({"files": {"label": (None, "demo")}}, 422, "scene"),
        ({"json": {"scene": ORIGIN}}, 400, "Content-Type"),
        ({"options": '{"budget_s": 20}'}, 422, "options.budget_s"),
        ({"options": '{"preset": "fast"}'}, 422, "options.preset"),
        ({"options": '{"retention_hours": -1}'}, 422, "options.retention_hours"),
        ({"label": "x" * 500}, 422, "label"),
    ],
)
def test_a_request_that_is_none_is_refused(
    service: ServiceUnderTest, archive: bytes, form: dict[str, Any], status: int, field: str
) -> None:
    if form.keys() & {"files", "json"}:
        answer = service.http.post("/scenes", **form)
    else:
        answer = sent(service, archive, data=form)
    assert assert_problem(answer, status, field)["remedy"]
    assert service.spooled() == []


def test_a_key_needs_its_scopes_and_sees_its_own_scenes_alone(service: ServiceUnderTest, archive: bytes) -> None:
    viewer = bearer(service, "ward-3", {KeyScope.VIEW})
    assert_problem(sent(service, archive, headers=viewer), 403, "Authorization")
    owner = bearer(service, "ward-3")
    assert_problem(
        sent(service, archive, headers=owner, data={"options": '{"priority": "high"}'}), 403, "Authorization"
    )
    job = sent(service, archive, headers=owner).json()
    worked_off(service)
    export = f"/scenes/{job['id']}/export?format=scene"
    assert_problem(service.http.get(export, headers=owner), 403, "Authorization")
    stranger = bearer(service, "ward-4", {*DEFAULT_SCOPES, KeyScope.DOWNLOAD, KeyScope.PURGE})
    for path in (export, f"/scenes/{job['id']}"):
        assert_problem(service.http.get(path, headers=stranger), 404, "scene")
    assert service.http.get("/scenes", headers=stranger).json() == []
    assert service.http.get("/scenes", headers=owner).json()[0]["id"] == job["id"]


def test_the_key_of_an_import_stands_for_its_file_alone(
    service: ServiceUnderTest, archive: bytes, tmp_path: Path
) -> None:
    headers = {"Idempotency-Key": "k"}
    assert sent(service, archive, headers=headers).status_code == 202
    other = archived(tmp_path / "other", small_scene(60))
    assert_problem(sent(service, other, headers=headers), 422, "Idempotency-Key")
    assert len(service.store.spooled_ids()) == 1


def test_the_clip_of_an_import_cannot_be_used_again(service: ServiceUnderTest, archive: bytes) -> None:
    job = sent(service, archive).json()
    answer = service.http.post("/reconstruct", files={"clip_of": (None, job["id"])})
    assert "imported" in assert_problem(answer, 422, "clip_of")["detail"]


def test_limits_of_bytes_room_and_tenants_hold_for_imports(tmp_path: Path, archive: bytes) -> None:
    for service in running_service(tmp_path / "small", max_upload_bytes=2000):
        assert_problem(sent(service, archive), 413, "scene")
    for service in running_service(tmp_path / "full", min_free_bytes=2**60):
        assert_problem(sent(service, archive), 507)
        assert service.spooled() == []
    for service in running_service(tmp_path / "busy", max_queued_per_tenant=1):
        assert sent(service, archive).status_code == 202
        assert_problem(sent(service, archive), 429, "queue")
        assert len(service.store.spooled_ids()) == 1


def test_an_import_is_kept_as_long_as_it_asks(tmp_path: Path, archive: bytes) -> None:
    for service in running_service(tmp_path, max_retention_hours=5.0):
        too_long = sent(service, archive, data={"options": '{"retention_hours": 6}'})
        assert_problem(too_long, 422, "options.retention_hours")
        job = sent(service, archive, data={"options": '{"retention_hours": 2}'}).json()
        worked_off(service)
        settings = Settings(data_dir=service.store.data_dir, max_retention_hours=5.0)
        done = DoneJobs(service.queue, service.store, Questions())
        purger = Purger(service.queue, service.store, Audit(AuditLog(service.store.data_dir)), done)
        retention = Retention(settings, service.queue, service.store, purger)
        ended_s = service.http.get(f"/jobs/{job['id']}").json()["finished_at_s"]
        assert retention.purge_due(ended_s + 1.9 * 3600) == 0
        assert retention.purge_due(ended_s + 2.1 * 3600) == 1
        assert service.http.get("/scenes").json() == []


def test_imports_do_not_count_as_durations_of_jobs(service: ServiceUnderTest, archive: bytes) -> None:
    sent(service, archive)
    worked_off(service)
    waiting = service.upload().json()
    assert service.queue.forecast(waiting["id"]).eta_s is None


class Dies(Exception):
    """The process is killed here."""


@pytest.fixture
def dying(tmp_path: Path) -> Iterator[ServiceUnderTest]:
    yield from running_service(tmp_path / "data", MemoryQueue())


@pytest.mark.parametrize("step", ["record", "accept", "submit"])
def test_a_service_that_dies_between_two_steps_leaves_an_import_or_nothing(
    dying: ServiceUnderTest, archive: bytes, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    owner = {"record": Audit, "accept": Store, "submit": MemoryQueue}[step]
    with monkeypatch.context() as patch:

        def die(*_: object, **__: object) -> None:
            raise Dies

        patch.setattr(owner, step, die)
        assert sent(dying, archive).status_code == 500
    Sweep(dying.queue, Store(dying.store.data_dir)).settle()  # as the next service does when it starts
    records = dying.queue.records()
    if step != "submit":
        assert records == []
        assert dying.store.spooled_ids() == []
        return
    (record,) = records
    assert (record.state, record.imported is not None) == (JobState.QUEUED, True)
    assert isinstance(worked_off(dying)[-1], Scored)
    assert dying.http.get(f"/scenes/{record.job_id}").status_code == 200


def test_a_worker_that_dies_half_way_is_followed_by_one_that_starts_anew(
    service: ServiceUnderTest, archive: bytes
) -> None:
    job = sent(service, archive).json()
    record, claim = service.claimed()
    half = service.store.work_folder(record.job_id, record.attempt)
    (half / SCENE).write_bytes(b"half")
    assert service.queue.release(claim, died=True)
    worked_off(service)
    assert service.http.get(f"/jobs/{job['id']}").json()["attempt"] == 2
    assert service.http.get(f"/scenes/{job['id']}").status_code == 200
    assert not half.exists() or not (half / SCENE).exists()


def test_a_scene_whose_worker_died_before_it_told_the_scores_has_them(
    service: ServiceUnderTest, archive: bytes
) -> None:

    job = sent(service, archive).json()
    record, claim = service.claimed()
    store = service.store
    out, told = store.work_folder(record.job_id, record.attempt), Told()
    order = RunJob(record=record, spool=store.fetch_clip(record.job_id), out=out, resume_dir=out)
    obey(Task(order), Settings(data_dir=service.store.data_dir), Snapshots(), RenderPace(), told)
    folder = store.publish_scene(record.job_id, record.attempt)
    assert service.queue.finish(claim)
    later = Told()
    score = ScoreScene(record=record, spool=order.spool, scene=folder)
    obey(Task(score), Settings(data_dir=service.store.data_dir), Snapshots(), RenderPace(), later)
    assert later.reports == [told.reports[-1]]
    assert Report.model_validate(service.http.get(f"/scenes/{job['id']}").json()).scored
    assert REPORT in {path.name for path in folder.iterdir()}
