"""The training loop. prepare.py builds the Run, its state; with a budget, calibrate.py makes the first steps.

Only a run with a budget reads the clock, before its last cycle. So on one device the same seed and iterations give a
bit-identical model, also if the run was interrupted and resumed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from intrasplat.errors import Cancelled, TrainingDiverged
from intrasplat.machine.hooks import ignore
from intrasplat.machine.timing import Stopwatch
from intrasplat.scene.scene import TrainedScene, is_finite
from intrasplat.splat.model import state_of
from intrasplat.splat.optimize import rates_at
from intrasplat.splat.step import StepSums
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.run import CurvePoint, Run, frames_at
from intrasplat.train.scoring import HeldOutScore

CURVE_SECONDS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 60, 90, 120, 180, 300, 600, 1200, 1800)
"""Seconds of training after which held-out frames are scored; the clock is paused meanwhile."""
UNSCORED_S = 2.0
"""Seconds at the start without a score, which would delay the user by a third of a second and say little so early."""
REPORT_EVERY_S = 0.25
REMAINING_AFTER_S = 1.0
"""Seconds of training after which the remaining time is reported. The run's state is written to disk during the first
steps, so they do not show how long the others take."""
TIMED_ITERATIONS = 50
"""Fewest iterations by whose time the last cycle is fitted; a resumed run may have made fewer."""


def step(run: Run, iteration: int) -> None:
    """Make one iteration of the model, and check its loss.

    Raises:
        TrainingDiverged: the loss is not finite, or no Gaussian is visible. A GPU model reports its losses some steps
            late, so the error may come some steps later.
    """
    preset, frames = run.preset, [eye.frame(index) for index in frames_at(run, iteration) for eye in run.eyes]
    sh_degree = min(preset.sh_degree, iteration // preset.sh_every) if preset.sh_degree else 0
    rates = rates_at(preset.rates, run.schedule.progress(iteration))
    check_sums(run.model.step(frames, preset.loss, rates, iteration, sh_degree), iteration)


def check_sums(sums: StepSums | None, iteration: int) -> None:
    """Check the losses of the steps that the model has reported; None: it has reported none.

    Raises:
        TrainingDiverged: a loss is not finite, or no Gaussian is visible.
    """
    if sums is None:
        return
    if not math.isfinite(sums.colour_l1 + sums.depth_l1):
        raise TrainingDiverged(f"The loss is not finite by iteration {iteration}.")
    if sums.visible == 0:
        raise TrainingDiverged(f"No Gaussian is visible by iteration {iteration}.")


def train(
    run: Run,
    clock: Stopwatch,
    evaluate: Callable[[], HeldOutScore],
    hooks: TrainingHooks,
    copy_scene: Callable[[], TrainedScene] | None = None,
    keep: Callable[[Run], None] = ignore,
) -> None:
    """Train run from its current iteration to its last.

    Args:
        clock: measures t_train_s; paused while held-out frames are scored.
        evaluate: returns the score of the held-out frames, NaN without any.
        copy_scene: returns the scene of the current model, for hooks.on_snapshot; None: there are no snapshots.
        keep: called before every step, when run is between two iterations; may store it.

    Raises:
        Cancelled: hooks.should_stop() returned True; run is as after its last full iteration and can be resumed.
        TrainingDiverged: the loss or a parameter is not finite, or no Gaussian is visible.
    """
    marks = [mark for mark in CURVE_SECONDS if mark > clock.elapsed_s + UNSCORED_S]
    reported, began, first = -math.inf, clock.elapsed_s, run.iteration
    hooks.on_progress(run.progress("train", run.iteration / run.iterations))
    while run.iteration < run.iterations:
        if hooks.should_stop():
            raise Cancelled(f"Stopped after iteration {run.iteration} of {run.iterations}.")
        keep(run)
        if copy_scene is not None and hooks.wants_snapshot():
            hooks.on_snapshot(copy_scene(), run.iteration)
        iteration = _advance(run)
        has_budget, made = run.setup.fixed_iterations is None, iteration - first
        if has_budget and iteration == run.schedule.fitted_at:
            _fit_last_cycle(run, clock, (clock.elapsed_s - began) / made if made >= TIMED_ITERATIONS else None)
        if iteration < run.iterations and (iteration in run.schedule.ends or (marks and clock.elapsed_s >= marks[0])):
            marks = [mark for mark in marks if mark > clock.elapsed_s]
            _score(run, clock, evaluate)
        if (now := clock.elapsed_s) - reported >= REPORT_EVERY_S:
            reported = now
            made_s = now - began
            step_s = made_s / (iteration - first) if made_s > REMAINING_AFTER_S else None
            left_s = None if step_s is None else step_s * (run.iterations - iteration)
            if step_s is not None and has_budget and (least := run.schedule.least_end) is not None:
                # the last cycle will be fitted into the budget, as far as it can be
                left_s = min(
                    step_s * (run.iterations - iteration), max(run.setup.budget_s - now, step_s * (least - iteration))
                )
            hooks.on_progress(run.progress("train", iteration / run.iterations, left_s))
    check_sums(run.model.wait(), run.iteration)
    _check_finite(run)
    if not run.curve or run.curve[-1].iteration < run.iteration:  # else it was stopped after its last score
        _score(run, clock, evaluate)


def _advance(run: Run) -> int:
    """Make the next iteration, then densify or end the cycle if that is due; returns the iteration's number."""
    iteration = run.iteration + 1
    step(run, iteration)
    run.iteration = iteration
    if run.densifier is not None:
        run.densifier.observe(run.model)
        if iteration < run.iterations:  # children of the last iteration would get no step
            run.densifier.apply(run.model, iteration, np.random.default_rng([run.seed, iteration, 1]))
    _end_cycle(run, iteration)
    return iteration


