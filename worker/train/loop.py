"""The one training loop. Everything it is given is built before; everything it decides is in Run.

Nothing in a schedule reads the clock, so on one device the same seed and iterations give the same bits, and a resumed
run gives those of an uninterrupted one.
"""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from contract.wire.errors import Cancelled, TrainingDiverged
from worker.machine.hooks import Hooks, Progress
from worker.model.optimize import rates_at
from worker.raster.backend import CPU, Device
from worker.raster.model import Model
from worker.raster.step import StepSums
from worker.scene.scene import Scene
from worker.train.average import RunningMean
from worker.train.densify import Densifier
from worker.train.presets import Preset
from worker.train.schedule import Schedule, left_out
from worker.train.targets import TrainingFrames

CURVE_SECONDS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 60, 90, 120, 180, 300, 600)
"""Training times at which held-out frames are scored; the clock stands still meanwhile."""
CALIBRATION_STEPS = (3, 12)
"""Untimed and timed steps that tell how many fit into a budget; they are taken back. Their median counts: the first
steps fill caches, and other processes come and go. Where not every step is waited for, so many times the steps from one
answer to the next."""
LATER_STEPS = 1.15
"""Allowance for steps that become slower while Gaussians grow. A judgement: it differs from clip to clip."""
REPORT_EVERY_S = 0.25


class Stopwatch:
    """Seconds of work, not counting what happens while it is paused."""

    def __init__(self, elapsed_s: float = 0.0) -> None:
        self._start, self._paused = time.perf_counter() - elapsed_s, 0.0

    @property
    def elapsed_s(self) -> float:
        return time.perf_counter() - self._start - self._paused

    def pause(self, work: Callable[[], float]) -> float:
        """work(), uncounted."""
        before = time.perf_counter()
        result = work()
        self._paused += time.perf_counter() - before
        return result


@dataclass(frozen=True)
class CurvePoint:
    """One row of curve.csv; t_train_s as docs/conventions.md defines it."""

    t_train_s: float
    iteration: int
    psnr_tissue_db: float


@dataclass
class Run:
    """A training run: what is trained, on what, how far it has come.

    model        Gaussians, deformation, Adam's moments
    frames       targets and cameras
    preset       rates, loss, order, densification
    schedule     how many iterations, and how rates fall in them; iteration: those done
    seed         of everything random; with the iteration it draws what that iteration needs
    asked        the length that was asked for, in words; a stored run goes on only with its own
    average      of the models that end a cycle
    densifier    its statistics; None where the preset has no densification
    device       where the model lies
    chosen       what was left to the scene, how it was settled and why, in words
    curve        scores of held-out frames so far
    """

    model: Model
    frames: TrainingFrames
    preset: Preset
    schedule: Schedule
    seed: int
    asked: str = ""
    iteration: int = 0
    average: RunningMean = field(default_factory=RunningMean)
    densifier: Densifier | None = None
    device: Device = CPU
    chosen: tuple[str, ...] = ()
    curve: list[CurvePoint] = field(default_factory=list)

    @property
    def iterations(self) -> int:
        """Of the whole run, as far as is known."""
        return self.schedule.iterations

    @property
    def frames_seen(self) -> int:
        """Frames trained on so far, each as often as it was in a step."""
        return self.iteration * self.preset.frames_a_step


def frames_at(run: Run, iteration: int) -> list[int]:
    """The training frames of an iteration (from 1): a function of preset, seed, schedule and iteration, so a run can
    resume. Epochs follow each other without a gap, so a step may have the end of one and the beginning of the next."""
    indices, count = run.frames.indices, run.preset.frames_a_step
    if run.schedule.leaves_out(iteration):
        judging = left_out(indices)
        indices = [index for index in indices if index not in judging]
    if run.preset.order == "random":
        drawn = np.random.default_rng([run.seed, iteration]).integers(len(indices), size=count)
        return [indices[place] for place in drawn]
    seen = (iteration - 1) * count
    epochs = (divmod(each, len(indices)) for each in range(seen, seen + count))
    orders = ((np.random.default_rng([run.seed, epoch]).permutation(len(indices)), place) for epoch, place in epochs)
    return [indices[order[place]] for order, place in orders]


