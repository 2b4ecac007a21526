"""What counts as an advance, what as a hang, and that every stage of a reconstruction reports in time."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.wire.job import JobProgress
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.machine.processes import STARVED_FACTOR
from intrasplat.machine.timing import Timings
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.stereo import ClipPaths, open_with_depth
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from lab.phantom import PhantomSettings, make_phantom, write_endonerf, write_stereo_video
from worker.hang import MAX_LOOK_S, OTHER_LIMIT_S, STAGE_LIMITS_S, HangDetector
from worker.orders import job_progress


class Clock:
    """Time that passes when it is told to; the detector is asked all the while."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def pass_by(self, detector: HangDetector, seconds: float) -> bool:
        for _ in range(round(10 * seconds)):
            self.now_s += 0.1
            if detector.is_hung():
                return True
        return False


def trained(iteration: int) -> JobProgress:
    return JobProgress(stage="train", fraction=iteration / 1000, iteration=iteration, iterations=1000)


def test_a_job_that_advances_does_not_hang_however_long_it_takes() -> None:
    clock = Clock()
    detector = HangDetector(clock)
    for iteration in range(20):
        detector.observe(trained(iteration))
        assert not clock.pass_by(detector, STAGE_LIMITS_S["train"] - 1)


def test_repeating_oneself_is_no_advance() -> None:
    clock = Clock()
    detector = HangDetector(clock)
    detector.observe(trained(5))
    assert not clock.pass_by(detector, STAGE_LIMITS_S["train"] / 2)
    detector.observe(trained(5))
    assert clock.pass_by(detector, STAGE_LIMITS_S["train"] / 2 + 1)
    detector.observe(trained(6))
    assert not detector.is_hung()


@pytest.mark.parametrize("stage", [*STAGE_LIMITS_S, "of another version"])
def test_every_stage_has_its_own_limit(stage: str) -> None:
    clock = Clock()
    detector = HangDetector(clock)
    detector.observe(JobProgress(stage=stage, fraction=0.5))
    limit_s = STAGE_LIMITS_S.get(stage, OTHER_LIMIT_S)
    assert not clock.pass_by(detector, limit_s - 1)
    assert clock.pass_by(detector, 2)


def test_time_in_which_the_supervisor_itself_was_stopped_is_not_held_against_the_job() -> None:
    clock = Clock()
    detector = HangDetector(clock)
    detector.observe(trained(1))
    clock.now_s += 3600
    assert not detector.is_hung()
    assert clock.pass_by(detector, STAGE_LIMITS_S["train"] - MAX_LOOK_S + 1)


def test_a_job_without_a_core_starves_and_does_not_hang_for_ten_times_the_limit() -> None:
    clock, limit_s = Clock(), STAGE_LIMITS_S["stereo"]
    detector = HangDetector(clock, lambda: 0.95 * clock.now_s)
    detector.observe(JobProgress(stage="stereo", fraction=0.5))
    assert not clock.pass_by(detector, STARVED_FACTOR * limit_s - 1)
    assert clock.pass_by(detector, 2)


def test_progress_holds_only_numbers_that_json_can() -> None:
    odd = Progress("train", 1.5, psnr_db=float("nan"), psnr_right_db=float("-inf"), seconds_left=float("inf"))
    assert job_progress(odd) == JobProgress(stage="train", fraction=1.0)
    both = Progress("train", 0.5, psnr_db=30.0, psnr_right_db=28.0)
    assert job_progress(both) == JobProgress(stage="train", fraction=0.5, psnr_db=30.0, psnr_right_db=28.0)


def test_a_reconstruction_from_stereo_advances_with_every_frame_and_knows_no_stage_without_a_limit(
    tmp_path: Path,
) -> None:
    frames = 10
    write_stereo_video(make_phantom(PhantomSettings(width=192, height=160, frames=frames)), tmp_path / "clip")
    told: list[Progress] = []
    request = ReconstructionRequest(tmp_path / "clip", ReconstructionOptions(iterations=5))
    report = reconstruct(request, tmp_path / "out", TrainingHooks(on_progress=told.append))
    (scored,) = (each for each in told if each.stage == "score" and each.fraction == 1.0)
    assert (scored.psnr_db, scored.psnr_right_db) == (report.psnr_tissue_db, report.psnr_right_db)
    assert None not in (scored.psnr_db, scored.psnr_right_db)
    places = {stage: {each.fraction for each in told if each.stage == stage} for stage in STAGE_LIMITS_S}
    assert {each.stage for each in told} <= set(STAGE_LIMITS_S)
    assert len(places["stereo"]) >= frames
    assert len(places["motion"]) >= frames / 2 - 2  # in two halves side by side, less what is held out
    assert len(places["score"]) >= 3


def test_finding_instruments_in_a_clip_with_depth_advances_with_every_frame(tmp_path: Path) -> None:
    frames = 4
    write_endonerf(make_phantom(PhantomSettings(width=64, height=48, frames=frames)), tmp_path / "clip", masks=False)
    told: list[Progress] = []
    options = ReconstructionOptions(holdout="none", mask_source="auto")
    open_with_depth(ClipPaths(tmp_path / "clip"), options, Hooks(on_progress=told.append), Timings())
    assert {each.stage for each in told} <= set(STAGE_LIMITS_S)
    assert sorted({each.fraction for each in told if each.stage == "masks"}) == [0.0, 0.25, 0.5, 0.75, 1.0]
