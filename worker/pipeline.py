"""The table of contents: a clip becomes a scene, one stage a line. Read the modules in the order of the calls."""

from __future__ import annotations

import dataclasses
import json
import math
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from contract.errors import Cancelled, InputError
from contract.names import CURVE, REPORT, Layout, MaskPolarity, PoseConvention
from contract.report import Report
from worker.backend import CPU, Device, choose_device, device_for
from worker.baselines import copy_baselines
from worker.calibration import rectify
from worker.checkpoint import RESUME_FILE, Scene, save_scene
from worker.clip import ClipLimits, DepthClip, FrameSplit, held_out_frames, split_frames
from worker.compact import compile_coder
from worker.decode import decode_clip
from worker.densify import Densifier
from worker.fusion import fuse
from worker.hooks import Hooks, Progress
from worker.metrics import psnr_tissue
from worker.model import Model
from worker.motion import track
from worker.presets import Preset, preset_named
from worker.quality import Training, View, build_report, measure, sample_frames
from worker.raster.cpu import compile_kernels
from worker.render import model_of
from worker.resume import resume, save_run
from worker.schedule import Schedule, left_out
from worker.shrink import Shrunk, shrink
from worker.start import fusion_for, settled, start_model
from worker.stereo import estimate_depth
from worker.targets import TrainingFrames, solid_depth_mm, units_per_mm
from worker.train import Run, Stopwatch, iterations_within, train, warm_up, write_curve
from worker.visibility import drop_strays, seen_share

_Result = TypeVar("_Result")
Seconds = dict[str, float]  # by stage; each stage that is timed adds its own
VERSIONED = ("intrasplat", "torch", "numba")
"""What decides a scene's numbers; the report names their versions."""


@dataclass(frozen=True)
class ReconstructionRequest:
    """What to reconstruct and how; the fields are those of `intrasplat reconstruct --help`.

    preset is a name, or a preset of the caller's own. budget_s and iterations exclude each other; without either the
    preset decides. accepted_at_s is the Unix time at which the clip was accepted, for t_post_s; None means now.
    limits are what this machine accepts; None means what its memory allows. clip is a path, or a clip with depth that
    is in memory already and is neither decoded nor matched.
    """

    clip: Path | DepthClip
    right: Path | None = None
    layout: Layout = "auto"
    calibration: Path | None = None
    masks: Path | None = None
    mask_polarity: MaskPolarity = "auto"
    pose_convention: PoseConvention = "opengl"
    holdout: str = "every8"
    preset: str | Preset = "fast"
    budget_s: float | None = None
    iterations: int | None = None
    device: str = "auto"
    seed: int = 0
    accepted_at_s: float | None = None
    limits: ClipLimits | None = None


def reconstruct(request: ReconstructionRequest, out_dir: Path, hooks: Hooks) -> Report:
    """Clip in; manifest.json, scene.safetensors, report.json and curve.csv out, in out_dir.

    A stopped run leaves its state in out_dir; the same request on the same folder goes on from there.

    Raises:
        InputError: the clip, its calibration, masks or an option cannot be used.
        UnavailableError: the device is not there, or something it takes.
        TrainingDiverged: training left the finite numbers; nothing is written.
        Cancelled: hooks.should_stop said so.
    """
    accepted_at_s = request.accepted_at_s or time.time()
    named = request.preset
    preset = named if isinstance(named, Preset) else preset_named(named, request.budget_s)
    check_options(request)
    device = device_for(preset.deformation, request.device)
    out_dir.mkdir(parents=True, exist_ok=True)
    seconds: Seconds = {}

    clip = depth_clip_of(request, hooks, seconds, device)
    split = split_frames(clip, request.holdout)
    seconds["compile_s"] = compile_coder()
    if device == CPU:
        seconds["compile_s"] += compile_kernels(partial(report_stage, hooks, "compile"))
    clock = Stopwatch()
    run, scale = prepare(clip, split, preset, request, clock, hooks, seconds, device)
    resumed_s = resume(out_dir, run)
    clock = Stopwatch(resumed_s) if resumed_s is not None else clock
    try:
        optimise(run, clip, split, clock, hooks, seconds)
        scene, shrunk = finish(run, clip, split, hooks, seconds)
        view_of = reporting(run, view_function(run, scale, model_of(scene, device) if shrunk else None), split, hooks)
        report = report_of(run, clip, split, scene, shrunk, request, seconds, view_of, accepted_at_s)
    except Cancelled:
        save_run(out_dir, run, seconds.get("t_train_s", clock.elapsed_s))
        raise
    hooks.on_progress(Progress("score", 1.0, run.iteration, run.iterations, report.psnr_tissue_db))
    publish(out_dir, scene, report, run)
    return report


