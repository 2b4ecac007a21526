"""A stopped run stores its state in its folder; resumed, it reaches the bits of an uninterrupted run.

The state names no device: a run may be resumed on another one, but then reaches other bits.
"""

from __future__ import annotations

import hashlib
from dataclasses import astuple
from pathlib import Path

import numpy as np

from contract.wire.errors import ResumeMismatch, SceneError
from worker.scene.resume_file import RESUME_FILE, load_resume, save_resume
from worker.train.run import CurvePoint, Run
from worker.train.schedule import Schedule


def resume(out_dir: Path, run: Run) -> float | None:
    """Resume the run stored in out_dir, if there is one; returns its t_train_s.

    Raises:
        ResumeMismatch: it was started with another preset, seed, length or clip, or cannot be read.
    """
    if not (out_dir / RESUME_FILE).exists():
        return None
    try:
        return load_run(out_dir, run)
    except (ValueError, KeyError, SceneError) as error:
        problem = f"{out_dir / RESUME_FILE} does not continue this request: {str(error).rstrip('.')}."
        raise ResumeMismatch("--out", problem, "Give the options it was started with, or name a new folder.") from error


def save_run(directory: Path, run: Run, t_train_s: float) -> None:
    """Write what load_run needs: parameters, moments, averages, densification statistics, schedule, curve."""
    arrays = {**run.model.arrays(), **run.average.arrays(), **(run.densifier.arrays() if run.densifier else {})}
    tensors = {name: values.cpu().contiguous() for name, values in arrays.items()}
    state = {
        "identity": _identity(run),
        "iteration": run.iteration,
        "schedule": run.schedule.settings,
        "count": run.model.count,
        "averaged": run.average.count,
        "t_train_s": t_train_s,
        "curve": [astuple(point) for point in run.curve],
    }
    save_resume(directory, tensors, state)


def load_run(directory: Path, run: Run) -> float:
    """Bring a new run to the state of the stored one; returns its t_train_s.

    Raises:
        SceneError: nothing usable is stored there.
        ValueError: it was started with another preset, seed, length or clip.
    """
    tensors, state = load_resume(directory)
    stored = state.get("identity", {})
    differing = [f"another {name}" for name, own in _identity(run).items() if stored.get(name) != own]
    if differing:
        raise ValueError(f"the stored run was started with {', '.join(differing)}")
    if state["count"] != run.model.count:  # densified since the start
        columns = np.zeros(state["count"], np.int64)
        run.model.take(columns, np.ones(len(columns), np.bool_))
    run.model.load_arrays(tensors)
    run.average.load_arrays(tensors, state["averaged"])
    if run.densifier is not None:
        run.densifier.load_arrays(tensors)
    run.iteration = state["iteration"]
    run.schedule = Schedule.of(state["schedule"])
    run.curve = [CurvePoint(*row) for row in state["curve"]]
    return float(state["t_train_s"])


def _identity(run: Run) -> dict[str, str]:
    """What a stored run must share with the one that resumes it, by the words of the error."""
    return {
        "preset": run.preset.name,
        "settings of the preset": hashlib.sha256(repr(run.preset).encode()).hexdigest(),
        "seed": str(run.seed),
        "length": run.asked,
        "clip, other frames of it, or depth from another device": "".join(eye.digest() for eye in run.eyes),
    }
