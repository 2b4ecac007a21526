"""The job loop with a real queue, a real store and a child process that obeys the text of the clip (standin.py)."""
# long: every way in which a job of one worker may go, on one stand-in for its child

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from contract.queue.interface import MAX_ATTEMPTS, Claim, Order
from contract.runtime import supervised
from contract.store.store import Store
from contract.wire.job import JobError, JobProgress, JobRecord, JobState
from contract.wire.rendering import WorkerAddress
from intrasplat.errors import UnavailableError
from intrasplat.names import CURVE, MANIFEST, REPORT, RESUME
from tests.memory_queue import MemoryQueue
from tests.worker.jobs import STANDIN, Jobs, eventually
from worker import child, consume, hang
from worker.announce import announced
from worker.child import ChildKeeper
from worker.consume import Consumer
from worker.supervisor import address_of


class JobLoop(Jobs):
    """Jobs, and a worker in a thread, with a child process."""

    def __init__(self, data_dir: Path, queue: MemoryQueue | None = None, *arguments: str) -> None:
        super().__init__(queue or MemoryQueue(), Store(data_dir))
        self.end = threading.Event()
        command = [sys.executable, str(STANDIN), *arguments]
        self.keeper = ChildKeeper(command, last_words=self.store.run_dir / "worker-1.last-words")
        self.consumer = Consumer(self.queue, self.store, self.keeper, "worker-1", "worker-1.a", self.end)
        self.thread: threading.Thread | None = None

    def start(self) -> None:
        self.end.clear()
        self.thread = threading.Thread(target=self.consumer.run, args=(0.05,))
        self.thread.start()

    def stop(self) -> None:
        self.end.set()
        if self.thread is not None:
            self.thread.join()

    def outcome(self, clip: str) -> JobRecord:
        job_id = self.submit(clip)
        self.start()
        return self.wait_for_end(job_id)

    def child_id(self) -> int:
        eventually(lambda: self.keeper.live is not None)
        live = self.keeper.live
        assert live is not None
        return live.process.pid

    def went_on_from(self, record: JobRecord) -> str:
        folder = self.store.scene_folder(record.job_id, record.attempt)
        text: str = json.loads((folder / MANIFEST).read_text())["went_on_from"]
        return text


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[JobLoop]:
    bench = JobLoop(tmp_path)
    yield bench
    bench.stop()
    bench.keeper.stop()


def test_a_reconstruction_that_finishes_makes_its_job_done_and_its_scene_visible(bench: JobLoop) -> None:
    record = bench.outcome("publish")
    bench.stop()
    assert record.state is JobState.DONE
    assert bench.store.has_scene(record.job_id, record.attempt)
    assert record.progress is not None
    assert (record.progress.psnr_db, record.progress.psnr_right_db) == (30.0, 28.0)
    assert (record.progress.stage, record.progress.iteration, record.progress.iterations) == ("publish", 500, 1000)
    assert bench.files(record.job_id, "work") == []


def test_one_child_does_many_jobs(bench: JobLoop) -> None:
    jobs = [bench.submit("publish"), bench.submit("fail"), bench.submit("publish")]
    before = None
    bench.start()
    before = bench.child_id()
    states = [bench.wait_for_end(job_id).state for job_id in jobs]
    assert states == [JobState.DONE, JobState.FAILED, JobState.DONE]
    assert bench.child_id() == before


def test_an_input_error_fails_the_job_with_its_field_and_remedy(bench: JobLoop) -> None:
    record = bench.outcome("fail")
    bench.stop()
    assert record.state is JobState.FAILED
    assert record.error == JobError(problem="they cover everything.", field="masks", remedy="Invert them.")
    assert bench.files(record.job_id, "work") == bench.files(record.job_id, "scenes") == []


def test_what_a_library_prints_in_the_child_changes_nothing(bench: JobLoop) -> None:
    assert bench.outcome("noise").state is JobState.DONE


@pytest.mark.parametrize("death", ["SIGSEGV", "SIGKILL", "SIGABRT", "exit"])
def test_a_child_that_dies_is_replaced_at_once_and_its_job_runs_again(bench: JobLoop, death: str) -> None:
    record = bench.outcome(f"{death} publish")
    assert (record.state, record.attempt, record.released) == (JobState.DONE, 2, 0)


def test_a_job_that_takes_every_child_down_fails_and_leaves_no_work(bench: JobLoop) -> None:
    record = bench.outcome("SIGSEGV")
    bench.stop()
    assert (record.state, record.attempt) == (JobState.FAILED, MAX_ATTEMPTS)
    assert record.error is not None
    assert "died" in record.error.problem
    assert bench.files(record.job_id, "work") == []


