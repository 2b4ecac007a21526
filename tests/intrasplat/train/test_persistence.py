"""What a killed run goes on from is whole at any time, and leads to the bits of an unstopped run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from intrasplat.errors import Cancelled, InputError
from intrasplat.machine.hooks import Progress
from intrasplat.methods.registry import PRESETS
from intrasplat.names import PREPARED, RESUME_STATE
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import make
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.resume_file import RESUME_FILE, load_resume
from intrasplat.scene.scene import TrainedScene
from intrasplat.train import persistence
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from lab.phantom import PhantomSettings, make_phantom, write_stereo_video

ITERATIONS = 12
WATCHED_ITERATIONS = 60
"""Of a run that is to be looked at while it is being kept: steps are quicker than what keeps them."""


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a stereo video, its calibration and masks."""
    folder = tmp_path_factory.mktemp("clip")
    write_stereo_video(make_phantom(PhantomSettings(width=96, height=80, frames=10, period_frames=12)), folder)
    return folder


def request_of(clip: Path, preset: str = "fast", iterations: int = ITERATIONS) -> ReconstructionRequest:
    return ReconstructionRequest(
        clip / "stereo.webm",
        ReconstructionOptions(iterations=iterations),
        calibration=clip / "calibration.json",
        masks=clip / "masks.zip",
        own_preset=PRESETS[preset],
    )


def bits(folder: Path) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in load_scene(folder).tensors().items()}


