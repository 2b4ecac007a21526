"""The state of a training run: the model, its targets, and the progress so far."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from intrasplat.machine.hooks import Progress
from intrasplat.methods.method import Preset
from intrasplat.motion.exposure import Exposure
from intrasplat.names import Eyes
from intrasplat.notices import Notice
from intrasplat.splat.backend import Device
from intrasplat.splat.model import Model
from intrasplat.train.average import RunningMean
from intrasplat.train.densify import Densifier
from intrasplat.train.schedule import Schedule, validation_frames
from intrasplat.train.setup import Setup
from intrasplat.train.targets import TrainingFrames
from intrasplat.vignetting import Vignetting


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

    setup         clip, split, options, device, hooks, clocks
    model         Gaussians, deformation, Adam's moments
    frames        targets and cameras of the left eye
    preset        rates, loss, order, densification; all that it left to the scene is filled in
    schedule      the cycles, their rates, and early stopping
    box           bounding box of the Gaussians' centres before the first step, units
    iteration     iterations done
    right         targets and cameras of the right eye; None where only the left eye is trained on
    average       mean of the last models of a cycle
    densifier     splits and prunes Gaussians; None where the preset has no densification
    chosen        what the preset left to the scene: the value chosen and the reason
    motion_error  error of the motion between training frames, squared grey levels, where no motion model follows it
    exposure      of every frame, if it changes: targets are in steady light; None: they are as recorded
    vignetting    of the pictures, if it is strong: targets are evenly lit; None: they are as recorded
    curve         scores of held-out frames so far
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
    motion_error: float | None = None
    exposure: Exposure | None = None
    vignetting: Vignetting | None = None
    curve: list[CurvePoint] = field(default_factory=list)

    @property
    def seed(self) -> int:
        """The seed of all random numbers. Seed and iteration together decide what an iteration draws."""
        return self.setup.options.seed

    @property
    def device(self) -> Device:
        """The device that holds the model."""
        return self.setup.device

    @property
    def eyes(self) -> tuple[TrainingFrames, ...]:
        """The targets of the eyes that are trained on, left first."""
        return (self.frames,) if self.right is None else (self.frames, self.right)

    @property
    def trained_eyes(self) -> Eyes:
        """The name of the eyes that are trained on."""
        return "left" if self.right is None else "both"

    @property
    def iterations(self) -> int:
        """Iterations of the whole run; early stopping may still reduce them."""
        return self.schedule.iterations

    @property
    def frames_seen(self) -> int:
        """Frames trained on so far, each counted once per step."""
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
    """The training frames of an iteration, counted from 1. They depend on preset, seed, schedule and iteration alone,
    so that a run can be resumed. Epochs have no gap between them: a step may end one and start the next."""
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
    """Write curve.csv: seconds by both clocks, iteration, scores of held-out frames, training frames seen.

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
