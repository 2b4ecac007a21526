"""Resume a stopped or killed run from its last stored state; the result is bit-identical to an uninterrupted run.

The state names no device. A run may be resumed on another one, but is then not bit-identical.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from intrasplat.errors import ResumeMismatch, SceneError
from intrasplat.methods.method import Preset
from intrasplat.motion.exposure import Exposure
from intrasplat.notices import Notice
from intrasplat.scene.resume_file import RESUME_FILE, begin_resume, load_resume
from intrasplat.splat.model import Model, state_of
from intrasplat.train.prepare import examine_device, frames_of, in_light_of, new_run
from intrasplat.train.run import CurvePoint, Run
from intrasplat.train.schedule import Schedule
from intrasplat.train.setup import Setup
from intrasplat.train.start import resting_model
from intrasplat.train.targets import TrainingFrames
from intrasplat.vignetting import Vignetting

MISFITS = (KeyError, SceneError, TypeError, ValueError)
"""The errors raised by reading a state that is damaged or belongs to another run."""


def resume(directory: Path, setup: Setup) -> Run | None:
    """The run that is stored in directory, with the setup's clock and timings as they were; None if there is none.

    Points, tracks and the initial model are not computed again: their results are in the state.

    Raises:
        ResumeMismatch: it was started with another preset, seed, length or clip, or cannot be read.
        UnavailableError: the GPU does not work.
        Cancelled: hooks.should_stop() returned True.
    """
    if not (directory / RESUME_FILE).exists():
        return None
    try:
        tensors, state = load_resume(directory)
        preset = _resolved_preset(setup.preset, state["start"])
        exposure = _exposure(state["start"]["exposure"])
        stored = state["start"].get("vignetting")
        vignetting = None if stored is None else Vignetting(*stored)
        frames = frames_of(in_light_of(setup, exposure, vignetting), float(state["start"]["units_per_mm"]))
        _check(state, setup, preset, frames)
        examine_device(setup)
        low, high = state["start"]["box"]
        model = resting_model(state["count"], (low, high), setup, preset)
        _load_parameters(model, tensors)  # a GPU warms up on them
        chosen = tuple(Notice.model_validate(each) for each in state["start"]["chosen"])
        run = new_run(setup, frames, model, preset, chosen, (low, high))
        run.exposure, run.vignetting = exposure, vignetting
        _put(run, tensors, state)
    except MISFITS as error:
        problem = f"{directory / RESUME_FILE} does not continue this request: {str(error).rstrip('.')}."
        raise ResumeMismatch("--out", problem, "Give the options it was started with, or name a new folder.") from error
    before = state["seconds"]
    first_view = {name: before[name] for name in ("t_first_view_s",) if name in before}
    setup.timings.seconds = before | setup.timings.seconds | first_view
    setup.clock.restart(float(state["t_train_s"]))
    return run


def begin_save(directory: Path, run: Run, t_train_s: float) -> Callable[[], None]:
    """Start to write what resume needs: parameters, moments, averages, densification statistics, schedule, curve.

    When this returns, the run may go on. Call what it returns to complete the writing, as with begin_resume.

    Raises:
        OSError: the disk is full or refuses; the state stored before is unchanged.
    """
    trains = 0 < run.iteration < run.iterations
    beta1 = run.preset.rates.beta1
    arrays = state_of(run.model, beta1) if trains else run.model.parameters()  # else moments are not needed
    arrays |= {**run.average.arrays(), **(run.densifier.arrays() if run.densifier else {})}
    state = {
        "identity": _identity(run.setup, run.preset, run.eyes),
        "start": {
            "bases": run.preset.bases,
            "stride": run.preset.fusion.stride,
            "units_per_mm": run.frames.scale,
            "box": run.box,
            "motion_error": run.motion_error,
            "exposure": None if run.exposure is None else [run.exposure.log_gains.tolist(), run.exposure.reference],
            "vignetting": None if run.vignetting is None else astuple(run.vignetting),
            "chosen": [notice.model_dump() for notice in run.chosen],
        },
        "iteration": run.iteration,
        "schedule": run.schedule.settings,
        "count": run.model.count,
        "averaged": run.average.count,
        "t_train_s": t_train_s,
        "seconds": run.setup.timings.seconds,
        "curve": [astuple(point) for point in run.curve],
    }
    return begin_resume(directory, arrays, state, after_each=run.average.let_go)


def _resolved_preset(preset: Preset, start: Mapping[str, Any]) -> Preset:
    """The preset with the bases and the stride that were chosen for the scene when the run started."""
    fusion = dataclasses.replace(preset.fusion, stride=start["stride"])
    return dataclasses.replace(preset.with_bases(start["bases"]), fusion=fusion)


def _exposure(stored: tuple[list[list[float]], int] | None) -> Exposure | None:
    return None if stored is None else Exposure(np.array(stored[0], np.float64), int(stored[1]))


def _load_parameters(model: Model, tensors: dict[str, Tensor]) -> None:
    """Load the stored parameters into a model of the same number of Gaussians."""
    names = model.parameters().keys()
    lacking = names - tensors.keys()
    if lacking:
        raise ValueError(f"it holds no {', '.join(sorted(lacking))}")
    model.load_arrays({name: tensors[name] for name in names})


def _put(run: Run, tensors: dict[str, Tensor], state: Mapping[str, Any]) -> None:
    """Load the stored state into a run that has made no step."""
    run.model.load_arrays(tensors)
    run.average.load_arrays(tensors, state["averaged"])
    if run.densifier is not None:
        run.densifier.load_arrays(tensors)
    run.iteration = state["iteration"]
    run.schedule = Schedule.of(state["schedule"])
    run.motion_error = state["start"]["motion_error"]
    run.curve = [CurvePoint(*row) for row in state["curve"]]


def _check(state: Mapping[str, Any], setup: Setup, preset: Preset, eyes: Sequence[TrainingFrames]) -> None:
    """Raise ValueError if this state belongs to another preset, seed, length or clip."""
    stored = state.get("identity", {})
    own = _identity(setup, preset, eyes)
    differing = [f"another {name}" for name, value in own.items() if stored.get(name) != value]
    if differing:
        raise ValueError(f"the stored run was started with {', '.join(differing)}")


def _identity(setup: Setup, preset: Preset, eyes: Sequence[TrainingFrames]) -> dict[str, str]:
    """What a stored run must share with the one that resumes it, by its name in the error message."""
    fixed = setup.fixed_iterations
    return {
        "preset": preset.name,
        "settings of the preset": hashlib.sha256(repr(preset).encode()).hexdigest(),
        "seed": str(setup.options.seed),
        "length": f"{fixed} iterations" if fixed is not None else f"{setup.budget_s} s",
        "clip, other frames of it, or depth from another device": "".join(eye.digest() for eye in eyes),
    }