class Stages:
    """Hooks that note the stages, and look at the kept folder at every report as another process would find it."""

    def __init__(self, look: Callable[[Progress], None] = lambda progress: None) -> None:
        self.seen: list[str] = []
        self._look = look
        self.hooks = TrainingHooks(on_progress=self._note)

    def _note(self, progress: Progress) -> None:
        if progress.stage not in self.seen:
            self.seen.append(progress.stage)
        self._look(progress)


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_a_run_killed_at_any_time_goes_on_to_the_bits_of_an_unstopped_one(
    preset: str, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(persistence, "PERIOD_S", 0.0)
    monkeypatch.setattr(persistence, "MAX_SHARE", 1e9)
    monkeypatch.setattr("intrasplat.train.loop.REPORT_EVERY_S", 0.0)
    found: dict[int, Path] = {}

    def copy(progress: Progress) -> None:
        """Set aside what a process that dies now would leave."""
        left, aside = tmp_path / "kept", tmp_path / f"left-{len(found)}"
        if (left / RESUME_FILE).exists() and (left / PREPARED / "manifest.json").exists():
            aside.mkdir(exist_ok=True)
            (aside / RESUME_FILE).unlink(missing_ok=True)
            os.link(left / RESUME_FILE, aside / RESUME_FILE)
            iteration = load_resume(aside)[1]["iteration"]
            if iteration not in found:
                shutil.copytree(left / PREPARED, aside / PREPARED)
                found[iteration] = aside

    asked = request_of(clip, preset, WATCHED_ITERATIONS)
    make(asked, tmp_path / "whole", Stages(copy).hooks, tmp_path / "kept")
    copy(Progress("", 1.0))
    assert min(found) < WATCHED_ITERATIONS // 2
    assert max(found) == WATCHED_ITERATIONS
    assert len(found) >= 3
    moments = sorted(found)
    for iteration in (moments[0], moments[len(moments) // 2], moments[-1]):
        left, again = found[iteration], Stages()
        make(asked, tmp_path / f"from-{iteration}", again.hooks, left)
        assert bits(tmp_path / f"from-{iteration}") == bits(tmp_path / "whole"), iteration
        assert not {"decode", "stereo", "motion", "fusion", "start"} & set(again.seen)


def test_a_long_clips_run_keeps_no_first_moments_and_goes_on_to_the_same_bits(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("intrasplat.methods.method.USUAL_BASES", 1)  # what a long clip has more of
    monkeypatch.setattr(persistence, "PERIOD_S", 0.0)
    monkeypatch.setattr(persistence, "MAX_SHARE", 1e9)
    monkeypatch.setattr("intrasplat.train.average.LARGE_BYTES", 1 << 12)
    monkeypatch.setattr("intrasplat.scene.resume_file._AT_MOST_BYTES", 1 << 12)

    def stop(progress: Progress) -> None:
        if progress.stage == "train" and progress.iteration >= ITERATIONS // 2:
            raise Cancelled("enough")

    monkeypatch.setattr("intrasplat.train.loop.REPORT_EVERY_S", 0.0)
    asked = request_of(clip)
    with pytest.raises(Cancelled):
        make(asked, tmp_path / "again", Stages(stop).hooks, tmp_path / "kept")
    stored = load_resume(tmp_path / "kept")[0]
    assert "motion.second" in stored
    assert "motion.first" not in stored
    make(asked, tmp_path / "again", TrainingHooks(), tmp_path / "kept")
    make(asked, tmp_path / "whole", TrainingHooks())
    assert bits(tmp_path / "again") == bits(tmp_path / "whole")


def test_what_is_kept_stays_until_its_owner_removes_it_and_an_own_folder_is_left_clean(
    clip: Path, tmp_path: Path
) -> None:
    make(request_of(clip), tmp_path / "scene", TrainingHooks(), tmp_path / "kept")
    assert {path.name for path in (tmp_path / "kept").iterdir()} == set(RESUME_STATE)
    make(request_of(clip), tmp_path / "own", TrainingHooks())
    assert not set(RESUME_STATE) & {path.name for path in (tmp_path / "own").iterdir()}
    assert bits(tmp_path / "own") == bits(tmp_path / "scene")


def test_an_attempt_on_a_kept_clip_shows_a_first_picture_too(clip: Path, tmp_path: Path) -> None:
    first = make(request_of(clip), tmp_path / "first", TrainingHooks(), tmp_path / "kept")
    shown: list[TrainedScene] = []
    hooks = TrainingHooks(on_first_picture=shown.append)
    again = make(request_of(clip), tmp_path / "again", hooks, tmp_path / "kept")
    assert [scene.preset for scene in shown] == ["first picture"]
    assert again.report.seconds["t_first_view_s"] == first.report.seconds["t_first_view_s"], "it had been seen before"


def test_a_file_that_has_changed_is_decoded_anew(clip: Path, tmp_path: Path) -> None:
    own = Path(shutil.copytree(clip, tmp_path / "clip"))
    asked = request_of(own)
    make(asked, tmp_path / "first", TrainingHooks(), tmp_path / "kept")
    os.utime(own / "masks.zip", ns=(0, 0))
    again = Stages()
    make(asked, tmp_path / "again", again.hooks, tmp_path / "kept")
    assert "decode" in again.seen
    assert "start" not in again.seen  # the frames are the same: training goes on
    assert bits(tmp_path / "again") == bits(tmp_path / "first")


def test_a_full_disk_costs_what_would_have_been_kept_and_not_the_run(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(persistence, "SPARE_BYTES", 1 << 62)
    make(request_of(clip), tmp_path / "scene", TrainingHooks(), tmp_path / "kept")
    assert list((tmp_path / "kept").iterdir()) == []
    assert bits(tmp_path / "scene")


def test_an_error_leaves_what_an_earlier_run_has_kept(clip: Path, tmp_path: Path) -> None:
    stop = Stages()
    hooks = TrainingHooks(stop.hooks.on_progress, lambda: "train" in stop.seen)
    with pytest.raises(Cancelled):
        make(request_of(clip), tmp_path, hooks)
    state = (tmp_path / RESUME_FILE).read_bytes()
    with pytest.raises(InputError):
        make(request_of(tmp_path / "no clip"), tmp_path, TrainingHooks())
    with pytest.raises(InputError, match="another length"):
        make(request_of(clip, iterations=ITERATIONS + 1), tmp_path, TrainingHooks())
    assert (tmp_path / RESUME_FILE).read_bytes() == state
    assert not (tmp_path / PREPARED / "manifest.json").exists()  # of the request that did not fit


def test_a_stop_before_training_leaves_nothing_but_what_goes_on(clip: Path, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        make(request_of(clip), tmp_path, TrainingHooks(should_stop=lambda: True))
    assert {path.name for path in tmp_path.iterdir()} <= set(RESUME_STATE)
