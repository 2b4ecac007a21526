"""The loop's promises: the same bits again, also after a stop; held-out frames without influence; no silent NaN."""

from __future__ import annotations

import csv
import dataclasses
import math
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from intrasplat.clip import DepthClip, split_frames
from intrasplat.errors import Cancelled, ResumeMismatch, TrainingDiverged
from intrasplat.machine.hooks import Progress
from intrasplat.machine.timing import Stopwatch
from intrasplat.methods.method import DensifySettings, Preset
from intrasplat.methods.registry import PRESETS
from intrasplat.notices import NoticeCode
from intrasplat.outcome import snapshot_of, training_of
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.splat.optimize import Rate
from intrasplat.train.calibrate import GROWTH_ALLOWANCE, TIMED_STEPS, UNTIMED_STEPS, measured_schedule
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.resume import resume
from intrasplat.train.run import CurvePoint, Run, frames_at, write_curve
from intrasplat.train.schedule import Schedule
from intrasplat.train.scoring import HeldOutScore
from tests.intrasplat.phantoms import bits, keep, kept, phantom_clip, prepared, prepared_on, trained, view

SOON = DensifySettings(from_iteration=6, every=6, gradient_threshold=1e-5)
"""Splits early enough to happen in these short runs; so does splitting_soon add harmonics."""
ITERATIONS, STOPPED_AFTER = 24, 11


def splitting_soon(name: str) -> Preset:
    preset = PRESETS[name]
    return dataclasses.replace(preset, densify=SOON, sh_every=7) if preset.densify else preset


def stopping_after(iterations: int) -> TrainingHooks:
    """TrainingHooks that ask to stop once so many iterations are made."""
    asked = 0

    def should_stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > iterations

    return TrainingHooks(should_stop=should_stop)


def run_bits(clip: DepthClip, preset: Preset, *, iterations: int = ITERATIONS, seed: int = 0) -> dict[str, bytes]:
    run, _ = prepared(clip, preset, iterations=iterations, seed=seed)
    return bits(trained(run))


@cache
def straight_bits(name: str) -> dict[str, bytes]:
    """What an unstopped run of this preset makes."""
    return run_bits(phantom_clip(), splitting_soon(name))


@pytest.mark.parametrize("name", PRESETS)
def test_the_same_seed_gives_the_same_bits_and_another_seed_others(name: str) -> None:
    clip, preset = phantom_clip(), splitting_soon(name)
    assert run_bits(clip, preset) == straight_bits(name)
    assert run_bits(clip, preset, seed=1) != straight_bits(name)


@pytest.mark.parametrize("name", PRESETS)
def test_a_stopped_run_goes_on_to_the_bits_of_an_unstopped_one(name: str, tmp_path: Path) -> None:
    clip, preset = phantom_clip(), splitting_soon(name)
    run, _ = prepared(clip, preset, iterations=ITERATIONS)
    count = run.model.count
    with pytest.raises(Cancelled):
        trained(run, stopping_after(STOPPED_AFTER))
    assert run.iteration == STOPPED_AFTER
    assert preset.densify is None or run.model.count > count  # the stored model is larger than a fresh one
    keep(tmp_path, run, 1.5)
    again = kept(tmp_path, prepared(clip, preset, iterations=ITERATIONS)[0])
    assert again.setup.clock.elapsed_s >= 1.5
    assert bits(trained(again)) == straight_bits(name)


@pytest.mark.parametrize("name", PRESETS)
def test_held_out_frames_change_nothing_in_a_trained_model(name: str, rng: np.random.Generator) -> None:
    clip, preset = phantom_clip(frames=18), splitting_soon(name)
    split = split_frames(clip, "every8")
    assert len(split.held_out) == 3
    poisoned = dataclasses.replace(
        clip, **{layer: getattr(clip, layer).copy() for layer in ("rgb", "tissue", "depth_mm", "depth_confidence")}
    )
    shape = poisoned.tissue[split.held_out].shape
    poisoned.rgb[split.held_out] = rng.integers(0, 256, (*shape, 3))
    poisoned.tissue[split.held_out] = rng.random(shape) < 0.5
    poisoned.depth_mm[split.held_out] = rng.uniform(1, 500, shape)
    poisoned.depth_confidence[split.held_out] = rng.integers(0, 256, shape)
    clean_run = trained(prepared_on(clip, split, preset, iterations=ITERATIONS))
    poisoned_run = trained(prepared_on(poisoned, split, preset, iterations=ITERATIONS))
    assert bits(poisoned_run) == bits(clean_run)


