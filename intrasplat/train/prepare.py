"""Prepare a clip with depth for training: points, their motion, a model, its targets and its schedule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from intrasplat.fusion import fuse
from intrasplat.machine.memory import LITTLE_BYTES, keep_free_memory
from intrasplat.methods.method import Preset
from intrasplat.motion.exposure import Exposure, find_exposure
from intrasplat.motion.keyframes import track_keyframes
from intrasplat.motion.light import RecordedLight
from intrasplat.motion.smoke import find_veils
from intrasplat.motion.tracks import Tracks, moved_along, without_gains
from intrasplat.motion.veil import Veil
from intrasplat.motion.vignetting import find_vignetting
from intrasplat.notices import Notice
from intrasplat.splat.backend import CPU, examine
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.model import Model
from intrasplat.train.calibrate import measured_schedule, warm_up
from intrasplat.train.densify import Densifier
from intrasplat.train.run import Box, Run
from intrasplat.train.schedule import Schedule
from intrasplat.train.setup import Setup
from intrasplat.train.start import bounded, box_of, fusion_for, resolve_preset, start_model
from intrasplat.train.targets import TrainingFrames, units_per_mm

SAME_FLOW = 0.32
"""Range of a channel's log gain, one stop, up to which flow between the recorded pictures is used."""
SMOKE_PASSES = 2
"""How often smoke is measured: tracks through frames without it are better, and show it better."""


def prepare(setup: Setup) -> Run:
    """The run before its first step or, with a budget in seconds, after the first steps, which are timed.

    Raises:
        InputError: no training frame has valid depth.
        Cancelled: hooks.should_stop() returned True.
    """
    train, timings = setup.split.train, setup.timings
    scale = units_per_mm(setup.clip, train)
    examine_device(setup)
    light, steady, tracks = _followed(setup)
    clip = steady.clip
    setup.hooks.report_stage("fusion", 0.0)
    with timings.measure("capacity_s"):
        preset, chosen, motion_error = resolve_preset(setup.preset, tracks, clip, train)
    with timings.measure("fusion_s"):
        moved = {train[each.reference]: moved_along(each, train, clip.intrinsics.width) for each in tracks}
        right = steady.teaching_eyes[1] if len(steady.teaching_eyes) > 1 else None
        fusion = fusion_for(preset, clip.intrinsics)
        cloud = fuse(clip, setup.split.sharp_first, fusion, seed=setup.options.seed, moved=moved, right=right)
    preset, fewer = bounded(preset, len(cloud.points_mm))
    setup.hooks.report_stage("start", 0.0)
    with timings.measure("start_s"):
        model = start_model(
            cloud, tracks, clip, train, preset, scale, setup.options.seed, setup.device, gloss=any(setup.sides)
        )
    run = new_run(setup, frames_of(steady, scale), model, preset, (*chosen, *fewer), box_of(model))
    run.light = light
    keep_free_memory(LITTLE_BYTES)
    run.motion_error = motion_error
    run.schedule = _schedule(run)
    return run


def in_light_of(setup: Setup, light: RecordedLight) -> Setup:
    """The setup with the clip to train on: without smoke and in steady light."""
    return replace(setup, clip=light.removed(setup.clip))


def examine_device(setup: Setup) -> None:
    """Compile a GPU's kernels and check them; the clock is paused. Raises UnavailableError if they do not work."""
    if setup.device != CPU:
        setup.hooks.report_stage("compile", 0.0)
        with setup.clock.paused():
            setup.timings.add("compile_s", examine(setup.device))


def frames_of(setup: Setup, scale: float) -> list[TrainingFrames]:
    """The targets of each eye that is trained on, left first. scale: optimiser units per millimetre."""
    with setup.timings.measure("targets_s"):
        eyes = zip(setup.teaching_eyes, setup.sides, strict=False)
        return [TrainingFrames(eye, setup.split.train, scale, side) for eye, side in eyes]


def new_run(
    setup: Setup, frames: Sequence[TrainingFrames], model: Model, preset: Preset, chosen: tuple[Notice, ...], box: Box
) -> Run:
    """The run of a model that has made no step; it has no schedule yet. A GPU compiles the kernels of this model here.

    Args:
        frames: the targets of each eye that is trained on.
        preset: with all that it leaves to the scene filled in (start.resolve_preset).
    """
    densifier = Densifier(preset.densify, model.count) if preset.densify else None
    run = Run(setup, model, frames[0], preset, Schedule(planned=0), box, densifier=densifier, chosen=chosen)
    run.right = frames[1] if len(frames) > 1 else None
    if setup.device != CPU:
        with setup.clock.paused():
            setup.timings.add("compile_s", warm_up(run, partial(setup.hooks.report_stage, "compile")))
    return run


def _followed(setup: Setup) -> tuple[RecordedLight, Setup, list[Tracks]]:
    """The light of the recording, the setup without it, and its tracks: flow follows tissue better without."""
    train, tracks = setup.split.train, _tracks(setup)
    veils, steady = tuple[Veil, ...](), setup
    for _ in range(SMOKE_PASSES):
        with setup.timings.measure("motion_s"):
            found = find_veils(setup.clip, train, tracks, steady.clip)
        if not found:
            break
        veils = found
        steady, tracks = _steadied(setup, RecordedLight(veils=veils))
    with setup.timings.measure("motion_s"):
        vignetting = find_vignetting(steady.clip, train, tracks)
    if vignetting is not None:
        steady, tracks = _steadied(steady, RecordedLight(vignetting=vignetting))
    with setup.timings.measure("motion_s"):
        exposure = find_exposure(steady.clip, train, tracks)
    if exposure is not None:
        steady, tracks = _in_one_exposure(steady, exposure, tracks)
    return RecordedLight(exposure, vignetting, veils), steady, tracks


def _in_one_exposure(setup: Setup, exposure: Exposure, tracks: list[Tracks]) -> tuple[Setup, list[Tracks]]:
    """The setup without changes of exposure, and its tracks: of new flow only where the light changes much."""
    light = RecordedLight(exposure=exposure)
    if np.ptp(exposure.log_gains, axis=0).max() > SAME_FLOW:
        return _steadied(setup, light)
    with setup.timings.measure("motion_s"):
        same = [without_gains(each, setup.clip, setup.split.train, exposure.log_gains) for each in tracks]
    return in_light_of(setup, light), same


def _steadied(setup: Setup, light: RecordedLight) -> tuple[Setup, list[Tracks]]:
    """The setup without this light, and its tracks."""
    steady = in_light_of(setup, light)
    return steady, _tracks(steady)


def _tracks(setup: Setup) -> list[Tracks]:
    """Optical-flow tracks of each keyframe, where the preset starts its motion with them."""
    train = setup.split.train
    if not setup.preset.tracks or setup.preset.deformation != SharedBasis.kind or len(train) < 2:
        return []
    with setup.timings.measure("motion_s"):
        tracks = track_keyframes(setup.clip, train, partial(setup.hooks.report_stage, "motion"), setup.split.weights)
    keep_free_memory(LITTLE_BYTES)
    return tracks


def _schedule(run: Run) -> Schedule:
    """The number of iterations and how rates fall. With a budget in seconds, it makes and times the first steps."""
    setup, preset = run.setup, run.preset
    fixed = setup.fixed_iterations
    if fixed is not None:
        return Schedule(fixed, preset.warm_restarts, epoch=run.steps_an_epoch)
    setup.hooks.report_stage("calibrate", 0.0)
    min_gain_db = preset.min_gain_db if run.validation else None
    return measured_schedule(run, setup.budget_s, min_gain_db)