def check_options(request: ReconstructionRequest) -> None:
    """Refuse a length or seed that cannot be meant; InputError names it."""
    budget_s, iterations = request.budget_s, request.iterations
    if budget_s is not None and iterations is not None:
        problem = f"{budget_s:g} s came together with {iterations} iterations."
        raise InputError("options.budget_s", problem, "Give one of them.")
    if budget_s is not None and not (math.isfinite(budget_s) and budget_s > 0):
        raise InputError("options.budget_s", f"{budget_s:g} s is no time to train in.", "Give seconds above 0.")
    if iterations is not None and iterations < 1:
        raise InputError("options.iterations", f"{iterations} is less than one step.", "Give 1 or more.")
    if request.seed < 0:
        raise InputError("options.seed", f"{request.seed} is negative.", "Give 0 or more.")


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


def depth_clip_of(request: ReconstructionRequest, hooks: Hooks, seconds: Seconds, device: Device = CPU) -> DepthClip:
    """Decode, and for stereo input rectify and match: the left frames with depth."""
    if isinstance(request.clip, DepthClip):
        return request.clip
    path = request.clip
    report_stage(hooks, "decode", 0.0)
    decoded = timed(
        seconds,
        "decode_s",
        lambda: decode_clip(
            path,
            request.right,
            layout=request.layout,
            calibration=request.calibration,
            masks=request.masks,
            mask_polarity=request.mask_polarity,
            pose_convention=request.pose_convention,
            limits=request.limits,
            hooks=hooks,
        ),
    )
    if isinstance(decoded, DepthClip):
        return decoded
    rectified = rectify(decoded.clip, decoded.calibration)
    frame_count = decoded.clip.frame_count
    held_out = set(held_out_frames(frame_count, request.holdout))
    measured = [i for i in range(frame_count) if i not in held_out]
    matched = partial(estimate_depth, rectified, hooks, measured_frames=measured, device=device.kind)
    return timed(seconds, "stereo_s", matched)


def prepare(
    clip: DepthClip,
    split: FrameSplit,
    preset: Preset,
    request: ReconstructionRequest,
    clock: Stopwatch,
    hooks: Hooks | None = None,
    seconds: Seconds | None = None,
    device: Device = CPU,
) -> tuple[Run, float]:
    """Fuse points, start the model, and settle how many iterations are made; seconds by stage go into `seconds`."""
    hooks, seconds = hooks or Hooks(), {} if seconds is None else seconds
    scale = units_per_mm(clip, split.train)
    tracks = None
    if preset.tracks and len(split.train) > 1:
        tracks = timed(
            seconds, "motion_s", lambda: track(clip, split.train, lambda share: report_stage(hooks, "motion", share))
        )
    report_stage(hooks, "fusion", 0.0)
    preset, chosen = timed(seconds, "capacity_s", lambda: settled(preset, tracks, clip, split.train))
    fusion = fusion_for(preset, clip.intrinsics)
    cloud = timed(seconds, "fusion_s", lambda: fuse(clip, split.train, fusion, seed=request.seed))
    report_stage(hooks, "start", 0.0)
    model = timed(
        seconds, "start_s", lambda: start_model(cloud, tracks, clip, split.train, preset, scale, request.seed, device)
    )
    frames = timed(seconds, "targets_s", lambda: TrainingFrames(clip, split.train, scale))
    densifier = Densifier(preset.densify, model.count) if preset.densify else None
    if device != CPU:  # kernels of a GPU are compiled for the model; what that takes is no part of training
        compiled_s = clock.pause(lambda: warm_up(model, frames, preset, partial(report_stage, hooks, "compile")))
        seconds["compile_s"] = seconds.get("compile_s", 0.0) + compiled_s
    schedule, asked = schedule_of(model, frames, preset, request, clock, hooks)
    run = Run(model, frames, preset, schedule, request.seed, asked, densifier=densifier, device=device, chosen=chosen)
    return run, scale


