"""The first steps of a new model: they compile its kernels and measure how many steps fit into a budget."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

import numpy as np

from intrasplat.errors import Cancelled
from intrasplat.splat.model import Model, state_of
from intrasplat.splat.optimize import rates_at
from intrasplat.splat.step import image_size
from intrasplat.train.loop import check_sums, step
from intrasplat.train.run import Run
from intrasplat.train.schedule import Schedule

UNTIMED_STEPS, TIMED_STEPS = 3, 12
"""Steps before timing starts, which fill caches, and steps that are timed. Their median counts, because other processes
disturb single steps. Where the device reports every k-th step only, both numbers count reports."""
GROWTH_ALLOWANCE = 1.15
"""Later steps are slower, because Gaussians grow. The factor is an estimate: it differs from clip to clip."""


@contextmanager
def taken_back(model: Model, beta1: float) -> Iterator[None]:
    """Undo, at the end of the with statement, all steps that a new model made in it with this beta1."""
    stored = {name: values.clone() for name, values in model.parameters().items()}

    def restore() -> None:
        for name, values in state_of(model, beta1).items():  # moments and their counts are 0 before the first step
            if name in stored:
                values.copy_(stored[name])
            else:
                values.zero_()

    restore()  # touches the moments' memory before timing: the first access to a page costs as much as a step
    yield
    restore()


def warm_up(run: Run, on_progress: Callable[[float], None]) -> float:
    """Run each kind of step and render of a new run once, so that the device compiles its kernels for this model.

    Returns the seconds it took; on_progress receives the share done, in (0, 1].
    """
    start = time.perf_counter()
    model, preset = run.model, run.preset
    frame = run.frames.frame(run.frames.indices[0])
    seen = [frame] * preset.frames_a_step
    width, height = image_size(frame.camera)
    nothing = np.zeros((5, height, width), np.float32)
    parts: list[Callable[[], object]] = [
        lambda degree=degree: model.step(seen, preset.loss, rates_at(preset.rates, 1.0), 1, degree)  # type: ignore[misc]
        for degree in range(preset.sh_degree + 1)
    ]
    parts += [
        model.wait,
        lambda: model.render(frame.camera, frame.t, np.zeros(model.count, np.float32)),
        lambda: model.image_gradient(frame.camera, frame.t, nothing),
    ]
    with taken_back(model, preset.rates.beta1):
        for done, part in enumerate(parts, start=1):
            part()
            on_progress(done / len(parts))
    return time.perf_counter() - start


def measured_schedule(run: Run, budget_s: float, min_gain_db: float | None = None) -> Schedule:
    """The schedule of a new run whose iterations fit into its budget. Its first steps are timed to predict the others.

    budget_s includes what the run's clock shows already. The iterations show every training frame at least once. Where
    the device reports every step, the timed steps are the run's first iterations. A device that reports late makes
    hundreds of them, so there they are undone.

    Raises:
        Cancelled: hooks.should_stop() returned True.
        TrainingDiverged: a loss is not finite, or no Gaussian is visible.
    """
    model, steps_a_report = run.model, run.model.steps_a_report
    timed, keeps_steps = (UNTIMED_STEPS + TIMED_STEPS) * steps_a_report, steps_a_report == 1
    known = Schedule(timed, run.preset.warm_restarts, min_gain_db, run.steps_an_epoch, opening=timed)
    run.schedule, ends = known, []
    with nullcontext() if keeps_steps else taken_back(model, run.preset.rates.beta1):
        ends.append(time.perf_counter())
        for iteration in range(1, timed + 1):
            if run.setup.hooks.should_stop():
                raise Cancelled(f"Stopped after {iteration - 1} timed iterations.")
            step(run, iteration)
            if iteration % steps_a_report == 0:
                check_sums(model.wait(), iteration)
                ends.append(time.perf_counter())
    made = timed if keeps_steps else 0
    run.iteration = made
    step_s = float(np.median(np.diff(ends)[UNTIMED_STEPS:])) / steps_a_report * GROWTH_ALLOWANCE
    left = int((budget_s - run.setup.clock.elapsed_s) / step_s)
    return replace(known, planned=max(run.steps_an_epoch, made + left, made), opening=made)