def _end_cycle(run: Run, iteration: int) -> None:
    """Average the last models of a cycle, and continue from their mean. Score it while early stopping is undecided."""
    if run.schedule.averages(iteration):
        run.average.add(run.model.parameters())
    if run.average.count and iteration in run.schedule.ends:
        run.average.put(run.model.parameters())
    if run.schedule.scores_validation(iteration):
        run.schedule = run.schedule.with_score(_validation_psnr(run))


def _fit_last_cycle(run: Run, clock: Stopwatch, step_s: float | None) -> None:
    """Fit the last cycle into what is left of the budget; step_s: time of a step so far, None: as planned."""
    check_sums(run.model.wait(), run.iteration)
    left = run.schedule.planned - run.iteration if step_s is None else (run.setup.budget_s - clock.elapsed_s) / step_s
    run.schedule = run.schedule.with_last_cycle(int(left))


def _validation_psnr(run: Run) -> float:
    """Mean psnr_tissue in dB of the validation frames that show tissue; NaN if none does."""
    scores = [
        eye.psnr_tissue_db(index, run.model.render(eye.cameras[index], float(eye.t[index])))
        for index in run.validation
        for eye in run.eyes
        if eye.picture(index)[1].any()
    ]
    return float(np.mean(scores)) if scores else math.nan


def _check_finite(run: Run) -> None:
    """Check the parameters themselves: a Gaussian with NaN is not drawn, so the loss does not show it."""
    arrays = state_of(run.model, run.preset.rates.beta1)
    broken = [name for name, values in arrays.items() if not is_finite(values)]
    if broken:
        raise TrainingDiverged(f"After {run.iteration} iterations {', '.join(broken)} hold values that are not finite.")


def _score(run: Run, clock: Stopwatch, evaluate: Callable[[], HeldOutScore]) -> None:
    check_sums(run.model.wait(), run.iteration)  # the GPU's pending steps count as training, not as scoring
    t_train_s, t_post_s = clock.elapsed_s, time.time() - run.setup.accepted_at_s
    with clock.paused():
        score = evaluate()
    if math.isnan(score.left_db):
        return
    right_db = None if math.isnan(score.right_db) else score.right_db
    run.curve.append(CurvePoint(t_train_s, run.iteration, score.left_db, right_db, t_post_s))
