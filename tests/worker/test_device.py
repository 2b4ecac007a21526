"""The device process: all options of a job reach the reconstruction, and orders, errors and deaths are handled."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.wire.job import JobFiles, JobRecord
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError, TrainingDiverged, UnavailableError
from intrasplat.names import REPORT, RESUME_STATE
from intrasplat.notices import NoticeCode
from intrasplat.options import JobOptions, ReconstructionOptions
from intrasplat.report import Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.resume_file import RESUME_FILE, load_resume
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from lab.__main__ import main
from tests.reports import REPORT_OF_A_SCENE
from worker.child import ChildKeeper, DeviceChild
from worker.device import make_or_start_anew, request_of, scored
from worker.job_errors import describe
from worker.orders import Advanced, Failed, Finished, RunJob, Scored, ScoreScene, StopJob, Stopped

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
        if name not in ("priority", "retention_hours"):  # they are the queue's and the service's business
            assert getattr(asked.options, name) == value, name
    assert asked.device == "cpu"


def test_files_lie_where_the_store_keeps_them() -> None:
    all_files = JobFiles(clip="clip.mp4", right="right.mp4", calibration="calibration.json", masks="masks.zip")
    asked = request(all_files, {})
    assert (asked.clip, asked.right) == (SPOOL / "clip.mp4", SPOOL / "right.mp4")
    assert (asked.calibration, asked.masks) == (SPOOL / "calibration.json", SPOOL / "masks.zip")
    alone = request(JobFiles(clip="clip.zip"), {})
    assert (alone.right, alone.calibration, alone.masks, alone.poses) == (None, None, None, None)
    posed = request(JobFiles(clip="clip.zip", poses_file="poses_file.tum"), {})
    assert posed.poses == SPOOL / "poses_file.tum"
    again = request(JobFiles(clip="clip.zip", poses_file="poses_file.tum"), {"poses": "estimate"})
    assert again.poses is None  # they came with an earlier job of the clip
    files = JobFiles(clip="clip.zip", fov_mask="fov_mask.png")
    assert request(files, {}).fov_mask == SPOOL / "fov_mask.png"
    assert request(files, {"fov": "all"}).fov_mask is None  # it came with an earlier job of the clip
    assert alone.fov_mask is None


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A zip in the EndoNeRF layout."""
    folder = tmp_path_factory.mktemp("phantom") / "clip"
    size = ["--width", "96", "--height", "80", "--frames", "8"]
    assert main(["phantom", *size, "--format", "endonerf", "--out", str(folder)]) == ExitCode.OK
    return Path(shutil.make_archive(str(folder), "zip", folder))


@pytest.fixture
def device(tmp_path: Path) -> Iterator[DeviceChild]:
    """`python -m worker device`, ready."""
    settings = Settings(data_dir=tmp_path / "data")
    keeper = ChildKeeper([sys.executable, "-m", "worker", "device"], {**os.environ, **settings.to_environment()})
    child = keeper.child(threading.Event())
    assert child is not None
    yield child
    keeper.stop()


def wait_until(holds: Callable[[], bool], timeout_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def order(clip: Path, out: Path, **options: object) -> RunJob:
    chosen = JobOptions.model_validate(options)
    record = JobRecord(job_id="a" * 32, files=JobFiles(clip=clip.name), options=chosen, created_at_s=time.time())
    resume_dir = out.with_name(f"{out.name}.resume")
    for folder in (out, resume_dir):
        folder.mkdir(exist_ok=True)
    return RunJob(record=record, spool=clip.parent, out=out, resume_dir=resume_dir)


def end_of_job(child: DeviceChild, stop_after: int | None = None) -> tuple[object, list[Advanced]]:
    """The job's last report and those before it; it is stopped after so many iterations."""
    advances: list[Advanced] = []
    while True:
        report = child.next_report(60.0)
        if not isinstance(report, Advanced):
            return report, advances
        advances.append(report)
        if stop_after is not None and report.progress.iteration > stop_after:
            child.send(StopJob())
            stop_after = None


def scores(child: DeviceChild) -> Report:
    """The report that follows a finished scene."""
    end, _ = end_of_job(child)
    assert isinstance(end, Scored)
    return end.report


def test_a_stopped_job_goes_on_to_the_same_bits_and_the_process_does_any_number_of_jobs(
    device: DeviceChild, tmp_path: Path, clip: Path
) -> None:
    whole, out = tmp_path / "whole", tmp_path / "out"
    device.send(order(clip, whole, iterations=600))
    assert end_of_job(device)[0] == Finished()
    first = Report.model_validate_json((whole / REPORT).read_bytes())
    report = scores(device)
    assert (first.scored, report.scored) == (False, True)
    assert report.train_psnr_tissue_db is not None
    again = ScoreScene(record=order(clip, whole, iterations=600).record, spool=clip.parent, scene=whole)
    device.send(again)
    assert scores(device).frames == report.frames
    device.send(order(clip, tmp_path / "no", holdout="99", iterations=3))
    failed, _ = end_of_job(device)
    assert isinstance(failed, Failed)
    assert (failed.fault, failed.error.field) == ("InputError", "options.holdout")
    device.send(order(clip, out, iterations=600))
    assert end_of_job(device, stop_after=1)[0] == Stopped(checkpointed=True)
    resume_dir = tmp_path / "out.resume"
    assert list(out.iterdir()) == []
    assert {path.name for path in resume_dir.iterdir()} == set(RESUME_STATE)
    stopped_at = load_resume(resume_dir)[1]["iteration"]
    device.send(StopJob())  # too late for the last job, and not meant for the next
    device.send(order(clip, out, iterations=600))
    finished, advances = end_of_job(device)
    assert finished == Finished()
    assert scores(device).frames == report.frames
    assert min(each.progress.iteration for each in advances if each.progress.stage == "train") == stopped_at
    assert tensor_bits(out) == tensor_bits(whole)


def tensor_bits(folder: Path) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in load_scene(folder).tensors().items()}