def test_a_child_without_memory_is_named_in_the_log(bench: JobLoop, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="intrasplat.worker"):
        record = bench.outcome("SIGKILL publish")
        bench.stop()
    assert "SIGKILL (was there not enough memory?)" in caplog.text
    assert {getattr(line, "job_id", record.job_id) for line in caplog.records} == {record.job_id}


def test_a_hung_job_is_killed_and_runs_again(bench: JobLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hang, "STAGE_LIMITS_S", {"train": 0.3})
    record = bench.outcome("hang publish")
    assert (record.state, record.attempt, record.released) == (JobState.DONE, 2, 0)


def test_a_child_that_died_idle_is_not_held_against_the_next_job(bench: JobLoop) -> None:
    bench.start()
    os.kill(bench.child_id(), signal.SIGKILL)
    record = bench.record(bench.submit("publish"))
    record = bench.wait_for_end(record.job_id)
    assert record.state is JobState.DONE
    assert record.attempt == record.released + 1


def test_cancelling_a_running_job_stops_it_and_removes_every_file_of_it(bench: JobLoop) -> None:
    job_id = bench.submit("wait")
    bench.start()
    bench.wait_for_step(job_id)
    child_id = bench.child_id()
    bench.queue.cancel(job_id)
    assert bench.wait_for_end(job_id).state is JobState.CANCELLED
    assert bench.files(job_id) == []
    assert bench.child_id() == child_id


