"""The table of contents: a clip becomes a scene, one stage a line. Read the modules in the order of the calls."""

from __future__ import annotations

import dataclasses
import json
import platform
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path

import torch

from contract.wire.errors import Cancelled
from contract.wire.names import CURVE, REPORT
from contract.wire.report import Report
from worker.input.calibration import rectify
from worker.input.clip import DepthClip, FrameSplit, held_out_frames, split_frames
from worker.input.decode import decode_clip
from worker.machine.hooks import Hooks, Progress
from worker.raster.backend import CPU, Device, choose_device, device_for, examine
from worker.raster.cpu import compile_kernels
from worker.render.shrink import Shrunk, shrink
from worker.render.view import model_of
from worker.report.baselines import copy_baselines
from worker.report.quality import Training, build_report, measure
from worker.report.visibility import drop_strays, seen_share
from worker.scene.checkpoint import save_scene
from worker.scene.compact import compile_coder
from worker.scene.resume_file import RESUME_FILE
from worker.scene.scene import Scene
from worker.stereo import estimate_depth
from worker.train.looking import View, held_out_psnr, sample_frames, view_function
from worker.train.loop import Run, Stopwatch, train, write_curve
from worker.train.prepare import Seconds, fixed_iterations, prepare, report_stage, timed
from worker.train.presets import preset_named
from worker.train.request import ReconstructionRequest
from worker.train.resume import resume, save_run

VERSIONED = ("intrasplat", "torch", "numba")
"""What decides a scene's numbers; the report names their versions."""


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
    options = request.options
    preset = request.own_preset or preset_named(options.preset, options.budget_s)
    device = device_for(preset.deformation, request.device)
    out_dir.mkdir(parents=True, exist_ok=True)
    seconds: Seconds = {}

    clip = depth_clip_of(request, hooks, seconds, device)
    split = split_frames(clip, options.holdout)
    seconds["compile_s"] = seconds.get("compile_s", 0.0) + compile_coder()
    if device == CPU:
        seconds["compile_s"] += compile_kernels(partial(report_stage, hooks, "compile"))
    clock = Stopwatch()
    run, scale = prepare(clip, split, preset, options, clock, hooks, seconds, device)
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
            calibration=request.calibration,
            masks=request.masks,
            options=request.options,
            limits=request.limits,
            hooks=hooks,
        ),
    )
    if isinstance(decoded, DepthClip):
        return decoded
    rectified = rectify(decoded.clip, decoded.calibration)
    frame_count = decoded.clip.frame_count
    held_out = set(held_out_frames(frame_count, request.options.holdout))
    measured = [i for i in range(frame_count) if i not in held_out]
    if device != CPU:  # before it matches anything
        report_stage(hooks, "compile", 0.0)
        seconds["compile_s"] = seconds.get("compile_s", 0.0) + examine(device)
    matched = partial(estimate_depth, rectified, hooks, measured_frames=measured, device=device.kind)
    return timed(seconds, "stereo_s", matched)


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
        frames_seen=run.frames_seen,
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
    if fixed_iterations(request.options, run.preset) is None and run.schedule.planned == run.schedule.epoch:
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
