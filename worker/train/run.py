"""The state of a training run: what is trained, on what, and how far it has come."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from contract.wire.names import Eyes
from contract.wire.notices import Notice
from worker.machine.hooks import Progress
from worker.methods.method import Preset
from worker.raster.backend import Device
from worker.raster.model import Model
from worker.train.average import RunningMean
from worker.train.densify import Densifier
from worker.train.schedule import Schedule, validation_frames
from worker.train.setup import Setup
from worker.train.targets import TrainingFrames


@dataclass(frozen=True)
class CurvePoint:
    """One row of curve.csv; both clocks as docs/conventions.md defines them. None: not known."""

    t_train_s: float
    iteration: int
    psnr_tissue_db: float
    psnr_right_db: float | None = None
    t_post_s: float | None = None


Box = tuple[tuple[float, ...], tuple[float, ...]]
"""Two opposite corners of a box, x y z each."""


@dataclass
class Run:
    """A training run.

    setup        clip, split, request, device, hooks, clocks
    model        Gaussians, deformation, Adam's moments
    frames       targets and cameras of the left eye
    right        those of the right eye; None where the left eye alone teaches
    preset       rates, loss, order, densification; nothing is left to the scene any more
    schedule     how many iterations, and how the rates fall; iteration: those done
    box          corners of the box of the Gaussians' centres before the first step, units
    average      mean of the last models of a cycle
    densifier    its statistics; None where the preset has no densification
    chosen       what the preset left to the scene, its value and the reason, in words
    curve        scores of held-out frames so far
    """

    setup: Setup
    model: Model
    frames: TrainingFrames
    preset: Preset
    schedule: Schedule
    box: Box
    iteration: int = 0
    right: TrainingFrames | None = None
    average: RunningMean = field(default_factory=RunningMean)
    densifier: Densifier | None = None
    chosen: tuple[Notice, ...] = ()
    curve: list[CurvePoint] = field(default_factory=list)

    @property
    def seed(self) -> int:
        """Of everything random; with the iteration it draws what that iteration needs."""
        return self.setup.options.seed

    @property
    def device(self) -> Device:
        """Where the model lies."""
        return self.setup.device

    @property
    def eyes(self) -> tuple[TrainingFrames, ...]:
        """The eyes that teach, left first."""
        return (self.frames,) if self.right is None else (self.frames, self.right)

    @property
    def taught_by(self) -> Eyes:
        """The eyes that teach, by their name."""
        return "left" if self.right is None else "both"

    @property
    def iterations(self) -> int:
        """Of the whole run, as far as is known."""
        return self.schedule.iterations

    @property
    def frames_seen(self) -> int:
        """Frames trained on so far, each counted once for every step that had it."""
        return self.iteration * self.preset.frames_a_step

    @property
    def steps_an_epoch(self) -> int:
        """The fewest iterations in which every training frame is seen."""
        return -(-len(self.frames.indices) // self.preset.frames_a_step)

    def progress(self, stage: str, fraction: float, seconds_left: float | None = None) -> Progress:
        """A report of progress with the iterations and the curve's last scores."""
        report = Progress(stage, fraction, self.iteration, self.iterations, seconds_left=seconds_left)
        if not self.curve:
            return report
        return replace(report, psnr_db=self.curve[-1].psnr_tissue_db, psnr_right_db=self.curve[-1].psnr_right_db)


def frames_at(run: Run, iteration: int) -> list[int]:
    """The training frames of an iteration (from 1): a function of preset, seed, schedule and iteration, so that a run
    can be resumed. Epochs follow each other without a gap: a step may end one epoch and begin the next."""
    indices, count = run.frames.indices, run.preset.frames_a_step
    if run.schedule.withholds_validation(iteration):
        withheld = validation_frames(indices)
        indices = [index for index in indices if index not in withheld]
    if run.preset.order == "random":
        drawn = np.random.default_rng([run.seed, iteration]).integers(len(indices), size=count)
        return [indices[place] for place in drawn]
    seen = (iteration - 1) * count
    epochs = (divmod(each, len(indices)) for each in range(seen, seen + count))
    orders = ((np.random.default_rng([run.seed, epoch]).permutation(len(indices)), place) for epoch, place in epochs)
    return [indices[order[place]] for order, place in orders]


def write_curve(path: Path, run: Run) -> None:
    """curve.csv: seconds by both clocks, iteration, scores of the held-out frames in training, training frames seen.

    psnr_right_db is empty for a clip of one eye.
    """
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_train_s", "t_post_s", "iteration", "psnr_tissue_db", "frames_seen", "psnr_right_db"])
        writer.writerows(
            [
                f"{p.t_train_s:.3f}",
                "" if p.t_post_s is None else f"{p.t_post_s:.3f}",
                p.iteration,
                f"{p.psnr_tissue_db:.4f}",
                p.iteration * run.preset.frames_a_step,
                "" if p.psnr_right_db is None else f"{p.psnr_right_db:.4f}",
            ]
            for p in run.curve
        )
