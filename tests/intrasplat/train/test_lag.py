"""A model whose steps nobody waits for trains as one that answers each of them, and no trouble of it goes unnoticed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from intrasplat.errors import TrainingDiverged
from intrasplat.machine.timing import Stopwatch
from intrasplat.methods.registry import PRESETS
from intrasplat.splat.cpu.model import CpuModel
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.optimize import StepRates
from intrasplat.splat.step import StepSums, TrainingFrame
from intrasplat.train.calibrate import GROWTH_ALLOWANCE, TIMED_STEPS, UNTIMED_STEPS, measured_schedule, warm_up
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.run import Run
from intrasplat.train.schedule import Schedule
from tests.intrasplat.phantoms import bits, phantom_clip, prepared, trained

LAG = 5


class LaggingModel(CpuModel):
    """Answers as a device does that is asked at every LAG-th step."""

    steps_a_report = LAG
    steps_made = 0

    def step(  # type: ignore[override]
        self, frames: Sequence[TrainingFrame], loss: LossSettings, rates: StepRates, iteration: int, sh_degree: int = 0
    ) -> StepSums | None:
        self._unanswered = [*getattr(self, "_unanswered", []), super().step(frames, loss, rates, iteration, sh_degree)]
        self.steps_made += 1
        return self.wait() if len(self._unanswered) == LAG else None

    def wait(self) -> StepSums | None:  # type: ignore[override]
        sums, self._unanswered = getattr(self, "_unanswered", []), []
        if not sums:
            return None
        added = (
            sum(getattr(each, name) for each in sums) for name in ("colour_l1", "depth_l1", "squared_error", "holes")
        )
        return StepSums(*added, min(each.visible for each in sums))


def lagging(iterations: int) -> tuple[Run, LaggingModel]:
    """A run of `fast` whose model lags."""
    run, _ = prepared(phantom_clip(), iterations=iterations)
    rasterizer = run.model.rasterizer  # type: ignore[attr-defined]
    run.model = model = LaggingModel(*run.model.export(), rasterizer.width, rasterizer.height)
    return run, model


@pytest.mark.parametrize("iterations", [20, 23])
def test_it_ends_with_the_bits_of_a_model_that_reports_every_step(iterations: int) -> None:
    clip = phantom_clip()
    run, _ = prepared(clip, iterations=iterations)
    assert bits(trained(lagging(iterations)[0])) == bits(trained(run))


@pytest.mark.parametrize(("iterations", "noticed_by"), [(20, LAG), (LAG - 2, LAG - 2)])
def test_a_loss_that_is_no_number_is_noticed_with_the_next_answer_or_at_the_end(
    iterations: int, noticed_by: int
) -> None:
    run, model = lagging(iterations)
    model.canonical[10, 5] = math.nan
    with pytest.raises(TrainingDiverged, match=f"loss is not finite by iteration {noticed_by}"):
        trained(run)
    assert model.steps_made == noticed_by


def test_a_step_that_saw_nothing_is_noticed_though_later_ones_see_again() -> None:
    run, model = lagging(20)
    place = model.canonical[:3].copy()

    def turn_away_for_a_step() -> bool:
        model.canonical[:3] = -place if run.iteration == 1 else place
        return False

    with pytest.raises(TrainingDiverged, match="No Gaussian is visible"):
        trained(run, TrainingHooks(should_stop=turn_away_for_a_step))
    assert run.iteration < LAG


def test_a_cycle_does_not_end_before_its_steps_are_known_to_be_sound() -> None:
    run, model = lagging(23)
    run.schedule = Schedule(23, warm_restarts=True)
    scored: list[int] = []

    def spoil() -> bool:
        if run.iteration == 21:  # the answer to iteration 20 was the last before the end
            model.canonical[10, 5] = math.nan
        return False

    def evaluate() -> float:
        scored.append(run.iteration)
        return 30.0

    with pytest.raises(TrainingDiverged):
        train(run, Stopwatch(), evaluate, TrainingHooks(should_stop=spoil))
    assert 23 not in scored


def test_a_budget_is_measured_on_all_steps_up_to_an_answer_and_they_are_taken_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, model = lagging(20)
    before = {key: values.clone() for key, values in model.arrays().items()}
    untimed, timed, answer_s = UNTIMED_STEPS, TIMED_STEPS, 0.1
    clock = iter(np.cumsum([0.0, *[answer_s] * (untimed + timed)]).tolist())
    monkeypatch.setattr("intrasplat.train.calibrate.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    run.setup = dataclasses.replace(run.setup, clock=SimpleNamespace(elapsed_s=1.0))
    schedule = measured_schedule(run, 60.0)
    assert schedule.planned == pytest.approx(59 / (answer_s / LAG * GROWTH_ALLOWANCE), abs=1)
    assert (schedule.opening, run.iteration) == (0, 0)
    assert model.steps_made == LAG * (untimed + timed)
    for key, values in model.arrays().items():
        assert torch.equal(values, before[key]), key


@pytest.mark.parametrize("name", ["fast", "paper", "pfs"])
def test_warming_up_leaves_a_model_as_it_was(name: str) -> None:
    run, _ = prepared(phantom_clip(), name)
    before = {key: values.clone() for key, values in run.model.arrays().items()}
    shares: list[float] = []
    assert warm_up(run, shares.append) > 0
    assert shares == sorted(shares)
    assert shares[-1] == 1
    for key, values in run.model.arrays().items():
        assert torch.equal(values, before[key]), key


@pytest.mark.parametrize("name", [*PRESETS, "paper-released", "pfs"])
def test_what_is_stored_of_a_model_holds_its_gaussians_and_no_padding(name: str) -> None:
    """So that a run stored on one device goes on on another, whose kernels pad otherwise."""
    model = prepared(phantom_clip(), name)[0].model
    count = model.count
    model.take(np.arange(count - 3), np.zeros(count - 3, np.bool_))
    for key, values in model.arrays().items():
        assert key == "motion.steps" or values.shape[-1] == count - 3, key
