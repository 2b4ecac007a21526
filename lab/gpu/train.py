"""Part of check.py: how soon training on the device is how good, against `paper` to its end and the CPU's `fast`.

A run does what `reconstruct` does with a clip that has depth, until training ends: points, tracks, a model, steps.
Seconds are t_train_s as docs/conventions.md defines it: they contain the work of the processor before the first step,
and neither compilation nor scoring. The run scores held-out frames at many moments. A threshold is reached at the first
moment with a score above it, so a figure is late by at most the distance to the moment before.

How many dB a run can reach depends on the clip. So thresholds count from the score that `paper` ends with on that clip.
`fast` trains on one, two and four frames per step; more frames fill the device better, and the seconds say what that is
worth. A second seed runs last if time is left.
"""

from __future__ import annotations

import dataclasses
import sys
import traceback

import numpy as np

from intrasplat.clip import DepthClip, split_frames
from intrasplat.errors import Cancelled
from intrasplat.methods.method import Preset
from intrasplat.methods.registry import PRESETS
from intrasplat.options import ReconstructionOptions
from intrasplat.splat.backend import CPU, Device
from intrasplat.train import loop as training
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.prepare import prepare
from intrasplat.train.run import CurvePoint, Run
from intrasplat.train.scoring import held_out_score
from intrasplat.train.setup import Setup
from lab.gpu.prepare import load_clip
from lab.gpu.rows import CLIP, CLIP_READY, KERNELS_READY, Part
from tests.intrasplat.splat.interpreter import hasten

STAGES = ("motion_s", "capacity_s", "fusion_s", "start_s", "targets_s", "optimise_s", "compile_s")
THRESHOLDS_DB = {"s_to_paper_less_4_db": -4, "s_to_paper_less_2_db": -2, "s_to_paper_db": 0, "s_to_paper_plus_2_db": 2}
"""Seconds to so many dB more than `paper` ended with; empty where that was not reached, or `paper` broke off."""
FIELDS = (
    "clip", "preset", "frames_a_step", "device", "seed", "iterations", "frames_seen", "gaussians", "final_db",
    *THRESHOLDS_DB, "t_train_s", *STAGES, "step_ms", "note",
)  # fmt: skip
FRAMES_A_STEP = (1, 2, 4)
POINT_FIELDS = ("t_train_s", "iteration", "psnr_tissue_db")
CURVE_FIELDS = ("clip", "preset", "frames_a_step", "device", "seed", *POINT_FIELDS)
MOMENTS_S = (*np.arange(0.1, 2.0, 0.1), *np.arange(2.0, 6.0, 0.25), *np.arange(6.0, 60.0, 2.0))
"""Values of t_train_s at which held-out frames are scored; closer than a report's, because a run takes seconds."""
FAST_BUDGET_S, CPU_BUDGET_S = 15.0, 45.0
MIN_LEFT_S = {"paper": 45.0, "fast": 24.0, "cpu": 35.0}
"""A run starts only if so many seconds are left of the part, for its training and its scoring."""


def main() -> None:
    part = Part.begin("train", FIELDS)
    if part.interpret:
        hasten(setattr)
    try:
        told = part.wait_for(CLIP_READY)
    except RuntimeError as error:
        sys.exit(f"  nothing to train on: {error}")
    clip = load_clip(part.work / CLIP, told["camera"])  # type: ignore[arg-type]
    trials = TimedRuns(part, str(told["name"]), clip)
    device = Device("cuda", str(part.origin["gpu"]), part.device)
    if part.interpret:
        trials.run(_tiny("paper"), device, 0, iterations=2)
        for frames_a_step in FRAMES_A_STEP[:2]:
            trials.run(on_several(_tiny("fast"), frames_a_step), device, 0, iterations=2)
        return
    if part.has(MIN_LEFT_S["paper"], "paper"):
        trials.run(PRESETS["paper"], device, 0, iterations=PRESETS["paper"].iterations)
    for frames_a_step in FRAMES_A_STEP:
        if part.has(MIN_LEFT_S["fast"], f"fast, {frames_a_step} frames per step"):
            trials.run(on_several(PRESETS["fast"], frames_a_step), device, 0, budget_s=FAST_BUDGET_S)
    if part.has(MIN_LEFT_S["cpu"], "the CPU's fast"):
        part.wait_for(KERNELS_READY)
        trials.run(PRESETS["fast"], CPU, 0, budget_s=min(CPU_BUDGET_S, part.left_s - 15))
    if part.has(MIN_LEFT_S["fast"], "fast, seed 1"):
        trials.run(PRESETS["fast"], device, 1, budget_s=FAST_BUDGET_S)


