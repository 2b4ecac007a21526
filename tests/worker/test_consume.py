"""The job loop on a real queue and store, with small reconstructions that do what a test needs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from contract.errors import Cancelled, InputError, TrainingDiverged, UnavailableError
from contract.job import JobError, JobFiles, JobProgress, JobRecord, JobState
from contract.queue import MAX_ATTEMPTS, Claim
from contract.queue_memory import MemoryQueue
from contract.rendering import WorkerAddress
from contract.store import MANIFEST, Store, new_job_id
from worker.checkpoint import RESUME_FILE
from worker.consume import announced, consume, job_progress
from worker.hooks import Hooks, Progress

WAIT_S = 10.0


def writes_a_scene(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
    assert (spool / record.files.clip).read_bytes() == b"frames"
    hooks.on_progress(Progress("train", 0.5, 5, 10, psnr_db=30.0, seconds_left=1.0))
    (out / MANIFEST).write_text("{}")


def waits_to_be_stopped(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        hooks.on_progress(Progress("train", 0.1))
        if hooks.should_stop():
            raise Cancelled
        time.sleep(0.01)
    raise AssertionError("nobody asked to stop")


def raises(error: Exception) -> Callable[[JobRecord, Path, Path, Hooks], None]:
    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        (out / "half").write_text("written")
        raise error

    return work


class Bench:
    """A queue, a store and a worker thread."""

    def __init__(self, data_dir: Path) -> None:
        self.queue = MemoryQueue()
        self.store = Store(data_dir)
        self.end = threading.Event()
        self.thread: threading.Thread | None = None

    def submit(self) -> str:
        record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=time.time())
        (self.store.open_incoming(record.job_id) / "clip.mp4").write_bytes(b"frames")
        self.store.accept(record)
        self.queue.submit(record)
        return record.job_id

    def start(self, work: Callable[[JobRecord, Path, Path, Hooks], None]) -> None:
        arguments = (self.queue, self.store, "worker-1", work, self.end, 0.02)
        self.thread = threading.Thread(target=consume, args=arguments)
        self.thread.start()

    def stop(self) -> None:
        self.end.set()
        if self.thread is not None:
            self.thread.join()

    def record(self, job_id: str) -> JobRecord:
        record = self.queue.get(job_id)
        assert record is not None
        return record

    def wait_for(self, job_id: str, *states: JobState) -> JobRecord:
        deadline = time.monotonic() + WAIT_S
        while self.record(job_id).state not in states:
            assert time.monotonic() < deadline, self.record(job_id)
            time.sleep(0.005)
        return self.record(job_id)

    def files_of(self, job_id: str) -> list[Path]:
        return [path for path in self.store.data_dir.rglob("*") if path.name.startswith(job_id)]


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def run(bench: Bench, work: Callable[[JobRecord, Path, Path, Hooks], None]) -> JobRecord:
    job_id = bench.submit()
    bench.start(work)
    try:
        return bench.wait_for(job_id, JobState.DONE, JobState.FAILED, JobState.CANCELLED)
    finally:
        bench.stop()


def test_a_reconstruction_that_returns_makes_its_job_done_and_its_scene_visible(bench: Bench) -> None:
    record = run(bench, writes_a_scene)
    assert record.state is JobState.DONE
    assert bench.store.scene_ids() == [record.job_id]
    assert record.progress is not None
    assert record.progress.psnr_db == 30.0
    assert list((bench.store.data_dir / "work").iterdir()) == []


def test_an_input_error_fails_the_job_with_its_field_and_remedy(bench: Bench) -> None:
    record = run(bench, raises(InputError("masks", "they cover everything.", "Invert them.")))
    assert record.state is JobState.FAILED
    assert record.error == JobError(problem="they cover everything.", field="masks", remedy="Invert them.")
    assert bench.store.scene_ids() == []
    assert list((bench.store.data_dir / "work").iterdir()) == []


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (TrainingDiverged("NaN after 12 iterations."), "NaN after 12"),
        (UnavailableError("No CUDA device.", "Use --device cpu."), "No CUDA device"),
        (MemoryError(), "out of memory"),
        (ValueError("patient Smith"), "A fault in the worker (ValueError)"),
    ],
)
def test_every_other_error_fails_the_job_and_says_why(bench: Bench, error: Exception, says: str) -> None:
    record = run(bench, raises(error))
    assert record.state is JobState.FAILED
    assert record.error is not None
    assert says in record.error.problem
    assert record.error.remedy
    assert "Smith" not in record.model_dump_json()


def test_the_worker_goes_on_after_a_failed_job(bench: Bench) -> None:
    broken, sound = bench.submit(), bench.submit()

    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        (raises(ValueError()) if record.job_id == broken else writes_a_scene)(record, spool, out, hooks)

    bench.start(work)
    assert bench.wait_for(broken, JobState.FAILED).state is JobState.FAILED
    assert bench.wait_for(sound, JobState.DONE).state is JobState.DONE
    bench.stop()


def test_cancelling_a_running_job_stops_it_and_removes_every_file_of_it(bench: Bench) -> None:
    job_id = bench.submit()
    bench.start(waits_to_be_stopped)
    bench.wait_for(job_id, JobState.RUNNING)
    bench.queue.cancel(job_id)
    assert bench.wait_for(job_id, JobState.CANCELLED, JobState.DONE).state is JobState.CANCELLED
    bench.stop()
    assert bench.files_of(job_id) == []


def test_a_job_cancelled_in_its_last_moment_publishes_nothing(bench: Bench) -> None:
    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        writes_a_scene(record, spool, out, hooks)
        bench.queue.cancel(record.job_id)

    record = run(bench, work)
    assert record.state is JobState.CANCELLED
    assert bench.files_of(record.job_id) == []


def test_a_worker_that_is_told_to_end_leaves_its_job_to_the_next(bench: Bench) -> None:
    job_id = bench.submit()
    bench.start(waits_to_be_stopped)
    bench.wait_for(job_id, JobState.RUNNING)
    bench.stop()
    assert bench.record(job_id).state is JobState.QUEUED
    bench.end.clear()
    bench.start(writes_a_scene)
    assert bench.wait_for(job_id, JobState.DONE).attempt == 2
    bench.stop()


def test_any_number_of_polite_restarts_ends_in_a_scene_and_each_goes_on_from_the_one_before(bench: Bench) -> None:
    steps: list[int] = []

    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        state = out / RESUME_FILE
        steps.append(int(state.read_text()) + 1 if state.exists() else 0)
        if len(steps) > 2 * MAX_ATTEMPTS:
            writes_a_scene(record, spool, out, hooks)
            return
        state.write_text(str(steps[-1]))
        (out / "half").write_text("written")
        bench.end.set()
        waits_to_be_stopped(record, spool, out, hooks)

    job_id = bench.submit()
    for _ in range(2 * MAX_ATTEMPTS):
        bench.end.clear()
        consume(bench.queue, bench.store, "worker-1", work, bench.end, 0.0)
        assert bench.record(job_id).state is JobState.QUEUED
    bench.end.clear()
    bench.start(work)
    assert bench.wait_for(job_id, JobState.DONE, JobState.FAILED).state is JobState.DONE
    bench.stop()
    assert steps == list(range(2 * MAX_ATTEMPTS + 1))
    assert not (bench.store.scene_folder(job_id) / "half").exists()
    assert list((bench.store.data_dir / "work").iterdir()) == []


class Lane(MemoryQueue):
    """A queue whose connection can be cut."""

    def __init__(self) -> None:
        super().__init__()
        self.cut = threading.Event()
        self.reports = 0

    def progress(self, claim: Claim, progress: JobProgress) -> bool:
        self.reports += 1
        self._pass()
        return super().progress(claim, progress)

    def finish(self, claim: Claim) -> bool:
        self._pass()
        return super().finish(claim)

    def fail(self, claim: Claim, error: JobError) -> bool:
        self._pass()
        return super().fail(claim, error)

    def release(self, claim: Claim) -> bool:
        self._pass()
        return super().release(claim)

    def _pass(self) -> None:
        if self.cut.is_set():
            raise UnavailableError("The lane is cut.", "Wait.")


def finishes(record: JobRecord, out: Path) -> None:
    (out / MANIFEST).write_text("{}")


def breaks(record: JobRecord, out: Path) -> None:
    raise ValueError


def is_stopped(record: JobRecord, out: Path) -> None:
    raise Cancelled


@pytest.mark.parametrize(("ends", "kept"), [(finishes, "scenes"), (breaks, "work"), (is_stopped, "work")])
def test_a_worker_that_must_end_while_the_queue_is_away_touches_nothing(
    tmp_path: Path, ends: Callable[[JobRecord, Path], None], kept: str
) -> None:
    bench, lane = Bench(tmp_path), Lane()
    bench.queue = lane
    job_id = bench.submit()

    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        lane.cut.set()
        bench.end.set()
        ends(record, out)

    consume(lane, bench.store, "worker-1", work, bench.end, 0.0)
    assert bench.record(job_id).state is JobState.RUNNING
    assert bench.store.spool_folder(job_id).is_dir()
    assert [path.name.split(".")[0] for path in (bench.store.data_dir / kept).iterdir()] == [job_id]


def test_a_queue_that_is_away_is_not_tried_again_at_every_report(tmp_path: Path) -> None:
    bench, lane = Bench(tmp_path), Lane()
    bench.queue = lane
    job_id = bench.submit()

    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        lane.cut.set()
        for stage in ("decode", "depth", "train"):
            hooks.on_progress(Progress(stage, 0.5))
        assert lane.reports == 1
        lane.cut.clear()
        (out / MANIFEST).write_text("{}")

    bench.start(work)
    assert bench.wait_for(job_id, JobState.DONE, JobState.FAILED).state is JobState.DONE
    bench.stop()


def test_a_job_that_was_cancelled_while_its_worker_was_dead_leaves_no_file(bench: Bench) -> None:
    job_id = bench.submit()
    died = bench.queue.claim("worker-1", 0.0)
    assert died is not None
    (bench.store.work_folder(job_id, died.attempt) / "half").write_text("written")
    bench.queue.cancel(job_id)
    bench.start(writes_a_scene)
    bench.wait_for(job_id, JobState.CANCELLED, JobState.DONE)
    bench.stop()
    assert bench.record(job_id).state is JobState.CANCELLED
    assert bench.files_of(job_id) == []


@pytest.mark.parametrize(
    "error",
    [
        ValueError("smith.png"),
        InputError("clip", "smith.png is no picture.", "Send one."),
        TrainingDiverged("smith.png diverged."),
    ],
)
def test_the_log_names_jobs_by_their_ids_only(bench: Bench, error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="intrasplat.worker"):
        record = run(bench, raises(error))
    assert record.job_id in caplog.text
    assert type(error).__name__ in caplog.text
    assert "smith" not in caplog.text


def test_an_attempt_that_lost_its_job_publishes_nothing(bench: Bench) -> None:
    def work(record: JobRecord, spool: Path, out: Path, hooks: Hooks) -> None:
        writes_a_scene(record, spool, out, hooks)
        taken_over = bench.queue.claim("worker-1", 0.0)
        assert taken_over is not None
        bench.queue.fail(Claim(record.job_id, taken_over.attempt, "worker-1"), JobError(problem="elsewhere"))

    record = run(bench, work)
    bench.stop()
    assert record.state is JobState.FAILED
    assert bench.store.scene_ids() == []


def test_a_worker_is_announced_while_it_lives(bench: Bench) -> None:
    address = WorkerAddress(name="worker-1", endpoint="ipc:///x", device="cpu")
    with announced(bench.queue, address):
        deadline = time.monotonic() + WAIT_S
        while bench.queue.workers() != [address]:
            assert time.monotonic() < deadline
            time.sleep(0.005)
    assert bench.queue.workers() == []


def test_progress_holds_only_numbers_that_json_can() -> None:
    odd = Progress("train", 1.5, psnr_db=float("nan"), seconds_left=float("inf"))
    assert job_progress(odd) == JobProgress(stage="train", fraction=1.0)
