"""A clip with depth becomes a run that can be trained: points, their motion, a model, its targets, its length."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from contract.wire.errors import Cancelled
from contract.wire.options import ReconstructionOptions
from worker.fusion import fuse
from worker.input.clip import DepthClip, FrameSplit
from worker.machine.hooks import Hooks, Progress
from worker.model.deformation import SharedBasis
from worker.motion.tracks import moved_along, track
from worker.raster.backend import CPU, Device, examine
from worker.raster.model import Model
from worker.train.densify import Densifier
from worker.train.loop import Run, Stopwatch, iterations_within, steps_an_epoch, warm_up
from worker.train.presets import Preset
from worker.train.schedule import Schedule, left_out
from worker.train.start import fusion_for, settled, start_model
from worker.train.targets import TrainingFrames, units_per_mm

_Result = TypeVar("_Result")
Seconds = dict[str, float]  # by stage; each stage that is timed adds its own


def timed(seconds: Seconds, name: str, work: Callable[[], _Result]) -> _Result:
    """work(), its duration stored under name."""
    start = time.perf_counter()
    result = work()
    seconds[name] = time.perf_counter() - start
    return result


def report_stage(hooks: Hooks, stage: str, share: float) -> None:
    """Say how far a stage has come.

    Raises:
        Cancelled: the caller wants to stop.
    """
    hooks.on_progress(Progress(stage, share))
    if hooks.should_stop():
        raise Cancelled(f"Stopped during stage {stage!r}.")


def prepare(
    clip: DepthClip,
    split: FrameSplit,
    preset: Preset,
    options: ReconstructionOptions,
    clock: Stopwatch,
    hooks: Hooks | None = None,
    seconds: Seconds | None = None,
    device: Device = CPU,
) -> tuple[Run, float]:
    """Fuse points, start the model, and settle how many iterations are made; seconds by stage go into `seconds`."""
    hooks, seconds = hooks or Hooks(), {} if seconds is None else seconds
    scale = units_per_mm(clip, split.train)
    if device != CPU:  # what a GPU's kernels take to be compiled, here and below, is no part of training
        report_stage(hooks, "compile", 0.0)
        seconds["compile_s"] = seconds.get("compile_s", 0.0) + clock.pause(lambda: examine(device))
    tracks = None
    if preset.tracks and preset.deformation == SharedBasis.kind and len(split.train) > 1:
        tracks = timed(
            seconds, "motion_s", lambda: track(clip, split.train, lambda share: report_stage(hooks, "motion", share))
        )
    report_stage(hooks, "fusion", 0.0)
    preset, chosen = timed(seconds, "capacity_s", lambda: settled(preset, tracks, clip, split.train))
    fusion = fusion_for(preset, clip.intrinsics)
    moved = moved_along(tracks, split.train, clip.intrinsics.width) if tracks is not None else None
    cloud = timed(seconds, "fusion_s", lambda: fuse(clip, split.train, fusion, seed=options.seed, moved=moved))
    report_stage(hooks, "start", 0.0)
    model = timed(
        seconds, "start_s", lambda: start_model(cloud, tracks, clip, split.train, preset, scale, options.seed, device)
    )
    frames = timed(seconds, "targets_s", lambda: TrainingFrames(clip, split.train, scale))
    densifier = Densifier(preset.densify, model.count) if preset.densify else None
    if device != CPU:
        seconds["compile_s"] += clock.pause(
            lambda: warm_up(model, frames, preset, partial(report_stage, hooks, "compile"))
        )
    schedule, asked = schedule_of(model, frames, preset, options, clock, hooks)
    run = Run(model, frames, preset, schedule, options.seed, asked, densifier=densifier, device=device, chosen=chosen)
    return run, scale


def fixed_iterations(options: ReconstructionOptions, preset: Preset) -> int | None:
    """The iterations that were asked for, or else are the preset's own; None where seconds say how long a run is."""
    return options.iterations or (None if options.budget_s else preset.iterations)


def schedule_of(
    model: Model, frames: TrainingFrames, preset: Preset, options: ReconstructionOptions, clock: Stopwatch, hooks: Hooks
) -> tuple[Schedule, str]:
    """How many iterations are made and how rates fall in them; and, in words, the length that was asked for."""
    epoch = steps_an_epoch(frames, preset)
    fixed = fixed_iterations(options, preset)
    if fixed is not None:
        return Schedule(fixed, preset.cycles, epoch=epoch), f"{fixed} iterations"
    budget_s = options.budget_s or preset.budget_s
    assert budget_s is not None
    report_stage(hooks, "calibrate", 0.0)
    planned = iterations_within(model, frames, preset, options.seed, budget_s, clock.elapsed_s)
    worth_db = preset.worth_db if left_out(frames.indices) else None
    return Schedule(planned, preset.cycles, worth_db, epoch), f"{budget_s} s"