def on_several(preset: Preset, frames_a_step: int) -> Preset:
    """The preset, with so many frames per step."""
    return dataclasses.replace(preset, frames_a_step=frames_a_step)


def _tiny(name: str) -> Preset:
    """For the interpreter: the same way with next to nothing to do."""
    return dataclasses.replace(PRESETS[name], tracks=False, bases=2, points_per_image=9, points_by_budget=False)


class TimedRuns:
    """Runs on one clip; what `paper` ended with sets the thresholds, its own and those of the runs after it."""

    def __init__(self, part: Part, name: str, clip: DepthClip) -> None:
        self._part, self._name, self._clip = part, name, clip
        self._curves = dataclasses.replace(part, name="curves", fields=CURVE_FIELDS)
        self._paper_db: float | None = None
        training.CURVE_SECONDS, training.UNSCORED_S = MOMENTS_S, 0.0

    def run(self, preset: Preset, device: Device, seed: int, **length: float | None) -> None:
        """One run, its row and its curve; one that breaks off has a row that says so."""
        place = {"clip": self._name, "preset": preset.name, "frames_a_step": preset.frames_a_step}
        place |= {"device": device.kind, "seed": seed}
        try:
            run, seconds, note = self._trained(preset, device, seed, length)
        except Exception as error:
            traceback.print_exc()
            self._part.add(**place, note=f"{type(error).__name__}: {error}"[:200])
            return
        for point in run.curve:
            self._curves.add(**place, **{name: getattr(point, name) for name in POINT_FIELDS})
        final_db = run.curve[-1].psnr_tissue_db if run.curve else None
        if preset.name == "paper" and not note:
            self._paper_db = final_db
        reached = seconds_to(run.curve, self._paper_db)
        row = {**place, "iterations": run.iteration, "frames_seen": run.frames_seen, "gaussians": run.model.count}
        row |= {"final_db": final_db, **reached}
        row |= {name: round(seconds.get(name, 0.0), 3) for name in ("t_train_s", *STAGES)}
        row["step_ms"] = 1e3 * seconds["optimise_s"] / max(run.iteration, 1)
        self._part.add(**row, note=note)
        print("  " + "  ".join(f"{name} {value}" for name, value in row.items() if value is not None), flush=True)

    def _trained(
        self, preset: Preset, device: Device, seed: int, length: dict[str, float | None]
    ) -> tuple[Run, dict[str, float], str]:
        """The run, seconds by stage, and why it was cut short if it was."""
        split = split_frames(self._clip, "every8")
        options = ReconstructionOptions(seed=seed, **length)  # type: ignore[arg-type]
        hooks = TrainingHooks(should_stop=lambda: self._part.left_s < 4)
        run = prepare(Setup(self._clip, split, preset, options, device, hooks))
        clock, seconds = run.setup.clock, run.setup.timings.seconds
        begun_s, note = clock.elapsed_s, ""
        try:
            train(run, clock, lambda: held_out_score(run), hooks)
        except Cancelled:
            run.model.wait()
            note = f"cut short after {run.iteration} of {run.iterations} iterations"
        seconds |= {"optimise_s": clock.elapsed_s - begun_s, "t_train_s": clock.elapsed_s}
        return run, seconds, note


def seconds_to(curve: list[CurvePoint], paper_db: float | None) -> dict[str, float | None]:
    """The columns of THRESHOLDS_DB."""
    if paper_db is None:
        return dict.fromkeys(THRESHOLDS_DB)
    return {name: first_s(curve, paper_db + more_db) for name, more_db in THRESHOLDS_DB.items()}


def first_s(curve: list[CurvePoint], psnr_db: float) -> float | None:
    """The first moment at which so much was reached; None if it never was."""
    return next((point.t_train_s for point in curve if point.psnr_tissue_db >= psnr_db), None)


if __name__ == "__main__":
    main()
