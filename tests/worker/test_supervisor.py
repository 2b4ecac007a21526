"""The worker's process with an embedded queue: however it ends, its job goes on elsewhere and makes one scene."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from contract.queue.embedded import EmbeddedServer
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from contract.store.store import Store
from contract.wire.job import JobState
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import UnavailableError
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.resume_file import load_resume
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from lab.phantom import PhantomSettings, make_phantom, write_endonerf
from tests.contract.queues import RunningServer, valkey_binary
from tests.worker.jobs import STANDIN, WAIT_S, Jobs, eventually
from worker.__main__ import main
from worker.supervisor import run_supervisor

LEASE_S = 6.0
"""Three beats, and three times as long as standin.py takes for a `slow` job, which ends while its worker sleeps."""

REPOSITORY = Path(__file__).resolve().parents[2]
PROGRAM = f"""
import functools, sys
from contract.runtime.logs import configure
from intrasplat.machine.processes import shutdown_event
from contract.runtime.settings import Settings
from worker import supervisor
supervisor.RedisQueue = functools.partial(supervisor.RedisQueue, lease_s={LEASE_S})
settings = Settings.from_environment()
configure(settings, settings.worker_name)
supervisor.run_supervisor(settings, shutdown_event(), [sys.executable, {str(STANDIN)!r}])
"""
"""A worker as `python -m worker consume` makes one, with shorter leases and a child that needs no torch."""


class WorkerProcesses(Jobs):
    """Jobs, and any number of workers."""

    def __init__(self, data_dir: Path) -> None:
        self.server = EmbeddedServer(data_dir)
        self.server.start()
        super().__init__(RedisQueue(self.server.url, lease_s=LEASE_S), Store(data_dir))

    def close(self) -> None:
        self.queue.close()
        self.server.stop()

    def settings(self, name: str = "worker-1") -> Settings:
        return Settings(data_dir=self.store.data_dir, redis_url=self.server.url, worker_name=name)

    @contextmanager
    def worker(self, name: str = "worker-1", command: list[str] | None = None) -> Iterator[subprocess.Popen[bytes]]:
        environment = {**os.environ, **self.settings(name).to_environment()}
        command = command or [sys.executable, "-c", PROGRAM]
        with subprocess.Popen(command, env=environment, cwd=REPOSITORY, stderr=subprocess.PIPE) as process:
            try:
                yield process
            finally:
                process.send_signal(signal.SIGCONT)
                process.terminate()
                _, errors = process.communicate(timeout=WAIT_S)
                assert b"Traceback" not in errors
                assert b"uncaught error" not in errors, errors.decode()

    def holder(self, job_id: str) -> str:
        """Name of the worker that holds, or last held, the job."""
        return (self.record(job_id).owner or "").split(".")[0]


def children_of(process: subprocess.Popen[bytes]) -> list[int]:
    return [int(each) for each in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkerProcesses]:
    bench = WorkerProcesses(tmp_path)
    yield bench
    bench.close()


def test_a_worker_told_to_end_hands_its_job_back_and_is_gone(bench: WorkerProcesses) -> None:
    job_id = bench.submit("wait publish")
    with bench.worker() as worker:
        bench.wait_for_step(job_id)
        eventually(lambda: [each.job_id for each in bench.queue.workers()] == [job_id])
        worker.terminate()
        assert worker.wait(WAIT_S) == ExitCode.OK
    assert bench.queue.workers() == []
    record = bench.record(job_id)
    assert (record.state, record.released) == (JobState.QUEUED, 1)
    with bench.worker("worker-2"):
        record = bench.wait_for_end(job_id)
    assert (record.state, record.attempt) == (JobState.DONE, 2)


def test_a_real_worker_told_to_end_keeps_what_was_trained_and_the_next_comes_to_the_same_bits(
    bench: WorkerProcesses, tmp_path: Path
) -> None:
    write_endonerf(make_phantom(PhantomSettings(width=96, height=80, frames=8)), tmp_path / "clip")
    clip = Path(shutil.make_archive(str(tmp_path / "clip"), "zip", tmp_path / "clip"))
    request = ReconstructionRequest(clip, ReconstructionOptions(iterations=500))
    reconstruct(request, tmp_path / "whole", TrainingHooks())
    real = [sys.executable, "-m", "worker", "consume"]
    job_id = bench.submit(clip, iterations=500)
    with bench.worker(command=real) as worker:
        bench.wait_for_step(job_id)
        worker.terminate()
        assert worker.wait(WAIT_S) == ExitCode.OK
    assert bench.record(job_id).state is JobState.QUEUED
    stopped_at = load_resume(bench.store.data_dir / "kept" / f"{job_id}.1")[1]["iteration"]
    assert 0 < stopped_at < 500
    with bench.worker("worker-2", real):
        record = bench.wait_for_end(job_id)
    assert (record.state, record.attempt, record.released) == (JobState.DONE, 2, 1)
    assert tensor_bits(bench.store.scene_folder(job_id, 2)) == tensor_bits(tmp_path / "whole")


def tensor_bits(folder: Path) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in load_scene(folder).tensors().items()}


def test_a_worker_that_is_killed_takes_its_child_along_and_another_takes_the_job(bench: WorkerProcesses) -> None:
    job_id = bench.submit("wait publish")
    with bench.worker() as killed, bench.worker("worker-2") as other:
        bench.wait_for_step(job_id)
        first, second = (killed, other) if bench.holder(job_id) == "worker-1" else (other, killed)
        child_id = children_of(first)[0]
        first.kill()
        eventually(lambda: not Path(f"/proc/{child_id}").exists())
        record = bench.wait_for_end(job_id)
        assert (record.state, record.attempt) == (JobState.DONE, 2)
        assert second.poll() is None


def test_a_worker_that_slept_through_its_lease_publishes_nothing(bench: WorkerProcesses) -> None:
    job_id = bench.submit("slow wait")
    with bench.worker() as asleep:
        bench.wait_for_step(job_id)
        asleep.send_signal(signal.SIGSTOP)  # its child goes on, and finishes
        with bench.worker("worker-2"):
            bench.wait_for_step(job_id, attempt=2)
            asleep.send_signal(signal.SIGCONT)
            eventually(lambda: not (bench.store.data_dir / "work" / f"{job_id}.1").exists())
            time.sleep(1.0)
            assert bench.store.scene_attempts(job_id) == []
            assert bench.holder(job_id) == "worker-2"
            assert bench.record(job_id).state is JobState.RUNNING


def test_a_worker_for_renders_alone_is_announced_and_claims_nothing(bench: WorkerProcesses) -> None:
    end = threading.Event()
    settings, command = bench.settings("renders"), [sys.executable, str(STANDIN)]
    worker = threading.Thread(target=run_supervisor, args=(settings, end, command), kwargs={"renders_only": True})
    worker.start()
    try:
        eventually(lambda: [each.renders_only for each in bench.queue.workers()] == [True])
        job_id = bench.submit("publish")
        assert bench.queue.forecast(job_id).eta_s is None
        time.sleep(1.0)  # CLAIM_TIMEOUT_S of a worker that claims
        record = bench.queue.get(job_id)
        assert record is not None
        assert record.state is JobState.QUEUED
    finally:
        end.set()
        worker.join()
    assert bench.queue.workers() == []


def test_a_second_worker_of_one_name_is_refused(bench: WorkerProcesses) -> None:
    with bench.worker():
        eventually(lambda: bool(bench.queue.workers()))
        with pytest.raises(UnavailableError, match="worker-1 already works"):
            run_supervisor(bench.settings(), threading.Event(), [sys.executable, str(STANDIN)])


def test_a_worker_waits_for_a_queue_that_is_not_there_yet(tmp_path: Path) -> None:
    bench = WorkerProcesses(tmp_path)
    bench.server.stop()
    with bench.worker() as worker:
        time.sleep(1.0)
        bench.server.start()
        eventually(lambda: len(bench.queue.workers()) == 1)
        assert worker.poll() is None
    bench.close()


def test_a_worker_whom_the_queue_refuses_ends_and_says_what_to_correct(tmp_path: Path) -> None:
    server = RunningServer(valkey_binary(), tmp_path / "queue", requirepass="secret")
    settings = Settings(data_dir=tmp_path / "data", redis_url=f"unix://:wrong@{server.socket}")
    with pytest.raises(UnavailableError, match=r"Correct .* of REDIS_URL"):
        run_supervisor(settings, threading.Event(), [sys.executable, str(STANDIN)])
    server.stop()


def test_the_supervisor_loads_nothing_that_could_hang_or_eat_memory() -> None:
    heavy = ("torch", "numba", "cv2", "scipy", "numpy", "zmq")
    program = f"import sys, worker.supervisor; print(*(each for each in {heavy!r} if each in sys.modules))"
    command = [sys.executable, "-c", program]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=60, check=True)
    assert result.stdout.split() == []


def test_consume_without_a_queue_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("REDIS_URL", raising=False)
    assert main(["consume"]) == ExitCode.UNAVAILABLE
    assert "intrasplat up" in capsys.readouterr().err
