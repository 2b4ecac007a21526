"""What becomes of a run: the scene of its model, finished or at any moment, and what its report repeats of it."""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version

import torch

from intrasplat.camera import to_camera
from intrasplat.notices import Notice, NoticeCode
from intrasplat.quality.report import Training
from intrasplat.quality.trust import trust
from intrasplat.quality.visibility import drop_strays
from intrasplat.scene.scene import POSE_DOUBTS, TrainedScene
from intrasplat.train.rate_distortion import QuantizedScene
from intrasplat.train.run import Run

VERSIONED = ("intrasplat", "torch", "numba")
"""What decides a scene's numbers; the report names their versions."""


def scene_of(run: Run, on_step: Callable[[], None] = lambda: None) -> TrainedScene:
    """The scene of a trained run; strays are removed from its model first. on_step is called after that."""
    drop_strays(run.model, run.eyes)
    on_step()
    return dataclasses.replace(snapshot_of(run), seen=torch.from_numpy(trust(run.model, run.eyes)))


def snapshot_of(run: Run, *, as_it_lies: bool = False) -> TrainedScene:
    """A copy of the model as it is now. What it saw is not measured: seen is 0, and so is the confidence.

    as_it_lies: for renders alone, and faster (intrasplat/splat/model.py, export).
    """
    gaussians, deformation = run.model.export(as_it_lies=as_it_lies)
    clip = run.setup.clip
    return TrainedScene(
        gaussians=gaussians,
        deformation=deformation,
        intrinsics=clip.intrinsics,
        world_from_camera=clip.world_from_camera,
        frame_times_s=clip.frame_times_s,
        units_per_mm=run.frames.scale,
        preset=run.preset.name,
        trained_t=tuple(float(clip.t[i]) for i in run.setup.split.train),
        seen=torch.zeros(len(gaussians)),
        right_eye_mm=_right_eye_mm(run),
        seed=run.seed,
        settings={
            "made_iterations": run.iteration,
            "schedule": run.schedule.settings,
            "eyes": run.taught_by,
            "pose_warnings": [each.model_dump(mode="json") for each in clip.warnings if each.code in POSE_DOUBTS],
            "preset": json.loads(json.dumps(asdict(run.preset), default=str)),
        },
    )


def _right_eye_mm(run: Run) -> tuple[float, float, float] | None:
    """Where the right eye is in the left one's camera axes; None where the left eye alone taught."""
    if run.right is None:
        return None
    right = run.right.eye
    x, y, z = to_camera(right.world_from_camera[:1, :3, 3], run.setup.clip.world_from_camera[0])[0].tolist()
    return x, y, z


def training_of(run: Run, scene: TrainedScene, quantized: QuantizedScene | None) -> Training:
    """What the report repeats of the run: what it was made of, what it chose, how long it took."""
    return Training(
        preset=run.preset.name,
        eyes=run.taught_by,
        seed=run.seed,
        device=str(run.device),
        iterations=run.iteration,
        frames_seen=run.frames_seen,
        gaussians=len(scene.gaussians),
        bases=scene.deformation.bases,
        scene_bytes=scene.file_bytes,
        units_per_mm=scene.units_per_mm,
        seconds=dict(run.setup.timings.seconds),
        assumptions=(*run.chosen, *run.schedule.notices, *(quantized.notices if quantized else (_floats(scene),))),
        measurements=quantized.measurements if quantized else {},
        warnings=_warnings(run),
        versions={"python": platform.python_version(), **{name: version(name) for name in VERSIONED}},
    )


def _floats(scene: TrainedScene) -> Notice:
    """What is said of a scene that is not quantized."""
    text = f"Numbers are stored as floats, in {scene.file_bytes / 1e6:.2f} MB. All scores are of the stored scene."
    return Notice.info(NoticeCode.STORED_PRECISION, text)


def _warnings(run: Run) -> tuple[Notice, ...]:
    """The warnings of the run itself."""
    found = []
    least = max(run.schedule.epoch, run.schedule.opening)
    if run.setup.fixed_iterations is None and run.schedule.planned == least:
        text = (
            f"{run.setup.budget_s:g} s of training are too short for the fewest steps that training makes; they were "
            "made all the same. Give a larger budget_s."
        )
        found.append(Notice.warning(NoticeCode.TIME_TOO_SHORT, text))
    if run.setup.gpu_is_idle:
        text = f"The motion of preset {run.preset.name} trains on the CPU only, so the GPU was left idle."
        found.append(Notice.warning(NoticeCode.GPU_IDLE, text))
    return tuple(found)
