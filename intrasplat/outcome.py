"""The results of a run: the scene of its model, finished or as a snapshot, and the report's facts about training."""

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
from intrasplat.scene.scene import POSE_WARNINGS, TrainedScene
from intrasplat.splat.metrics import RIGHT_COLOUR
from intrasplat.train.rate_distortion import QuantizedScene
from intrasplat.train.run import Run
from intrasplat.view.recorded import ClipPictures

VERSIONED = ("intrasplat", "torch", "numba")
"""Packages that determine a scene's numbers; the report lists their versions."""


def scene_of(run: Run, on_step: Callable[[], None] = lambda: None) -> TrainedScene:
    """The scene of a trained run, without pictures. Stray Gaussians are removed from its model first; then on_step is
    called."""
    drop_strays(run.model, run.eyes)
    on_step()
    return dataclasses.replace(snapshot_of(run), seen=torch.from_numpy(trust(run.model, run.eyes)), pictures=None)


def snapshot_of(run: Run, *, as_it_lies: bool = False) -> TrainedScene:
    """A copy of the model as it is now. Its visibility is not measured: seen is 0, and so is the confidence.

    as_it_lies: faster, and enough for rendering (Model.export in intrasplat/splat/model.py).
    """
    gaussians, deformation = run.model.export(as_it_lies=as_it_lies)
    clip, keeps = run.setup.clip, run.setup.options.keep_recorded == "on"
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
        pictures=ClipPictures(clip, len(run.eyes), run.setup.split.train) if keeps else None,
        settings={
            "made_iterations": run.iteration,
            "schedule": run.schedule.settings,
            "eyes": run.trained_eyes,
            "pose_warnings": [each.model_dump(mode="json") for each in clip.warnings if each.code in POSE_WARNINGS],
            "preset": json.loads(json.dumps(asdict(run.preset), default=str)),
            **({} if run.motion_error is None else {"motion_error": run.motion_error}),
            **run.light.settings(),
        },
    )


def _right_eye_mm(run: Run) -> tuple[float, float, float] | None:
    """The right eye's position in the left eye's camera axes, mm; None where only the left eye was trained on."""
    if run.right is None:
        return None
    right = run.right.eye
    x, y, z = to_camera(right.world_from_camera[:1, :3, 3], run.setup.clip.world_from_camera[0])[0].tolist()
    return x, y, z


def training_of(run: Run, scene: TrainedScene, quantized: QuantizedScene | None) -> Training:
    """The run's part of the report: settings, choices with their reasons, durations, warnings and versions."""
    light = run.light.changes(run.setup.clip)
    return Training(
        preset=run.preset.name,
        eyes=run.trained_eyes,
        seed=run.seed,
        device=str(run.device),
        iterations=run.iteration,
        frames_seen=run.frames_seen,
        gaussians=len(scene.gaussians),
        bases=scene.deformation.bases,
        scene_bytes=scene.file_bytes,
        units_per_mm=scene.units_per_mm,
        seconds=dict(run.setup.timings.seconds),
        light=light,
        assumptions=(
            *run.light.notices(run.setup.clip, light),
            *run.chosen,
            *run.schedule.notices,
            *(quantized.notices if quantized else (_floats(scene),)),
        ),
        measurements=quantized.measurements if quantized else {},
        warnings=_warnings(run),
        versions={"python": platform.python_version(), **{name: version(name) for name in VERSIONED}},
    )


def _floats(scene: TrainedScene) -> Notice:
    """The notice for a scene that is not quantised."""
    text = f"Numbers are stored as floats, in {scene.file_bytes / 1e6:.2f} MB. All scores are of the stored scene."
    return Notice.info(NoticeCode.STORED_PRECISION, text)


def _warnings(run: Run) -> tuple[Notice, ...]:
    """The warnings of the run itself."""
    found = list(run.light.warnings(run.setup.clip, run.setup.split.train))
    least = max(run.schedule.epoch, run.schedule.opening)
    if run.setup.fixed_iterations is None and run.schedule.planned == least:
        text = (
            f"{run.setup.budget_s:g} s of training are too short for the fewest steps that training makes; they were "
            "made all the same. Give a larger budget_s."
        )
        found.append(Notice.warning(NoticeCode.TIME_TOO_SHORT, text))
    if (run.motion_error or 0) > (255 * RIGHT_COLOUR) ** 2:
        text = (
            "The tissue moves too far from one training frame to the next to be followed: between them its place is a "
            "guess, and confidence is low there. Record more frames a second."
        )
        found.append(Notice.warning(NoticeCode.MOTION_GUESSED, text))
    if run.setup.gpu_is_idle:
        text = f"The motion of preset {run.preset.name} trains on the CPU only, so the GPU was left idle."
        found.append(Notice.warning(NoticeCode.GPU_IDLE, text))
    return tuple(found)