@pytest.mark.parametrize("name", PRESETS)
def test_training_brings_the_model_nearer_to_its_frames(name: str) -> None:
    clip = phantom_clip()
    run, split = prepared(clip, name, iterations=40)

    def fit_db() -> float:
        return float(np.mean([psnr_tissue(view(run, i).rgb, clip.rgb[i], clip.tissue[i]) for i in split.train]))

    before_db = fit_db()
    trained(run)
    assert fit_db() > before_db + 1


def test_an_epoch_shows_every_frame_once_in_another_order_each_time() -> None:
    run, split = prepared(phantom_clip(), "fast")
    count = len(split.train)
    epochs = [[frames_at(run, epoch * count + place + 1)[0] for place in range(count)] for epoch in range(3)]
    assert all(sorted(epoch) == split.train for epoch in epochs)
    assert epochs[0] != epochs[1]


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_blurred_frames_are_drawn_as_often_as_they_weigh(preset: str) -> None:
    run, split = prepared(phantom_clip(), preset)
    first, second, *others = split.train
    run.setup = dataclasses.replace(run.setup, split=dataclasses.replace(split, weights={first: 0.0, second: 0.3}))
    epochs = 200
    drawn = [frames_at(run, iteration)[0] for iteration in range(1, epochs * len(split.train))]
    often = drawn.count(others[0])
    assert first not in drawn
    assert drawn.count(second) == pytest.approx(0.3 * often, rel=0.05 if preset == "fast" else 0.4)
    if preset == "fast":
        assert len({drawn.count(each) for each in others}) <= 2


def test_random_order_draws_training_frames_alone() -> None:
    run, split = prepared(phantom_clip(), "paper")
    drawn = [frames_at(run, iteration)[0] for iteration in range(1, 400)]
    assert set(drawn) == set(split.train)
    assert drawn == [frames_at(run, iteration)[0] for iteration in range(1, 400)]


@pytest.mark.parametrize("frames_a_step", [2, 5, 16])
def test_frames_are_seen_in_one_order_however_many_make_a_step(frames_a_step: int) -> None:
    run, _ = prepared(phantom_clip(), "fast")
    one_by_one = [frames_at(run, iteration)[0] for iteration in range(1, 1 + 4 * frames_a_step)]
    run.preset = dataclasses.replace(run.preset, frames_a_step=frames_a_step)
    steps = [frames_at(run, iteration) for iteration in range(1, 5)]
    assert {len(step) for step in steps} == {frames_a_step}
    assert [index for step in steps for index in step] == one_by_one


@pytest.mark.parametrize("name", ["fast", "paper", "hexplane"])
def test_steps_on_several_frames_keep_their_bits_over_a_stop(name: str, tmp_path: Path) -> None:
    clip, preset = phantom_clip(), dataclasses.replace(splitting_soon(name), frames_a_step=3)
    whole, _ = prepared(clip, preset, iterations=9)
    stopped, _ = prepared(clip, preset, iterations=9)
    with pytest.raises(Cancelled):
        trained(stopped, stopping_after(4))
    keep(tmp_path, stopped)
    again = kept(tmp_path, prepared(clip, preset, iterations=9)[0])
    assert again.frames_seen == 12
    assert bits(trained(again)) == bits(trained(whole))
    with pytest.raises(ResumeMismatch, match="another settings of the preset"):
        kept(tmp_path, prepared(clip, splitting_soon(name), iterations=9)[0])