@pytest.mark.parametrize("word", ["deaf", "hang"])
def test_a_cancelled_job_that_does_not_stop_is_killed(
    bench: JobLoop, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    monkeypatch.setattr(child, "MAX_STOP_S", 0.3)
    job_id, after = bench.submit(word), bench.submit("publish")
    bench.start()
    bench.wait_for_step(job_id)
    bench.queue.cancel(job_id)
    assert bench.wait_for_end(job_id).state is JobState.CANCELLED
    assert bench.files(job_id) == []
    assert bench.wait_for_end(after).state is JobState.DONE


class Lane(MemoryQueue):
    """A queue that does something else just before a call, or whose connection is cut from then on."""

    def __init__(self) -> None:
        super().__init__()
        self.before: dict[str, Callable[[Claim], object]] = {}
        self.cut = threading.Event()

    def beat(self, claim: Claim, progress: JobProgress | None = None) -> Order:
        self._pass("beat", claim)
        return super().beat(claim, progress)

    def finish(self, claim: Claim) -> bool:
        self._pass("finish", claim)
        return super().finish(claim)

    def fail(self, claim: Claim, error: JobError) -> bool:
        self._pass("fail", claim)
        return super().fail(claim, error)

    def release(self, claim: Claim, *, died: bool = False) -> bool:
        self._pass("release", claim)
        return super().release(claim, died=died)

    def _pass(self, name: str, claim: Claim) -> None:
        if self.cut.is_set():
            raise UnavailableError("The lane is cut.", "Wait.")
        act = self.before.pop(name, None)
        if act is not None:
            act(claim)


@pytest.fixture
def lane(tmp_path: Path) -> Iterator[tuple[JobLoop, Lane]]:
    lane = Lane()
    bench = JobLoop(tmp_path, lane)
    yield bench, lane
    bench.stop()
    bench.keeper.stop()


@pytest.mark.parametrize(
    ("clip", "call"), [("publish", "beat"), ("publish", "finish"), ("fail", "fail"), ("SIGSEGV", "release")]
)
def test_a_cancel_in_the_last_moment_ends_as_cancelled_and_leaves_nothing(
    lane: tuple[JobLoop, Lane], clip: str, call: str
) -> None:
    bench, queue = lane
    queue.before[call] = lambda claim: queue.cancel(claim.job_id)
    record = bench.outcome(clip)
    bench.stop()
    assert record.state is JobState.CANCELLED
    assert bench.files(record.job_id) == []


def test_an_attempt_that_was_thought_dead_publishes_nothing(lane: tuple[JobLoop, Lane]) -> None:
    bench, queue = lane
    others: list[JobRecord | None] = []

    def be_taken_over(claim: Claim) -> None:
        assert MemoryQueue.release(queue, claim)
        others.append(queue.claim("worker-2.b", 0.0))

    queue.before["finish"] = be_taken_over
    job_id = bench.submit("publish")
    bench.start()
    eventually(lambda: bool(others) and bench.consumer.job_id is None)
    assert bench.record(job_id).owner == "worker-2.b"
    assert bench.record(job_id).state is JobState.RUNNING
    assert bench.files(job_id, "scenes") == bench.files(job_id, "work") == []
    assert bench.store.fetch_clip(job_id).is_dir()


def test_a_job_that_was_taken_over_is_stopped(bench: JobLoop) -> None:
    job_id = bench.submit("wait")
    bench.start()
    bench.wait_for_step(job_id)
    assert bench.queue.release(Claim(job_id, 1, "worker-1.a"))
    assert bench.queue.claim("worker-2.b", 0.0) is not None
    eventually(lambda: bench.consumer.job_id is None)
    assert bench.record(job_id).owner == "worker-2.b"
    assert bench.files(job_id, "work") == []


def test_a_worker_that_is_told_to_end_hands_its_job_back_and_any_number_of_times(bench: JobLoop) -> None:
    polite = 2 * MAX_ATTEMPTS
    job_id = bench.submit(" ".join(["wait"] * polite + ["publish"]))
    for attempt in range(1, polite + 1):
        bench.start()
        bench.wait_for_step(job_id, attempt)
        bench.stop()
        assert bench.record(job_id).state is JobState.QUEUED
    bench.start()
    record = bench.wait_for_end(job_id)
    bench.stop()
    assert record.state is JobState.DONE
    assert bench.went_on_from(record) == "x" * polite
    assert not (bench.store.scene_folder(job_id, record.attempt) / "half").exists()
    assert bench.files(job_id, "work") == []


def test_a_worker_that_is_told_to_end_does_not_wait_for_a_deaf_child(
    bench: JobLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child, "MAX_STOP_S", 0.3)
    job_id = bench.submit("deaf")
    bench.start()
    bench.wait_for_step(job_id)
    bench.stop()
    assert (bench.record(job_id).state, bench.record(job_id).released) == (JobState.QUEUED, 1)


def test_a_standard_job_makes_way_for_a_high_priority_one_and_goes_on_later(bench: JobLoop) -> None:
    standard = bench.submit("wait publish")
    bench.start()
    bench.wait_for_step(standard)
    high = bench.submit("publish", priority="high")
    first, second = bench.wait_for_end(high), bench.wait_for_end(standard)
    bench.stop()
    assert (first.state, second.state) == (JobState.DONE, JobState.DONE)
    assert first.finished_at_s is not None
    assert second.started_at_s is not None
    assert first.finished_at_s <= second.started_at_s
    assert (second.attempt, second.released) == (2, 1)
    assert bench.went_on_from(second) == "x"


@pytest.mark.parametrize("clip", ["wait", "SIGSEGV"])
def test_a_worker_that_must_end_while_the_queue_is_away_touches_nothing(lane: tuple[JobLoop, Lane], clip: str) -> None:
    bench, queue = lane
    job_id = bench.submit(clip)

    def cut(claim: Claim) -> None:
        queue.cut.set()
        raise UnavailableError("The lane is cut.", "Wait.")

    queue.before["release"] = cut
    bench.start()
    if clip == "wait":
        bench.wait_for_step(job_id)
    else:
        eventually(queue.cut.is_set)
    bench.stop()
    assert bench.record(job_id).state is JobState.RUNNING
    assert bench.store.fetch_clip(job_id).is_dir()
    assert [path.name for path in bench.files(job_id, "work")] == [f"{job_id}.1"]


def test_a_result_waits_for_a_queue_that_is_away(lane: tuple[JobLoop, Lane]) -> None:
    bench, queue = lane

    def cut(claim: Claim) -> None:
        queue.cut.set()
        threading.Timer(0.2, queue.cut.clear).start()
        raise UnavailableError("The lane is cut.", "Wait.")

    queue.before["finish"] = cut
    record = bench.outcome("publish")
    assert record.state is JobState.DONE
    assert bench.store.has_scene(record.job_id, record.attempt)


def test_beats_go_on_after_an_unforeseen_fault(lane: tuple[JobLoop, Lane]) -> None:
    bench, queue = lane
    stumbled = threading.Event()

    def stumble(claim: Claim) -> None:
        stumbled.set()
        raise ValueError(claim.job_id)

    queue.before["beat"] = stumble
    job_id = bench.submit("wait")
    bench.start()
    eventually(stumbled.is_set)
    queue.cancel(job_id)
    assert bench.wait_for_end(job_id).state is JobState.CANCELLED


def test_a_clip_that_is_gone_fails_its_job(bench: JobLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(consume, "MAX_STORE_S", 0.0)
    lost, sound = bench.submit("publish"), bench.submit("publish")
    bench.store.purge(lost)
    bench.start()
    assert bench.wait_for_end(lost).state is JobState.FAILED
    assert bench.wait_for_end(sound).state is JobState.DONE


def test_a_child_that_dies_at_its_start_is_not_started_in_a_hurry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(supervised, "FIRST_PAUSE_S", 0.05)
    bench = JobLoop(tmp_path, None, "dies")
    bench.start()
    eventually(lambda: "starts in 0.2 s" in caplog.text)
    bench.stop()
    pauses = [line.getMessage().rsplit(" ", 2)[1] for line in caplog.records if "before it was ready" in line.msg]
    assert pauses[:3] == ["0.05", "0.1", "0.2"]


def test_a_child_that_cannot_work_here_ends_the_worker_with_its_remedy(tmp_path: Path) -> None:
    bench = JobLoop(tmp_path, None, "unable")
    with pytest.raises(UnavailableError, match=r"no such device.*INTRASPLAT_DEVICE"):
        bench.consumer.run(0.0)
    bench.keeper.stop()


def test_a_worker_is_announced_with_its_job_and_scenes_while_its_child_lives(bench: JobLoop) -> None:
    job_id = bench.submit("wait")
    with announced(bench.queue, "worker-1", lambda: address_of("worker-1", bench.keeper, bench.consumer)):
        assert bench.queue.workers() == []
        bench.start()
        told = WorkerAddress(
            name="worker-1", endpoint="ipc:///nowhere", device="cpu", job_id=job_id, scenes=("a" * 32,)
        )
        eventually(lambda: bench.queue.workers() == [told])
        bench.stop()
        bench.keeper.stop()
        eventually(lambda: bench.queue.workers() == [])


def test_the_state_of_an_attempt_goes_to_the_next(bench: JobLoop) -> None:
    job_id = bench.submit("wait SIGSEGV publish")
    bench.start()
    bench.wait_for_step(job_id)
    bench.stop()
    assert (bench.store.data_dir / "kept" / f"{job_id}.1" / RESUME).exists()
    bench.start()
    record = bench.wait_for_end(job_id)
    assert (record.state, record.attempt, record.released) == (JobState.DONE, 3, 1)
    assert bench.went_on_from(record) == "x"


def test_a_scene_is_done_before_it_is_scored_and_its_scores_follow(bench: JobLoop) -> None:
    record = bench.outcome("publish")
    eventually(lambda: bench.store.newest_report(record.job_id, record.attempt).scored)
    eventually(lambda: bench.store.unscored("worker-1") == [])
    files = json.loads((bench.store.scene_folder(record.job_id, record.attempt) / MANIFEST).read_text())["files"]
    assert set(files) == {REPORT, CURVE}


@pytest.mark.parametrize("way", ["its child dies", "the worker ends"])
def test_a_scene_that_was_not_scored_is_scored_when_nothing_else_is_to_do(bench: JobLoop, way: str) -> None:
    record = bench.outcome("unscored" if way == "its child dies" else "scoring")
    if way == "the worker ends":
        assert not bench.store.newest_report(record.job_id, record.attempt).scored
        bench.stop()
        assert bench.store.unscored("worker-1") == [(record.job_id, record.attempt)]
        bench.start()
    eventually(lambda: bench.store.newest_report(record.job_id, record.attempt).scored)
    assert bench.record(record.job_id) == record


def test_a_waiting_job_comes_before_the_scores_of_an_earlier_scene(bench: JobLoop) -> None:
    first = bench.outcome("scoring")
    second = bench.submit("publish")
    bench.stop()
    bench.start()
    assert bench.wait_for_end(second).state is JobState.DONE
    eventually(lambda: bench.store.newest_report(first.job_id, first.attempt).scored)


def test_the_scores_of_a_scene_that_was_purged_meanwhile_are_dropped(bench: JobLoop) -> None:
    record = bench.outcome("scoring")
    bench.stop()
    bench.store.purge(record.job_id)
    bench.queue.forget(record.job_id)
    bench.start()
    eventually(lambda: bench.store.unscored("worker-1") == [])
    assert bench.files(record.job_id) == []


def test_a_scene_whose_end_the_queue_accepted_unheard_keeps_its_place_for_scores(
    bench: JobLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = bench.queue.finish

    def accept_unheard(claim: Claim) -> bool:
        finish(claim)
        bench.end.set()
        raise UnavailableError("It is away.", "Wait.")

    monkeypatch.setattr(bench.queue, "finish", accept_unheard)
    record = bench.outcome("scoring")
    bench.stop()
    assert bench.store.unscored("worker-1") == [(record.job_id, record.attempt)]