def step(run: Run, iteration: int) -> None:
    """One iteration of the model.

    Raises:
        TrainingDiverged: the loss is not finite, or no Gaussian is in view; a model that does not answer at every step
            tells it some steps later.
    """
    preset, frames = run.preset, [run.frames.frame(index) for index in frames_at(run, iteration)]
    sh_degree = min(preset.sh_degree, iteration // preset.sh_every) if preset.sh_degree else 0
    rates = rates_at(preset.rates, run.schedule.progress(iteration))
    _check(run.model.step(frames, preset.loss, rates, iteration, sh_degree), iteration)


def _check(sums: StepSums | None, iteration: int) -> None:
    """Of the steps up to this iteration that sums are of, if the model has answered for any."""
    if sums is None:
        return
    if not math.isfinite(sums.colour_l1 + sums.depth_l1):
        raise TrainingDiverged(f"The loss is no longer a number by iteration {iteration}.")
    if sums.visible == 0:
        raise TrainingDiverged(f"No Gaussian is left in view by iteration {iteration}.")


@contextmanager
def taken_back(model: Model) -> Iterator[None]:
    """Steps of a model that has made none yet, for what they tell: at the end it is as it was."""
    stored = {name: values.clone() for name, values in model.parameters().items()}

    def start_again() -> None:
        for name, values in model.arrays().items():  # moments and their counts are 0 before the first step
            values.copy_(stored[name]) if name in stored else values.zero_()

    start_again()  # touches the moments' memory once: the first touch of a page costs as much as a step
    yield
    start_again()


def warm_up(model: Model, frames: TrainingFrames, preset: Preset, on_progress: Callable[[float], None]) -> float:
    """Make each kind of step and render of a new model once, on a device whose kernels are compiled for the very model;
    the steps are taken back. Returns seconds; on_progress is told the share done, in (0, 1]."""
    start = time.perf_counter()
    frame = frames.frame(frames.indices[0])
    seen = [frame] * preset.frames_a_step
    nothing = np.zeros((5, int(frame.camera[5]), int(frame.camera[4])), np.float32)
    parts: list[Callable[[], object]] = [
        lambda degree=degree: model.step(seen, preset.loss, rates_at(preset.rates, 1.0), 1, degree)  # type: ignore[misc]
        for degree in range(preset.sh_degree + 1)
    ]
    parts += [
        model.wait,
        lambda: model.render(frame.camera, frame.t, np.zeros(model.count, np.float32)),
        lambda: model.image_gradient(frame.camera, frame.t, nothing),
    ]
    with taken_back(model):
        for done, part in enumerate(parts, start=1):
            part()
            on_progress(done / len(parts))
    return time.perf_counter() - start


def iterations_within(
    model: Model, frames: TrainingFrames, preset: Preset, seed: int, budget_s: float, elapsed_s: float
) -> int:
    """How many iterations of a new model fit into what is left of budget_s, by timing a few and taking them back.

    As many as show every training frame once are made even if fewer fit.
    """
    start = time.perf_counter()
    at_once = model.answers_every
    untimed, timed = CALIBRATION_STEPS
    trial = Run(model, frames, preset, Schedule((untimed + timed) * at_once), seed)
    with taken_back(model):
        ends = [time.perf_counter()]
        for iteration in range(1, trial.iterations + 1):
            step(trial, iteration)
            if iteration % at_once == 0:
                _check(model.wait(), iteration)
                ends.append(time.perf_counter())
    step_s = float(np.median(np.diff(ends)[untimed:])) / at_once * LATER_STEPS
    left_s = budget_s - elapsed_s - (time.perf_counter() - start)
    return max(steps_an_epoch(frames, preset), int(left_s / step_s))


def steps_an_epoch(frames: TrainingFrames, preset: Preset) -> int:
    """The fewest iterations in which every training frame is seen."""
    return -(-len(frames.indices) // preset.frames_a_step)


def train(
    run: Run,
    clock: Stopwatch,
    evaluate: Callable[[], float],
    hooks: Hooks,
    copy_scene: Callable[[], Scene] | None = None,
) -> None:
    """Take run from its iteration to its last.

    Args:
        clock: t_train_s so far; paused while held-out frames are scored.
        evaluate: mean psnr_tissue over the held-out frames, NaN without any.
        copy_scene: the scene as the model is now, for hooks.on_snapshot; None shows none.

    Raises:
        Cancelled: hooks.should_stop said so; run is as it was after its last full iteration and can be resumed.
        TrainingDiverged: the loss or a parameter is not finite, or no Gaussian is left.
    """
    marks = [mark for mark in CURVE_SECONDS if mark > clock.elapsed_s]
    scored: float | None = run.curve[-1].psnr_tissue_db if run.curve else None
    reported, began, begun_at = -math.inf, clock.elapsed_s, run.iteration
    hooks.on_progress(Progress("train", run.iteration / run.iterations, run.iteration, run.iterations, scored))
    while run.iteration < run.iterations:
        if hooks.should_stop():
            raise Cancelled(f"Stopped after iteration {run.iteration} of {run.iterations}.")
        if copy_scene is not None and hooks.wants_snapshot():
            hooks.on_snapshot(copy_scene(), run.iteration)
        iteration = _advance(run)
        if iteration < run.iterations and (iteration in run.schedule.ends or (marks and clock.elapsed_s >= marks[0])):
            marks = [mark for mark in marks if mark > clock.elapsed_s]
            scored = _score(run, clock, evaluate)
        if (now := clock.elapsed_s) - reported >= REPORT_EVERY_S:
            reported = now
            left_s = (now - began) / (iteration - begun_at) * (run.iterations - iteration)
            share = iteration / run.iterations
            hooks.on_progress(Progress("train", share, iteration, run.iterations, scored, left_s))
    _check(run.model.wait(), run.iteration)
    _check_finite(run)
    if not run.curve or run.curve[-1].iteration < run.iteration:  # else it was stopped after its last score
        _score(run, clock, evaluate)


def _advance(run: Run) -> int:
    """The next iteration and what follows it, densification or the end of a cycle; returns its number."""
    iteration = run.iteration + 1
    step(run, iteration)
    run.iteration = iteration
    if run.densifier is not None:
        run.densifier.observe(run.model)
        if iteration < run.iterations:  # what is split then would get no step any more
            run.densifier.apply(run.model, iteration, np.random.default_rng([run.seed, iteration, 1]))
    _end_cycle(run, iteration)
    return iteration


def _end_cycle(run: Run, iteration: int) -> None:
    """Average the last models of a cycle; their mean ends it, and is judged while that can still decide anything."""
    if run.schedule.averages(iteration):
        run.average.add(run.model.parameters())
    if run.average.count and iteration in run.schedule.ends:
        run.average.put(run.model.parameters())
    if run.schedule.judges(iteration):
        run.schedule = run.schedule.with_score(_left_out_psnr(run))


def _left_out_psnr(run: Run) -> float:
    """Mean psnr_tissue of the training frames left out so far that show tissue, dB; NaN if none does."""
    frames = run.frames
    scores = [
        frames.psnr_tissue_db(index, run.model.render(frames.cameras[index], float(frames.t[index])))
        for index in left_out(frames.indices)
        if frames.picture(index)[1].any()
    ]
    return float(np.mean(scores)) if scores else math.nan


def _check_finite(run: Run) -> None:
    """A Gaussian that is not a number is not drawn either, so the loss alone does not show it."""
    broken = [name for name, values in run.model.arrays().items() if not bool(torch.isfinite(values).all())]
    if broken:
        raise TrainingDiverged(f"After {run.iteration} iterations {', '.join(broken)} hold values that are no numbers.")


def _score(run: Run, clock: Stopwatch, evaluate: Callable[[], float]) -> float | None:
    _check(run.model.wait(), run.iteration)  # what is still being trained is no part of scoring
    t_train_s = clock.elapsed_s
    psnr = clock.pause(evaluate)
    if math.isnan(psnr):
        return None
    run.curve.append(CurvePoint(t_train_s, run.iteration, psnr))
    return psnr


def write_curve(path: Path, run: Run) -> None:
    """curve.csv: t_train_s, iteration, psnr_tissue_db of the held-out frames, training frames seen by then."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_train_s", "iteration", "psnr_tissue_db", "frames_seen"])
        writer.writerows(
            [f"{p.t_train_s:.3f}", p.iteration, f"{p.psnr_tissue_db:.4f}", p.iteration * run.preset.frames_a_step]
            for p in run.curve
        )
