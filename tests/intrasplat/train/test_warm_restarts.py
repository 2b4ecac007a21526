"""Training by its schedule: an average ends a cycle, validation frames score it, early stopping ends the run."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from intrasplat.clip import DepthClip, FrameSplit, split_frames
from intrasplat.errors import Cancelled
from intrasplat.machine.timing import Stopwatch
from intrasplat.methods.registry import PRESETS
from intrasplat.options import ReconstructionOptions
from intrasplat.outcome import snapshot_of
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.splat.model import Model
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.prepare import prepare
from intrasplat.train.run import Run, frames_at
from intrasplat.train.schedule import AVERAGED, Schedule, validation_frames
from intrasplat.train.scoring import HeldOutScore
from intrasplat.train.setup import Setup
from intrasplat.train.targets import TrainingFrames
from tests.intrasplat.phantoms import bits, keep, kept, phantom_clip, prepared_on, trained

MIN_CYCLE, PLANNED = 24, 192
"""Cycles that end at 24, 48, 96 and 192."""
NEVER_ENOUGH_DB, ALWAYS_ENOUGH_DB = 1000.0, -1000.0
STOPPED_AT, CLOSED_AT = 48, 60


@pytest.fixture(scope="module", autouse=True)
def short_cycles() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("intrasplat.train.schedule.MIN_CYCLE_ITERATIONS", MIN_CYCLE)
        yield


@pytest.fixture(scope="module")
def clip() -> DepthClip:
    return phantom_clip(frames=34, width=64, height=48)


@pytest.fixture(scope="module")
def split(clip: DepthClip) -> FrameSplit:
    found = split_frames(clip, "every8")
    assert len(validation_frames(found.train)) == 2
    return found


def validated(clip: DepthClip, split: FrameSplit, min_gain_db: float | None = NEVER_ENOUGH_DB) -> Run:
    """A run of `fast` before its first step with validation frames, though its length is given."""
    run = prepared_on(clip, split, "fast", iterations=PLANNED)
    run.schedule = Schedule(PLANNED, warm_restarts=True, min_gain_db=min_gain_db)
    return run


@pytest.fixture(scope="module")
def straight(clip: DepthClip, split: FrameSplit) -> Run:
    """A run that ended early, to be read."""
    return trained(validated(clip, split))


@pytest.fixture(scope="module")
def untrained(clip: DepthClip, split: FrameSplit) -> Run:
    """A run of which the tests change seed, frames and schedule before they look, and nothing else."""
    return validated(clip, split)


def until(iteration: int, run: Run) -> Run:
    """The run stopped after an iteration, to go on later."""
    with pytest.raises(Cancelled):
        trained(run, TrainingHooks(should_stop=lambda: run.iteration == iteration))
    return run


def copied(model: Model) -> dict[str, np.ndarray]:
    return {name: values.numpy().copy() for name, values in model.parameters().items()}


def poisoned(clip: DepthClip, frames: list[int], rng: np.random.Generator) -> DepthClip:
    """The clip with noise for these frames."""
    layers = ("rgb", "tissue", "depth_mm", "depth_confidence")
    spoilt = dataclasses.replace(clip, **{layer: getattr(clip, layer).copy() for layer in layers})
    shape = spoilt.tissue[frames].shape
    spoilt.rgb[frames] = rng.integers(0, 256, (*shape, 3))
    spoilt.tissue[frames] = rng.random(shape) < 0.5
    spoilt.depth_mm[frames] = rng.uniform(1, 500, shape)
    spoilt.depth_confidence[frames] = rng.integers(0, 256, shape)
    return spoilt


def test_a_run_whose_doubling_gains_too_little_ends_early_and_says_so(clip: DepthClip, split: FrameSplit) -> None:
    run = validated(clip, split)
    train(run, Stopwatch(), lambda: HeldOutScore(31.5, math.nan), TrainingHooks())
    assert run.schedule.stopped_at == STOPPED_AT
    assert run.iteration == run.iterations == CLOSED_AT
    assert [point.iteration for point in run.curve if point.iteration in run.schedule.ends] == [24, 48, 60]
    assert len(run.schedule.notices) == 1
    assert f"after {CLOSED_AT} of {PLANNED} iterations" in run.schedule.notices[0].text


def test_a_run_whose_doublings_gain_enough_goes_on_as_planned(clip: DepthClip, split: FrameSplit) -> None:
    run = trained(validated(clip, split, ALWAYS_ENOUGH_DB))
    assert run.iteration == PLANNED
    assert len(run.schedule.scores) == 3
    assert run.schedule.notices == ()


def test_a_score_is_how_near_the_finished_model_is_to_the_validation_frames(clip: DepthClip, split: FrameSplit) -> None:
    run = until(MIN_CYCLE, validated(clip, split))
    scores = []
    for index in validation_frames(split.train):
        image = run.model.render(run.frames.cameras[index], float(clip.t[index]))[:3].transpose(1, 2, 0)
        scores.append(psnr_tissue(image, clip.rgb[index], clip.tissue[index]))
    assert list(run.schedule.scores) == pytest.approx([float(np.mean(scores))])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [28, 47, 63, 64, 83, 84, 131, 200])
def test_validation_frames_are_not_shown_before_the_decision_and_are_after_it(
    untrained: Run, count: int, seed: int
) -> None:
    """Of clips of any length: which frame an iteration shows depends on how many there are alone."""
    options = ReconstructionOptions(seed=seed)
    run = dataclasses.replace(untrained, setup=dataclasses.replace(untrained.setup, options=options))
    run.frames.indices = list(range(count))
    planned = Schedule(24 * count + seed, warm_restarts=True, min_gain_db=NEVER_ENOUGH_DB, epoch=count)
    run.schedule = planned.with_score(30.0).with_score(30.0)
    stopped_at, judges = run.schedule.stopped_at, set(validation_frames(range(count)))
    assert stopped_at is not None
    before = [frames_at(run, iteration)[0] for iteration in range(1, stopped_at + 1)]
    assert set(before) == set(range(count)) - judges
    closing = {frames_at(run, iteration)[0] for iteration in range(stopped_at + 1, run.iterations + 1)}
    assert closing == set(range(count))
    run.schedule = planned
    assert before == [frames_at(run, iteration)[0] for iteration in range(1, stopped_at + 1)]


def test_what_validation_frames_show_trains_nothing_until_the_decision(
    clip: DepthClip, split: FrameSplit, rng: np.random.Generator
) -> None:
    """Where a model starts is settled on every training frame; so only what is trained on is spoilt."""
    runs = validated(clip, split), validated(clip, split)
    spoilt = poisoned(clip, list(validation_frames(split.train)), rng)
    runs[1].frames = TrainingFrames(spoilt, split.train, runs[1].frames.scale)
    decided = [bits(until(STOPPED_AT, run)) for run in runs]
    for each in decided:
        del each["seen"]  # measured on all training frames
    assert decided[0] == decided[1]
    assert runs[0].schedule.scores != runs[1].schedule.scores
    for run in runs:  # so short a closing cycle might not come to them
        run.schedule = Schedule(PLANNED, warm_restarts=True)
    ended = [bits(trained(run)) for run in runs]
    assert ended[0] != ended[1]


@pytest.mark.parametrize(("without_tissue", "ends_at"), [(1, CLOSED_AT), (2, PLANNED)])
def test_frames_without_tissue_decide_nothing(
    clip: DepthClip, split: FrameSplit, without_tissue: int, ends_at: int
) -> None:
    tissue = clip.tissue.copy()
    tissue[list(validation_frames(split.train)[:without_tissue])] = False
    assert trained(validated(dataclasses.replace(clip, tissue=tissue), split)).iteration == ends_at


def test_held_out_frames_do_not_decide_when_a_run_ends(
    straight: Run, clip: DepthClip, split: FrameSplit, rng: np.random.Generator
) -> None:
    spoilt = poisoned(clip, split.held_out, rng)
    for score in (10.0, 50.0):
        run = validated(spoilt, split)
        train(run, Stopwatch(), lambda score=score: HeldOutScore(score, math.nan), TrainingHooks())  # type: ignore[misc]
        assert run.schedule == straight.schedule
        assert bits(run) == bits(straight)


@pytest.mark.parametrize(
    "stopped_after",
    [
        7,  # in the first cycle
        MIN_CYCLE - AVERAGED + 2,  # some of the models averaged are made
        MIN_CYCLE,  # averaged and scored
        MIN_CYCLE + 9,
        STOPPED_AT - 1,  # one model is missing
        STOPPED_AT,  # decided
        STOPPED_AT + 4,  # closing
        CLOSED_AT - 2,  # averaging again
    ],
)
def test_a_validated_run_goes_on_to_the_bits_of_an_unstopped_one(
    straight: Run, clip: DepthClip, split: FrameSplit, stopped_after: int, tmp_path: Path
) -> None:
    keep(tmp_path, until(stopped_after, validated(clip, split)))
    again = kept(tmp_path, validated(clip, split))
    assert again.iteration == stopped_after
    assert bits(trained(again)) == bits(straight)
    assert again.schedule == straight.schedule


def test_a_cycle_ends_with_the_mean_of_its_last_models(clip: DepthClip, split: FrameSplit) -> None:
    run, models = validated(clip, split, None), []
    for iteration in range(MIN_CYCLE - AVERAGED + 1, MIN_CYCLE):
        models.append(copied(until(iteration, run).model))
    alone = prepared_on(
        clip, split, dataclasses.replace(PRESETS["fast"], warm_restarts=False, min_gain_db=None), iterations=MIN_CYCLE
    )
    models.append(copied(trained(alone).model))  # the same steps, and nothing averaged
    averaged = copied(until(MIN_CYCLE, run).model)
    for name, values in averaged.items():
        expected = np.mean([model[name] for model in models], axis=0, dtype=np.float64)
        np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5, err_msg=name)
    assert not np.array_equal(averaged["motion.weight"], models[-1]["motion.weight"])


@pytest.mark.parametrize("min_gain_db", [NEVER_ENOUGH_DB, ALWAYS_ENOUGH_DB])
def test_the_schedule_that_a_scene_names_makes_the_same_steps_again(
    clip: DepthClip, split: FrameSplit, min_gain_db: float
) -> None:
    run = trained(validated(clip, split, min_gain_db))
    settings = json.dumps(snapshot_of(run).settings, allow_nan=False)
    again = prepared_on(clip, split, "fast", iterations=1)
    again.schedule = Schedule.of(json.loads(settings)["schedule"])
    assert bits(trained(again)) == bits(run)
    assert again.iteration == run.iteration


def prepared_for(clip: DepthClip, split: FrameSplit, **length: float) -> Run:
    options = ReconstructionOptions(**length)  # type: ignore[arg-type]
    return prepare(Setup(clip, split, PRESETS["fast"], options))


def test_only_a_run_that_is_given_time_may_end_before_it(clip: DepthClip, split: FrameSplit) -> None:
    assert prepared_for(clip, split, iterations=PLANNED).schedule.min_gain_db is None
    assert prepared_for(clip, split, budget_s=0.01).schedule.min_gain_db == PRESETS["fast"].min_gain_db
    few = phantom_clip()
    assert prepared_for(few, split_frames(few, "every8"), budget_s=0.01).schedule.min_gain_db is None


class StepClock:
    """A clock by which each iteration takes a second; it is read, and paused, as a Stopwatch is."""

    def __init__(self, run: Run) -> None:
        self.run = run

    @property
    def elapsed_s(self) -> float:
        return float(self.run.iteration)

    def paused(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()


@pytest.mark.parametrize(("budget_s", "made"), [(150.0, 150), (230.0, 230), (1000.0, 288), (10.0, 144)])
def test_the_last_cycle_takes_the_time_that_is_left(
    clip: DepthClip, split: FrameSplit, budget_s: float, made: int
) -> None:
    """Planned are 192 iterations; the last cycle, from 96 on, may have half or twice its 96."""
    run = validated(clip, split, ALWAYS_ENOUGH_DB)
    run.setup = dataclasses.replace(run.setup, options=ReconstructionOptions(budget_s=budget_s))
    clock = cast("Stopwatch", StepClock(run))
    train(run, clock, lambda: HeldOutScore(math.nan, math.nan), TrainingHooks())
    assert run.iteration == made
    assert run.schedule.planned == PLANNED
