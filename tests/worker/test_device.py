"""The worker's process: what a job asks for reaches the reconstruction whole, and no way to end it loses the job."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from contract.embedded import EmbeddedServer
from contract.errors import InputError, UnavailableError
from contract.exits import ExitCode
from contract.job import JobFiles, JobOptions, JobRecord, JobState
from contract.queue_redis import RedisQueue
from contract.settings import Settings
from contract.store import REPORT, Store, new_job_id
from worker.__main__ import main
from worker.checkpoint import RESUME_FILE, load_resume
from worker.hooks import Hooks
from worker.pipeline import ReconstructionRequest
from worker.device import request_of, run_or_start_anew, training_device

SPOOL = Path("spool")
CHOSEN = {
    "preset": "paper",
    "budget_s": 12.5,
    "mask_polarity": "tissue",
    "layout": "sbs",
    "pose_convention": "llff",
    "holdout": "1,9",
    "seed": 4,
}


def request(files: JobFiles, options: dict[str, object]) -> ReconstructionRequest:
    record = JobRecord(job_id=new_job_id(), files=files, options=JobOptions.model_validate(options), created_at_s=0.0)
    return request_of(record, SPOOL, "cpu")


@pytest.mark.parametrize("chosen", [CHOSEN, {"iterations": 7}])
def test_every_option_of_a_job_is_one_of_the_request(chosen: dict[str, object]) -> None:
    asked = request(JobFiles(clip="clip.mp4"), chosen)
    for name, value in JobOptions.model_validate(chosen):
        assert getattr(asked, name) == value, name
    assert asked.device == "cpu"


def test_files_lie_where_the_store_keeps_them() -> None:
    all_files = JobFiles(clip="clip.mp4", right="right.mp4", calibration="calibration.json", masks="masks.zip")
    asked = request(all_files, {})
    assert (asked.clip, asked.right) == (SPOOL / "clip.mp4", SPOOL / "right.mp4")
    assert (asked.calibration, asked.masks) == (SPOOL / "calibration.json", SPOOL / "masks.zip")
    alone = request(JobFiles(clip="clip.zip"), {})
    assert (alone.right, alone.calibration, alone.masks) == (None, None, None)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A zip in the EndoNeRF layout."""
    folder = tmp_path_factory.mktemp("phantom") / "clip"
    size = ["--width", "96", "--height", "80", "--frames", "8"]
    assert main(["phantom", *size, "--format", "endonerf", "--out", str(folder)]) == ExitCode.OK
    return Path(shutil.make_archive(str(folder), "zip", folder))


@contextmanager
def worker_of(settings: Settings) -> Iterator[subprocess.Popen[bytes]]:
    """`python -m worker consume`, told to end when the context is left."""
    command = [sys.executable, "-m", "worker", "consume"]
    with subprocess.Popen(command, env=settings.to_environment(), stderr=subprocess.PIPE) as process:
        yield process
        process.terminate()
        assert process.stderr is not None
        assert b"Traceback" not in process.stderr.read()
        assert process.wait(timeout=60) == ExitCode.OK


def wait_until(holds: Callable[[], bool], timeout_s: float = 120.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def test_a_worker_told_to_end_gives_its_job_back_and_the_next_goes_on_from_there(tmp_path: Path, clip: Path) -> None:
    server = EmbeddedServer(tmp_path)
    server.start()
    store, queue = Store(tmp_path), RedisQueue(server.url)
    settings = Settings(data_dir=tmp_path, redis_url=server.url)
    options = JobOptions(iterations=100_000)
    record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.zip"), options=options, created_at_s=0.0)
    shutil.copy(clip, store.open_incoming(record.job_id) / "clip.zip")
    store.accept(record)
    queue.submit(record)
    (store.scratch_folder(settings.worker_name) / "of a process that was killed").write_text("frames")

    def now() -> JobRecord:
        found = queue.get(record.job_id)
        assert found is not None
        return found

    iterations = [0]
    for attempt in (1, 2):
        with worker_of(settings):
            wait_until(lambda: (progress := now().progress) is not None and progress.iteration > iterations[-1])
            assert now().attempt == attempt
        assert (now().state, now().released) == (JobState.QUEUED, attempt)
        iterations.append(load_resume(store.data_dir / "work" / f"{record.job_id}.{attempt}")[1]["iteration"])
    assert iterations[2] > iterations[1] > 0
    assert list((store.data_dir / "work" / f"tmp-{settings.worker_name}").iterdir()) == []
    queue.close()
    server.stop()


def test_a_state_of_another_version_is_left_behind_and_training_starts_anew(tmp_path: Path, clip: Path) -> None:
    request_here = ReconstructionRequest(clip=clip, iterations=3)
    (tmp_path / RESUME_FILE).write_bytes(b"of another version")
    run_or_start_anew(request_here, tmp_path, Hooks())
    assert (tmp_path / REPORT).exists()
    assert not (tmp_path / RESUME_FILE).exists()


def test_other_trouble_with_the_input_is_not_tried_twice(tmp_path: Path) -> None:
    (tmp_path / RESUME_FILE).write_bytes(b"kept")
    with pytest.raises(InputError, match="clip"):
        run_or_start_anew(ReconstructionRequest(clip=tmp_path / "no.zip", iterations=3), tmp_path, Hooks())
    assert (tmp_path / RESUME_FILE).read_bytes() == b"kept"


def test_a_worker_for_a_device_it_cannot_train_on_ends_at_once_with_the_remedy(tmp_path: Path) -> None:
    assert training_device("auto") == training_device("cpu") == "cpu"
    with pytest.raises(UnavailableError, match="CPU only"):
        training_device("cuda")
    environment = Settings(data_dir=tmp_path, device="cuda", redis_url="unix:///nobody.sock").to_environment()
    command = [sys.executable, "-m", "worker", "consume"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert ended.returncode == ExitCode.UNAVAILABLE
    assert "Set INTRASPLAT_DEVICE to auto or cpu" in ended.stderr