def fixed_iterations(request: ReconstructionRequest, preset: Preset) -> int | None:
    """The iterations that were asked for, or else are the preset's own; None where seconds say how long a run is."""
    return request.iterations or (None if request.budget_s else preset.iterations)


def schedule_of(
    model: Model, frames: TrainingFrames, preset: Preset, request: ReconstructionRequest, clock: Stopwatch, hooks: Hooks
) -> tuple[Schedule, str]:
    """How many iterations are made and how rates fall in them; and, in words, the length that was asked for."""
    count = len(frames.indices)
    fixed = fixed_iterations(request, preset)
    if fixed is not None:
        return Schedule(fixed, preset.cycles, frames=count), f"{fixed} iterations"
    budget_s = request.budget_s or preset.budget_s
    assert budget_s is not None
    report_stage(hooks, "calibrate", 0.0)
    planned = iterations_within(model, frames, preset, request.seed, budget_s, clock.elapsed_s)
    worth_db = preset.worth_db if left_out(frames.indices) else None
    return Schedule(planned, preset.cycles, worth_db, count), f"{budget_s} s"


def optimise(run: Run, clip: DepthClip, split: FrameSplit, clock: Stopwatch, hooks: Hooks, seconds: Seconds) -> None:
    """Train run to its last iteration, scoring held-out frames and showing snapshots on the way."""
    started_s, scale = clock.elapsed_s, run.frames.scale
    view_of = view_function(run, scale)
    train(
        run,
        clock,
        evaluate=lambda: held_out_psnr(clip, split, view_of, hooks),
        hooks=hooks,
        copy_scene=lambda: snapshot_of(run, clip, split, scale, run.seed),
    )
    seconds |= {"optimise_s": clock.elapsed_s - started_s, "t_train_s": clock.elapsed_s}


def finish(run: Run, clip: DepthClip, split: FrameSplit, hooks: Hooks, seconds: Seconds) -> tuple[Scene, Shrunk | None]:
    """What is kept of a trained run, in whole numbers where that loses next to nothing, and what it did lose."""
    hooks.on_progress(Progress("finish", 0.0, run.iteration, run.iterations))
    scene = timed(seconds, "finish_s", lambda: scene_of(run, clip, split, run.frames.scale, run.seed))
    shrunk = timed(seconds, "shrink_s", lambda: shrink(scene, clip, run.frames, device=run.device))
    return (shrunk.scene if shrunk else scene), shrunk


def view_function(run: Run, scale: float, model: Model | None = None) -> Callable[[int], View]:
    """Renders frame i from the endoscope's pose, in mm, of this model instead of the run's own if there is one."""

    def view_of(index: int) -> View:
        image = (model or run.model).render(run.frames.cameras[index], float(run.frames.t[index])).copy()
        return View(image[:3].transpose(1, 2, 0), solid_depth_mm(image[3], image[4], scale), image[4])

    return view_of


def reporting(run: Run, view_of: Callable[[int], View], split: FrameSplit, hooks: Hooks) -> Callable[[int], View]:
    """view_of that reports the scoring of frames as it goes."""
    total, done = len(split.held_out) + len(sample_frames(split.train)), 0

    def reported(index: int) -> View:
        nonlocal done
        latest = run.curve[-1].psnr_tissue_db if run.curve else None
        hooks.on_progress(Progress("score", done / total, run.iteration, run.iterations, latest))
        if hooks.should_stop():
            raise Cancelled("Stopped while scoring.")
        done += 1
        return view_of(index)

    return reported


def held_out_psnr(
    clip: DepthClip, split: FrameSplit, view_of: Callable[[int], View], hooks: Hooks | None = None
) -> float:
    """Mean psnr_tissue over at most sixteen held-out frames, evenly spread; NaN without any."""
    scores = []
    for index in sample_frames(split.held_out, 16):
        view = view_of(index)
        if hooks is not None:
            hooks.on_held_out(index, view)
        if clip.tissue[index].any():  # else it has no score
            scores.append(psnr_tissue(view.rgb, clip.rgb[index], clip.tissue[index]))
    return float(np.mean(scores)) if scores else math.nan


