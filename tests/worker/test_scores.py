"""Scores that a death cut off are made up for while nothing else is to do; nobody is asked or told too often."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import cast

import pytest

from contract.queue.interface import Claim, QueueFigures
from contract.store.store import Store
from intrasplat.names import CURVE, MANIFEST
from intrasplat.names import REPORT as REPORT_FILE
from intrasplat.report import Report
from tests.memory_queue import MemoryQueue
from tests.worker.jobs import Jobs
from tests.worker.standin import REPORT
from worker import scores
from worker.child import DeviceChild, JobReport
from worker.orders import DeviceOrder, Scored, ScoreScene, StopJob, Stopped
from worker.scores import InterruptedScores


class Child:
    """Scores a scene after score_s, or stops when it is told to."""

    def __init__(self, score_s: float) -> None:
        self.score_s = score_s
        self.sent: list[DeviceOrder] = []
        self.due_s = 0.0

    def send(self, order: DeviceOrder) -> None:
        self.sent.append(order)
        self.due_s = time.monotonic() + self.score_s

    def starved_s(self) -> float:
        return 0.0

    def next_report(self, timeout_s: float) -> JobReport | None:
        time.sleep(timeout_s / 10)
        if isinstance(self.sent[-1], StopJob):
            return Stopped(checkpointed=False)
        return Scored(report=Report.model_validate(REPORT)) if time.monotonic() > self.due_s else None


class Queue(MemoryQueue):
    """Counts how often it is asked for its figures."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = 0

    def figures(self) -> QueueFigures:
        self.asked += 1
        return super().figures()


class Unscored(Jobs):
    """A worker that has published scenes and lost their scores."""

    def __init__(self, data_dir: Path) -> None:
        super().__init__(Queue(), Store(data_dir))
        self.left = InterruptedScores(self.queue, self.store, "worker-1", threading.Event())

    def published(self) -> str:
        job_id = self.submit("publish")
        claimed = self.queue.claim("worker-1.a", 0.0)
        assert claimed is not None
        out = self.store.work_folder(job_id, 1)
        for name, content in {MANIFEST: {"files": {}}, REPORT_FILE: REPORT | {"scored": False}}.items():
            (out / name).write_text(json.dumps(content))
        (out / CURVE).write_text("psnr_tissue_db,psnr_right_db\n30,\n")
        self.store.expect_scores("worker-1", job_id, 1)
        self.store.publish_scene(job_id, 1)
        assert self.queue.finish(Claim(job_id, 1, "worker-1.a"))
        return job_id

    def make_up(self, score_s: float = 0.0) -> Child:
        child = Child(score_s)
        self.left.make_up(cast(DeviceChild, child))
        return child


@pytest.fixture
def bench(tmp_path: Path) -> Unscored:
    return Unscored(tmp_path)


def test_the_queue_is_not_asked_at_every_look_whether_a_job_waits(
    bench: Unscored, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scores, "ASK_PERIOD_S", 60.0)
    job_id = bench.published()
    bench.make_up(score_s=0.3)
    assert bench.store.newest_report(job_id, 1).scored
    assert cast(Queue, bench.queue).asked == 0


def test_scores_give_way_to_a_job_that_waits(bench: Unscored, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scores, "ASK_PERIOD_S", 0.05)
    job_id = bench.published()
    bench.submit("publish")
    child = bench.make_up(score_s=60.0)
    assert [type(order) for order in child.sent] == [ScoreScene, StopJob]
    assert bench.store.unscored("worker-1") == [(job_id, 1)]


def test_a_try_without_scores_is_repeated_after_a_pause(bench: Unscored, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scores, "ASK_PERIOD_S", 0.05)
    job_id = bench.published()
    waiting = bench.submit("publish")
    bench.make_up(score_s=60.0)
    bench.queue.cancel(waiting)
    assert bench.make_up().sent == []
    monkeypatch.setattr(scores, "RETRY_AFTER_S", 0.0)
    bench.make_up()
    assert bench.store.newest_report(job_id, 1).scored


def test_a_scene_whose_clip_is_gone_is_told_of_once_and_keeps_no_other_waiting(
    bench: Unscored, caplog: pytest.LogCaptureFixture
) -> None:
    lost, sound = sorted([bench.published(), bench.published()])
    (bench.store.spool_folder(lost) / "submission.json").unlink()
    for _ in range(3):
        bench.make_up()
    assert bench.store.newest_report(sound, 1).scored
    assert bench.store.unscored("worker-1") == [(lost, 1)]
    assert caplog.text.count("a scene waits for its scores") == 1


def test_scores_that_were_added_are_not_measured_again(bench: Unscored) -> None:
    job_id = bench.published()
    bench.make_up()
    folder = bench.store.scene_folder(job_id, 1)
    added = {name: (folder / name).read_bytes() for name in (REPORT_FILE, CURVE, MANIFEST)}
    bench.store.expect_scores("worker-1", job_id, 1)  # as after a kill between the manifest and expect_no_scores
    assert bench.make_up().sent == []
    assert bench.store.unscored("worker-1") == []
    assert {name: (folder / name).read_bytes() for name in added} == added


def test_a_scene_whose_report_cannot_be_read_is_not_scored(bench: Unscored) -> None:
    job_id = bench.published()
    (bench.store.scene_folder(job_id, 1) / REPORT_FILE).write_text("{")
    assert bench.make_up().sent == []
    assert bench.store.unscored("worker-1") == []


def test_a_scene_whose_manifest_is_damaged_is_waited_for_no_longer(bench: Unscored) -> None:
    job_id = bench.published()
    (bench.store.scene_folder(job_id, 1) / MANIFEST).write_text("{")
    bench.make_up()
    assert bench.store.unscored("worker-1") == []