def test_the_curve_tells_iterations_and_the_frames_they_saw(tmp_path: Path) -> None:
    preset = dataclasses.replace(PRESETS["fast"], frames_a_step=2)
    run, split = prepared(phantom_clip(), preset, iterations=5)
    assert run.schedule.epoch == -(-len(split.train) // 2)
    train(run, Stopwatch(), lambda: HeldOutScore(31.5, math.nan), TrainingHooks())
    write_curve(tmp_path / "curve.csv", run)
    with (tmp_path / "curve.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["iteration"], row["frames_seen"], row["psnr_tissue_db"]) == ("5", "10", "31.5000")
    assert 0 < float(row["t_post_s"]) < time.time() - run.setup.accepted_at_s + 1e-3  # it is rounded


def after_seconds(run: Run, elapsed_s: float) -> Run:
    """The run with so much on its clock."""
    return dataclasses.replace(run, setup=dataclasses.replace(run.setup, clock=SimpleNamespace(elapsed_s=elapsed_s)))


def test_a_budget_allows_what_is_left_of_it_over_the_median_step(monkeypatch: pytest.MonkeyPatch) -> None:
    untimed, timed, step_s = UNTIMED_STEPS, TIMED_STEPS, 0.02
    steps_s = [0.9] * untimed + [step_s] * (timed - 2) + [step_s / 2, 3.0]
    for budget_s, more in ((10.0, 1), (61.0, 1), (1.0, 0)):
        run, split = prepared(phantom_clip(), "fast")
        clock = iter(np.cumsum([0.0, *steps_s]).tolist())
        monkeypatch.setattr(
            "intrasplat.train.calibrate.time", SimpleNamespace(perf_counter=lambda clock=clock: next(clock))
        )
        schedule = measured_schedule(after_seconds(run, 1.0), budget_s)
        fit = untimed + timed + int((budget_s - 1.0) / (GROWTH_ALLOWANCE * step_s))
        assert schedule.planned == (fit if more else max(len(split.train), untimed + timed))


@pytest.mark.parametrize("name", ["fast", "hexplane"])
def test_the_steps_that_tell_the_length_of_a_run_are_its_first(name: str) -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, name)
    run.schedule = dataclasses.replace(measured_schedule(run, 1e-9), planned=ITERATIONS)
    assert run.iteration == run.schedule.opening == UNTIMED_STEPS + TIMED_STEPS
    again, _ = prepared(clip, name)
    again.schedule = Schedule.of(run.schedule.settings)
    assert bits(trained(run)) == bits(trained(again))


def spoil(run: Run) -> None:
    run.model.canonical[10, 5] = math.nan


def explode(run: Run) -> None:
    run.preset = dataclasses.replace(run.preset, rates=dataclasses.replace(run.preset.rates, mean=Rate(1e30)))


def lose_one(run: Run) -> None:
    """A Gaussian whose place is no number is not drawn: the loss stays finite."""
    run.model.canonical[0, 5] = math.nan


@pytest.mark.parametrize("break_it", [spoil, explode, lose_one])
@pytest.mark.parametrize("name", ["fast", "hexplane"])
def test_training_that_leaves_the_numbers_is_an_error(name: str, break_it: Callable[[Run], None]) -> None:
    run, _ = prepared(phantom_clip(), name)
    break_it(run)
    with np.errstate(all="ignore"), pytest.raises(TrainingDiverged):
        trained(run)


def test_a_stop_before_the_first_step_makes_none() -> None:
    run, _ = prepared(phantom_clip())
    with pytest.raises(Cancelled, match="iteration 0 of 20"):
        trained(run, TrainingHooks(should_stop=lambda: True))
    assert run.iteration == 0


def test_the_last_iteration_is_scored_and_reported() -> None:
    run, _ = prepared(phantom_clip(), iterations=5)
    told: list[Progress] = []
    train(run, Stopwatch(), lambda: HeldOutScore(31.5, 28.5), TrainingHooks(on_progress=told.append))
    assert [(each.iteration, each.psnr_tissue_db, each.psnr_right_db) for each in run.curve] == [(5, 31.5, 28.5)]
    assert run.progress("score", 0.5) == Progress("score", 0.5, 5, 5, psnr_db=31.5, psnr_right_db=28.5)
    assert told
    assert all(each.stage == "train" and 0 <= each.fraction <= 1 and each.iterations == 5 for each in told)


@pytest.mark.parametrize(("step_s", "iterations"), [(1.0, 500), (3.0, 450)])
def test_the_time_left_foresees_that_the_last_cycle_is_fitted_to_the_budget(
    step_s: float, iterations: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, _ = prepared(phantom_clip())
    options = run.setup.options.model_copy(update={"iterations": None, "budget_s": 500.0})
    run.setup = dataclasses.replace(run.setup, options=options)
    run.schedule = Schedule(planned=600, warm_restarts=True)

    class SlowSteps(Stopwatch):
        """Equal seconds a step."""

        @property
        def elapsed_s(self) -> float:
            return step_s * run.iteration

    def advance(run: Run) -> int:
        run.iteration += 1
        return run.iteration

    monkeypatch.setattr("intrasplat.train.loop._advance", advance)
    reported: list[Progress] = []
    train(run, SlowSteps(), lambda: HeldOutScore(31.5, math.nan), TrainingHooks(on_progress=reported.append))
    ends_s = [step_s * each.iteration + each.seconds_left for each in reported if each.seconds_left is not None]
    assert run.iterations == iterations
    assert len(ends_s) > 400
    assert ends_s == pytest.approx([step_s * iterations] * len(ends_s))


def test_without_held_out_frames_there_is_no_curve() -> None:
    run, _ = prepared(phantom_clip(), iterations=3)
    assert trained(run).curve == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"preset": "paper-wide"}, "another preset"),
        ({"preset": dataclasses.replace(PRESETS["paper"], opacity=0.2)}, "another settings of the preset"),
        ({"seed": 3}, "another seed"),
        ({"iterations": 9}, "another length"),
        ({"holdout": "1,2,9"}, "another clip"),
    ],
)
def test_a_run_goes_on_only_with_what_it_was_started_with(change: dict[str, object], said: str, tmp_path: Path) -> None:
    started: dict[str, object] = {"preset": "paper", "iterations": 8, "seed": 0, "holdout": "every8"}
    keep(tmp_path, prepared(phantom_clip(), **started)[0])  # type: ignore[arg-type]
    other, _ = prepared(phantom_clip(), **(started | change))  # type: ignore[arg-type]
    with pytest.raises(ResumeMismatch, match=said):
        kept(tmp_path, other)


