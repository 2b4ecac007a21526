"""The table of contents: a clip becomes a scene, one stage per line. Read the modules in the order of the calls."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from intrasplat.clip import DepthClip, FrameSplit, split_frames, training_frames
from intrasplat.clip.sampling import most_frames
from intrasplat.clip.shown import with_shown_parts
from intrasplat.errors import Cancelled, InputError, TrainingDiverged
from intrasplat.instruments import zipped_masks
from intrasplat.machine.cores import cores
from intrasplat.machine.forecast import TimeEstimate
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.memory import LITTLE_BYTES, USUAL_BYTES, keep_free_memory
from intrasplat.machine.timing import Timings
from intrasplat.names import CURVE, DETAIL, MASKS, REPORT
from intrasplat.notices import Notice
from intrasplat.outcome import scene_of, snapshot_of, training_of
from intrasplat.poses import placed, read_poses, with_poses
from intrasplat.quality.checks import clip_warnings
from intrasplat.quality.report import first_report
from intrasplat.quality.score import score_model
from intrasplat.report import Recorded, Report
from intrasplat.scene.checkpoint import load_scene, save_scene
from intrasplat.scene.compact import compile_coder
from intrasplat.scene.recorded_file import EYES
from intrasplat.scene.results import add_scores, without_scores
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.training_pictures import StoredPictures
from intrasplat.splat.backend import CPU, Device, choose_device, device_for, examine
from intrasplat.splat.cpu import compile_kernels
from intrasplat.splat.deformation import motion_named
from intrasplat.stereo import ClipPaths, open_with_depth
from intrasplat.train.first_picture import first_picture
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.persistence import Keeper, keeping
from intrasplat.train.prepare import prepare
from intrasplat.train.rate_distortion import QuantizedScene, round_model
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.resume import resume
from intrasplat.train.run import Run, write_curve
from intrasplat.train.scoring import held_out_score
from intrasplat.train.setup import Setup, length_of
from intrasplat.view.recorded import ClipPictures, recorded_files
from intrasplat.view.renderer import SceneRenderer
from intrasplat.view.transfer import compile_transfer

SHRINKING = 0.15
"""Share of the training budget after which no coarser quantisation is tried."""
FINISHING_STEPS = 7
"""Progress reports of finish() when round_model tries three steps; more trials stay at 100 %."""


@dataclass(eq=False)
class Made:
    """A finished scene, and all that score_scene() needs; score_scene() deletes the scene from it."""

    clip: DepthClip
    split: FrameSplit
    scene: TrainedScene
    report: Report
    device: Device


def reconstruct(request: ReconstructionRequest, out_dir: Path, hooks: TrainingHooks) -> Report:
    """Reconstruct a clip: write manifest.json, scene.safetensors, report.json and curve.csv into out_dir.

    It also writes recorded.zip, unless the options turn that off, and masks.zip if masks were found. If the run is
    stopped or killed, the same request on the same folder resumes it.

    Raises:
        InputError: the clip, its calibration, masks or an option cannot be used.
        UnavailableError: the device is missing, or something that it needs.
        TrainingDiverged: training produced NaN or infinity.
        Cancelled: hooks.should_stop() returned True. If that was during scoring, the scene is complete without scores.
    """
    made = make(request, out_dir, hooks)
    try:
        report = score_scene(made, hooks)
    except (Cancelled, TrainingDiverged) as error:
        add_scores(out_dir, without_scores(made.report, error.code))
        raise
    add_scores(out_dir, report)
    return report


def make(request: ReconstructionRequest, out_dir: Path, hooks: TrainingHooks, resume_dir: Path | None = None) -> Made:
    """Like reconstruct, without the scores: the scene in out_dir is complete and can be viewed.

    resume_dir: folder for the state that the same request resumes from; the caller removes it. None: out_dir.
    """
    length, report_progress = length_of(request.options, request.preset), hooks.on_progress
    forecast = TimeEstimate(*length, most_frames(request.options))
    hooks = dataclasses.replace(hooks, on_progress=lambda progress: report_progress(forecast.completed(progress)))
    with keeping(resume_dir or out_dir, forgets=resume_dir is None) as keeper:
        setup = begin(request, out_dir, hooks, keeper)
        used = len(setup.clip.used)
        forecast.learn(used, used * setup.clip.tissue[0].size / 1e6)
        run = resume(keeper.folder, setup) or prepare(setup)
        optimise(run, keeper)
        with ThreadPoolExecutor(1) as background:
            warnings = background.submit(clip_warnings, setup.clip, setup.split.train)
            masks, recorded = background.submit(zipped_masks, setup.clip), background.submit(recorded_frames, run)
            scene, quantized = finish(run)
        frames, summary = recorded.result()
        beside = {name: each for name, each in {MASKS: masks.result(), **frames}.items() if each is not None}
        report = publish(out_dir, run, scene, quantized, warnings.result(), beside, summary)
    if DETAIL in beside:
        own = ClipPictures(setup.clip, len(run.eyes), setup.split.train)
        pictures = StoredPictures(beside[DETAIL], lambda eye, frame: own.picture(eye, frame)[1])
        scene = dataclasses.replace(scene, pictures=pictures)  # the caller may move the folder
    return Made(setup.clip, setup.split, scene, report, setup.device)


def score_scene(made: Made, hooks: Hooks) -> Report:
    """The report with the scores of the scene as it is stored.

    Raises:
        TrainingDiverged: a render holds NaN or infinity.
        Cancelled: hooks.should_stop() returned True.
    """
    renderer = SceneRenderer(made.scene, made.device)
    del made.scene  # the renderer has the weights, and they take much memory
    detailed = None if renderer.detail is None else partial(renderer.seen_from, detail=True)
    return score_model(made.report, made.clip, made.split.train, renderer.seen_from, hooks, detailed)


def score_stored_scene(request: ReconstructionRequest, directory: Path, hooks: TrainingHooks) -> Report:
    """Like score_scene, for the stored scene in a directory: opens its clip again, placed at the scene's poses.

    Raises:
        InputError: the clip, its calibration, masks or an option cannot be used.
        SceneError: the scene is missing or damaged.
    """
    device = device_for(request.preset.deformation, request.device)
    scene, resting = load_scene(directory), request.options.model_copy(update={"poses": "fixed"})
    clip = open_with_poses(dataclasses.replace(request, options=resting, poses=None), hooks, Timings(), device)
    report = Report.model_validate_json((directory / REPORT).read_bytes())
    unplaced = () if report.poses is None or report.poses.source != "estimated" else report.poses.unsure_frames
    clip = dataclasses.replace(placed(clip, scene.world_from_camera), skipped=tuple(sorted({*clip.skipped, *unplaced})))
    split = split_frames(clip, request.options.holdout)
    return score_scene(Made(clip, split, scene, report, device), hooks)


def begin(request: ReconstructionRequest, out_dir: Path, hooks: TrainingHooks, keeper: Keeper) -> Setup:
    """Open the clip with depth, split it, choose the device and compile the kernels; then the clock starts."""
    accepted_at_s, timings = request.accepted_at_s or time.time(), Timings()
    timings.seconds |= request.seconds
    keep_free_memory(USUAL_BYTES)
    options, preset = request.options, request.preset
    device = device_for(preset.deformation, request.device)
    out_dir.mkdir(parents=True, exist_ok=True)

    def show(moment: DepthClip) -> None:
        with suppress(InputError):  # no depth in this frame; a later stage raises if no frame has any
            if hooks.on_first_picture is not None:
                hooks.on_first_picture(first_picture(moment))
            timings.seconds["t_first_view_s"] = time.time() - accepted_at_s

    showing = dataclasses.replace(hooks, on_first_moment=show)
    clip = keeper.clip(request, lambda: open_with_poses(request, showing, timings, device))
    if "t_first_view_s" not in timings.seconds:  # the clip was stored with its depth, or its first moment has none
        frames = training_frames(clip.frame_count, options.holdout)
        moment = next((i for i in frames if (clip.tissue[i] & (clip.depth_mm[i] > 0)).any()), frames[0])
        show(clip.moment(moment))
    hooks.on_clip(clip)
    split = split_frames(clip, options.holdout)
    keep_free_memory(USUAL_BYTES)
    timings.add("compile_s", compile_coder() + compile_transfer())
    if device == CPU:
        timings.add("compile_s", compile_kernels(partial(hooks.report_stage, "compile")))
    by_kernels = motion_named(preset.deformation).has_kernels  # kernels have their own threads, so torch needs one
    torch.set_num_threads(1 if by_kernels else cores())
    idle = device != choose_device(request.device)
    return Setup(clip, split, preset, options, device, hooks, timings, accepted_at_s=accepted_at_s, gpu_is_idle=idle)


def open_with_poses(request: ReconstructionRequest, hooks: Hooks, timings: Timings, device: Device = CPU) -> DepthClip:
    """The clip of a request with depth (intrasplat/stereo/opening.py) and camera poses (intrasplat/poses/posed.py).

    On a GPU the splatting kernels are checked before stereo matching.
    """
    stored = read_poses(request.poses) if isinstance(request.poses, Path) else request.poses
    if isinstance(request.clip, DepthClip):
        clip = request.clip if request.clip.fov is not None else with_shown_parts(request.clip, request.options)
        return with_poses(clip, request.options, hooks, timings, stored)

    def examined() -> None:
        if device != CPU:
            hooks.report_stage("compile", 0.0)
            timings.add("compile_s", examine(device))

    paths = ClipPaths(request.clip, request.right, request.calibration, request.masks, request.fov_mask)
    clip = open_with_depth(
        paths,
        request.options,
        hooks,
        timings,
        limits=request.limits,
        device=device.kind,
        before_matching=examined,
        segmenter=request.segmenter,
    )
    return with_poses(clip, request.options, hooks, timings, stored)


def optimise(run: Run, keeper: Keeper) -> None:
    """Train run to its last iteration; meanwhile score held-out frames, store its state and offer snapshots."""
    clock, started_s, timings = run.setup.clock, run.setup.clock.elapsed_s, run.setup.timings
    timings.seconds.setdefault("t_first_view_s", time.time() - run.setup.accepted_at_s)
    scored, shown = partial(held_out_score, run), partial(snapshot_of, run, as_it_lies=True)
    try:
        train(run, clock, scored, run.setup.hooks, copy_scene=shown, keep=keeper.keep_if_due)
    except Cancelled:
        keeper.keep(run)
        raise
    timings.seconds |= {"optimise_s": clock.elapsed_s - started_s, "t_train_s": clock.elapsed_s}
    keeper.keep(run)
    keep_free_memory(LITTLE_BYTES)


def finish(run: Run) -> tuple[TrainedScene, QuantizedScene | None]:
    """The scene to store, and what quantisation cost, if it is quantised. It deletes the run's model.

    Raises:
        Cancelled: hooks.should_stop() returned True.
    """
    timings, reached = run.setup.timings, itertools.count()

    def report() -> None:
        run.setup.hooks.on_progress(run.progress("finish", min(next(reached) / FINISHING_STEPS, 1.0)))
        if run.setup.hooks.should_stop():
            raise Cancelled("Stopped while the scene was finished.")

    report()
    with timings.measure("finish_s"):
        scene = scene_of(run, report).without_motion()  # no second copy of the weights, which take much memory
    with timings.measure("shrink_s"):
        _, budget_s = length_of(run.setup.options, run.setup.preset)
        limit_s = math.inf if budget_s is None else SHRINKING * budget_s
        rounded = round_model(run.model, scene, run.eyes, device=run.device, on_step=report, limit_s=limit_s)
        keep_free_memory(LITTLE_BYTES)
        if rounded is None:
            return dataclasses.replace(scene, deformation=run.model.export()[1]), None
        del run.model  # frees its weights before the stored ones are created
        quantized = rounded.stored(scene)
    return quantized.scene, quantized


def recorded_frames(run: Run) -> tuple[dict[str, bytes | None], Recorded | None]:
    """The files of recorded frames of the eyes trained on, and the report's entry for them; {}, None if turned off."""
    if run.setup.options.keep_recorded == "off":
        return {}, None
    with run.setup.timings.measure("recorded_s"):
        return recorded_files(run.setup.clip, EYES[: len(run.eyes)], run.setup.split.train)


def publish(
    out_dir: Path,
    run: Run,
    scene: TrainedScene,
    quantized: QuantizedScene | None,
    warnings: Sequence[Notice],
    beside: Mapping[str, bytes],
    recorded: Recorded | None,
) -> Report:
    """Write the report, the curve, the scene and the files `beside` it, by name. The report has no scores yet."""
    setup = run.setup
    setup.timings.seconds["t_post_s"] = time.time() - setup.accepted_at_s
    report = first_report(setup.clip, setup.split, training_of(run, scene, quantized), warnings)
    report = report.model_copy(update={"recorded": recorded})
    (out_dir / REPORT).write_text(report.model_dump_json(indent=1))
    write_curve(out_dir / CURVE, run)
    save_scene(out_dir, scene, beside)
    return report