def test_a_job_that_trains_dies_with_the_process_that_ordered_it(tmp_path: Path, clip: Path) -> None:
    spool, out = clip.parent, tmp_path / "out"
    program = (
        "import sys; from threading import Event;"
        "from worker.child import ChildKeeper; from worker.orders import *;"
        "child = ChildKeeper([sys.executable, '-m', 'worker', 'device']).child(Event());"
        "child.send(read_order(sys.argv[1].encode())); report = None\n"
        "while report is None or report.progress.stage != 'train': report = child.next_report(60)\n"
        "print(child.process.pid, flush=True); child.next_report(60)"
    )
    settings = Settings(data_dir=tmp_path / "data").to_environment()
    ordered = order(spool / clip.name, out, iterations=1_000_000).model_dump_json()
    command = [sys.executable, "-c", program, ordered]
    with subprocess.Popen(command, env={**os.environ, **settings}, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        process_id = int(parent.stdout.readline())
        parent.kill()
    wait_until(lambda: not is_alive(process_id), timeout_s=5.0)


def is_alive(process_id: int) -> bool:
    """Whether it runs; a dead process that nobody has waited for does not."""
    try:
        return Path(f"/proc/{process_id}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_state_of_another_version_is_left_behind_and_training_starts_anew(tmp_path: Path, clip: Path) -> None:
    request_here = ReconstructionRequest(clip, ReconstructionOptions(iterations=3))
    (tmp_path / RESUME_FILE).write_bytes(b"of another version")
    make_or_start_anew(request_here, tmp_path / "out", tmp_path, TrainingHooks())
    assert (tmp_path / "out" / REPORT).exists()
    assert load_resume(tmp_path)[1]["iteration"] == 3


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (TrainingDiverged("NaN after 12 iterations."), "NaN after 12"),
        (UnavailableError("No CUDA device.", "Use --device cpu."), "No CUDA device"),
        (MemoryError("smith.mp4"), "out of memory"),
        (torch.OutOfMemoryError("smith.mp4"), "out of memory"),
        (ValueError("smith.mp4"), "A fault in the worker (ValueError)"),
    ],
)
def test_every_error_has_a_remedy_and_no_unforeseen_text_reaches_the_caller(error: Exception, says: str) -> None:
    told = describe(error)
    assert says in told.problem
    assert told.remedy
    assert "smith" not in told.model_dump_json()


def test_a_scene_that_cannot_be_scored_says_so_in_its_report(tmp_path: Path) -> None:
    first = REPORT_OF_A_SCENE.model_copy(update={"scored": False, "psnr_tissue_db": None})
    (tmp_path / REPORT).write_text(first.model_dump_json())

    def diverged() -> Report:
        raise TrainingDiverged("Frame 3 renders as NaN.")

    for given in (first, tmp_path / REPORT):
        told = scored(diverged, given)
        assert isinstance(told, Scored)
        assert told.report.scored
        assert [each.code for each in told.report.warnings] == [NoticeCode.SCORES_FAILED]


@pytest.mark.parametrize("error", [UnavailableError("It is away.", "Wait."), FileNotFoundError("purged")])
def test_a_scene_that_is_gone_or_waits_for_something_is_not_given_up(error: Exception, tmp_path: Path) -> None:
    def fails() -> Report:
        raise error

    assert scored(fails, tmp_path / REPORT) == Stopped(checkpointed=False)


def test_a_lost_gpu_ends_the_process_that_scores_and_is_not_the_scenes_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.device.gpu_is_lost", lambda: True)

    def fails() -> Report:
        raise RuntimeError("CUDA error")

    with pytest.raises(SystemExit):
        scored(fails, REPORT_OF_A_SCENE)


def test_other_trouble_with_the_input_is_not_tried_twice(tmp_path: Path) -> None:
    (tmp_path / RESUME_FILE).write_bytes(b"kept")
    asked = ReconstructionRequest(tmp_path / "no.zip", ReconstructionOptions(iterations=3))
    with pytest.raises(InputError, match="clip"):
        make_or_start_anew(asked, tmp_path / "out", tmp_path, TrainingHooks())
    assert (tmp_path / RESUME_FILE).read_bytes() == b"kept"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_worker_for_a_device_it_cannot_train_on_ends_at_once_with_the_remedy(tmp_path: Path) -> None:
    environment = Settings(data_dir=tmp_path, device="cuda", redis_url="unix:///nobody.sock").to_environment()
    command = [sys.executable, "-m", "worker", "consume"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert ended.returncode == ExitCode.UNAVAILABLE
    assert ended.stderr.count("INTRASPLAT_DEVICE=cpu") == 1