def test_a_run_does_not_go_on_with_another_clip(tmp_path: Path) -> None:
    keep(tmp_path, prepared(phantom_clip("breathing"), "fast")[0])
    with pytest.raises(ResumeMismatch, match="another clip"):
        kept(tmp_path, prepared(phantom_clip("pull"), "fast")[0])
    assert resume(tmp_path / "nothing", prepared(phantom_clip(), "fast")[0].setup) is None


def test_a_scene_says_that_its_motion_was_not_followed_also_after_a_stop(tmp_path: Path) -> None:
    clip = phantom_clip()
    first = prepared(clip)[0]
    first.motion_error = None
    assert "motion_error" not in snapshot_of(first).settings
    first.motion_error = 500.0
    keep(tmp_path, first)
    again = kept(tmp_path, prepared(clip)[0])
    scene = snapshot_of(again)
    assert scene.motion_error == 500.0
    assert NoticeCode.MOTION_GUESSED in {each.code for each in training_of(again, scene, None).warnings}


def test_stills_too_far_apart_are_not_followed() -> None:
    clip = phantom_clip("breathing")
    order = np.random.default_rng(3).permutation(clip.frame_count)
    names = ("rgb", "tissue", "depth_mm", "depth_confidence")
    shuffled = dataclasses.replace(clip, **{name: getattr(clip, name)[order] for name in names})
    assert (prepared(shuffled)[0].motion_error or 0) > 500


def test_the_curve_is_kept_over_a_stop(tmp_path: Path) -> None:
    run, _ = prepared(phantom_clip())
    run.curve.append(CurvePoint(1.25, 7, 30.5, t_post_s=4.5))
    keep(tmp_path, run)
    again = kept(tmp_path, prepared(phantom_clip())[0])
    assert again.curve == run.curve