def scene_of(run: Run, clip: DepthClip, split: FrameSplit, scale: float, seed: int) -> Scene:
    """What is kept of a finished run; strays are taken out of its model first."""
    drop_strays(run.model, clip, run.frames)
    seen = torch.from_numpy(seen_share(run.model, clip, run.frames))
    return dataclasses.replace(snapshot_of(run, clip, split, scale, seed), seen=seen)


def snapshot_of(run: Run, clip: DepthClip, split: FrameSplit, scale: float, seed: int) -> Scene:
    """A copy of what training has come to. Nobody has looked yet what it saw: seen is 0, and so is the confidence."""
    gaussians, deformation = run.model.export()
    return Scene(
        gaussians=gaussians,
        deformation=deformation,
        intrinsics=clip.intrinsics,
        world_from_camera=clip.world_from_camera,
        frame_times_s=clip.frame_times_s,
        units_per_mm=scale,
        preset=run.preset.name,
        trained_t=tuple(float(clip.t[i]) for i in split.train),
        seen=torch.zeros(len(gaussians)),
        seed=seed,
        settings={
            "made_iterations": run.iteration,
            "schedule": run.schedule.settings,
            "preset": json.loads(json.dumps(asdict(run.preset), default=str)),
        },
    )


def report_of(
    run: Run,
    clip: DepthClip,
    split: FrameSplit,
    scene: Scene,
    shrunk: Shrunk | None,
    request: ReconstructionRequest,
    seconds: Seconds,
    view_of: Callable[[int], View],
    accepted_at_s: float,
) -> Report:
    """Score the held-out frames beside the copy baselines and say what to distrust.

    The curve's last point becomes the score over all held-out frames of the model as it is kept; the points before it
    are over at most sixteen of them.
    """
    start = time.perf_counter()
    held_out = measure(clip, split.held_out, view_of)
    trained = measure(clip, sample_frames(split.train), view_of)
    baselines = copy_baselines(clip, split.train, split.held_out)
    seconds |= {"score_s": time.perf_counter() - start, "t_post_s": time.time() - accepted_at_s}
    training = training_of(run, scene, shrunk, request, seconds)
    report = build_report(clip, split, held_out, trained, baselines, training)
    if report.psnr_tissue_db is not None and run.curve:
        run.curve[-1] = dataclasses.replace(run.curve[-1], psnr_tissue_db=report.psnr_tissue_db)
    return report


def training_of(
    run: Run, scene: Scene, shrunk: Shrunk | None, request: ReconstructionRequest, seconds: Seconds
) -> Training:
    """What the report repeats of the run: what it was made of, what it chose, how long it took."""
    return Training(
        preset=run.preset.name,
        seed=run.seed,
        device=str(run.device),
        iterations=run.iteration,
        gaussians=len(scene.gaussians),
        bases=scene.deformation.bases,
        scene_bytes=scene.file_bytes,
        units_per_mm=scene.units_per_mm,
        seconds=seconds,
        assumptions=(*run.chosen, *run.schedule.words, *(shrunk.words if shrunk else ())),
        measurements=shrunk.measurements if shrunk else {},
        warnings=training_warnings(run, request),
        versions={"python": platform.python_version(), **{name: version(name) for name in VERSIONED}},
    )


def training_warnings(run: Run, request: ReconstructionRequest) -> tuple[str, ...]:
    """What the run itself has to say."""
    said = []
    if fixed_iterations(request, run.preset) is None and run.schedule.planned == len(run.frames.indices):
        said.append("The time given allowed less than one step a training frame; one a frame was made all the same.")
    if run.device != choose_device(request.device):
        said.append(f"The motion of preset {run.preset.name} trains on the CPU only, so the GPU was left idle.")
    return tuple(said)


def publish(out_dir: Path, scene: Scene, report: Report, run: Run) -> None:
    """Write the report, the curve and the scene; what was kept of a stopped run is not needed any more."""
    (out_dir / REPORT).write_text(report.model_dump_json(indent=1))
    write_curve(out_dir / CURVE, run)
    save_scene(out_dir, scene, beside=(REPORT, CURVE))
    (out_dir / RESUME_FILE).unlink(missing_ok=True)
