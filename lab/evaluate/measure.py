"""Measures one cell: trains it with `reconstruct` itself, then scores the stored scene. Gives a row and a curve.

Symbols: N Gaussians, T frames.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import shlex
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, split_frames
from intrasplat.commands.exits import flag_of
from intrasplat.errors import InputError
from intrasplat.machine.timing import Timings
from intrasplat.names import CURVE, REPORT, DeviceName
from intrasplat.pipeline import open_with_poses, reconstruct
from intrasplat.report import Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.model import model_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import Device, choose_device
from intrasplat.splat.metrics import depth_agreement_mm, depth_errors_mm, psnr_tissue, ssim
from intrasplat.splat.step import camera_vector
from intrasplat.train.hooks import RenderedFrame, TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.targets import camera_in_units
from lab.evaluate.cells import BOTH_EYES, Cell, eyes_of, is_rival_system, options_of, own_preset_of
from lab.evaluate.right_eye import right_eye_ranks
from lab.evaluate.rows import COPIES, KEY, NO_RESULT, SCORES, commit, machine
from lab.evaluate.sources import OpenClip, Source, open_source
from lab.evaluate.thinned import thinned
from lab.evaluate.truth import Candidate, SceneCandidate, Truth
from lab.rivals import RAY_BY_RAY, RIVAL_SYSTEMS, scored_step_px
from lab.rivals.run import Length, Make, RivalCandidate, every_core, run_rival

UNTIMED_RENDERS, TIMED_RENDERS = 5, 40
"""Numbers of renders at different times: untimed ones that fill caches, then timed ones, whose median counts."""
MAX_TIMING_S = 30.0
"""Timing stops after this long."""
MAX_ERROR_CHARACTERS = 300
OF_WHOLE_PICTURES = ("ssim", "psnr_clear_db", "psnr_right_clear_db", *COPIES)
"""Figures that depend on a pixel's neighbours, so a lattice of pixels cannot have them."""
OPAQUE = ("coverage", "seen_ok")
"""Figures that are always 1 for a method that renders ray by ray."""
WHY_OPAQUE = "coverage and seen_ok: the last sample of a ray is opaque"
WHY_THINNED = (
    "whole pictures: ssim, clear and the copies need neighbours, and scores are of every {0}th pixel of every {0}th row"
)

Values = dict[str, object]


@dataclass
class Bench:
    """Opens clips and measures cells on them. Keeps the last clip and truth for the next cell.

    A scene that is trained on the device is scored by CPU renders, so that all rows are comparable. A rival is scored
    on its device; on a CPU, one that renders ray by ray is scored on fewer pixels (lab/evaluate/thinned.py).
    """

    sources: Mapping[str, Source]
    device: DeviceName = "auto"
    rivals: Mapping[str, Make] = field(default_factory=lambda: RIVAL_SYSTEMS)
    _commit: str = field(default_factory=commit)  # of the code as it was loaded; the tree may go on while this runs
    _open: dict[tuple[str, str], OpenClip] = field(default_factory=dict)
    _truth: dict[tuple[str, str, int], Truth] = field(default_factory=dict)

    def measure(self, cell: Cell, hooks: TrainingHooks) -> tuple[Values, list[Values]]:
        """The row and the curve of a cell; a failure's row says why in `error` and has no curve.

        Raises:
            Cancelled: hooks.should_stop returned True.
            UnavailableError: this machine lacks something, such as the device or disk space.
        """
        source = self.sources[cell.clip]
        row: Values = {
            **dict(zip(KEY, cell.key, strict=True)),
            "load_1min": os.getloadavg()[0],
            "command": command_of(cell, source, self.device),
        }
        row |= {"machine": machine(), "commit": self._commit}
        try:
            values, curve = self._measured(cell, source, hooks)
        except NO_RESULT:
            raise
        except Exception as error:
            problem = " ".join(str(error).split())
            return {**row, "error": f"{type(error).__name__}: {problem}"[:MAX_ERROR_CHARACTERS]}, []
        return {**row, **values}, curve

    def _measured(self, cell: Cell, source: Source, hooks: TrainingHooks) -> tuple[Values, list[Values]]:
        place = (cell.clip, cell.holdout)
        if place not in self._open:
            self._open.clear()
            self._truth.clear()
            self._open[place] = open_source(source, cell.holdout, hooks, choose_device(self.device))
        opened = self._open[place]
        if opened.clip.right is None and eyes_of(cell.series) != BOTH_EYES:
            problem = f"{cell.clip} has one eye, so {cell.series!r} would be measured like both eyes."
            raise InputError("--eyes", problem, "Leave it out.")
        if is_rival_system(cell.series):
            with every_core():
                return self._measured_rival(cell, opened, hooks)
        request = ReconstructionRequest(
            clip=opened.clip,
            options=options_of(cell),
            own_preset=own_preset_of(cell.series),
            device=self.device,
            accepted_at_s=time.time() - sum(opened.seconds.values()),
        )
        on_the_way = _OnTheWay(opened.clip)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder)
            report = reconstruct(request, out, dataclasses.replace(hooks, on_held_out=on_the_way.judge))
            with (out / CURVE).open(newline="") as file:
                curve: list[Values] = [dict(point) for point in csv.DictReader(file)]
            scene = load_scene(out)
            kept = [path for path in out.iterdir() if path.name not in (REPORT, CURVE)]
            scene_bytes = sum(path.stat().st_size for path in kept)
        seconds = seconds_of(report.seconds, opened.seconds, on_the_way.took_s)
        values = (
            _reported(report, seconds)
            | _size(scene)
            | _speed(scene_renderer(scene, choose_device(self.device)), report)
        )
        values |= {
            "machine": machine(report.device),
            "scene_bytes": scene_bytes,
            "stored_loss_held_out_db": _stored_loss_held_out_db(report, on_the_way.last_db),
        }
        if curve:  # else there was no tissue to score
            curve = on_the_way.completed(curve)
            # its end is scored on all held-out frames of the model as it is kept
            curve[-1] |= {"ssim": report.ssim, "depth_agreement_mm": report.depth_agreement_mm}
        if opened.phantom is None:
            return values | right_eye_ranks(scene, opened.clip, report.held_out), curve
        return values | self._true(cell, opened, SceneCandidate(scene), report), curve

    def _measured_rival(self, cell: Cell, opened: OpenClip, hooks: TrainingHooks) -> tuple[Values, list[Values]]:
        """As measure(), for a rival, which has no scene."""
        device, timings, options = choose_device(self.device), Timings(), options_of(cell)
        timings.seconds.update(opened.seconds)
        clip = open_with_poses(ReconstructionRequest(opened.clip, options), hooks, timings, device)
        step_px = scored_step_px(cell.series, device, clip.intrinsics.width)
        on_the_way = _OnTheWay(thinned(clip, step_px))
        fitted = run_rival(
            cell.series,
            self.rivals[cell.series],
            clip,
            split_frames(clip, cell.holdout),
            Length(cell.iterations, cell.budget_s),
            seed=cell.seed,
            device=device,
            waited_s=sum(timings.seconds.values()),
            hooks=dataclasses.replace(hooks, on_held_out=on_the_way.judge),
            step_px=step_px,
        )
        report, rival = fitted.report, fitted.rival
        curve: list[Values] = [dataclasses.asdict(point) for point in fitted.curve]
        if curve:  # else there was no tissue to score
            curve = on_the_way.completed(curve, in_t_post_s=False)
            curve[-1] |= {"ssim": report.ssim, "depth_agreement_mm": report.depth_agreement_mm}
        pose, camera = clip.world_from_camera[0], clip.intrinsics
        speed = _speed(lambda t: rival.render(t, pose, camera), report)
        values = _reported(report, {**timings.seconds, **report.seconds}) | speed
        values |= {"machine": machine(report.device), "scene_bytes": report.scene_bytes, "bases": None}
        values |= {"gaussians": rival.gaussians or None, "width": camera.width, "height": camera.height}
        cannot: list[str] = []
        why = [rival.not_measured]
        if cell.series in RAY_BY_RAY:
            cannot.extend(OPAQUE)
            why.append(WHY_OPAQUE)
        if step_px > 1:
            cannot.extend(OF_WHOLE_PICTURES)
            why.append(WHY_THINNED.format(step_px))
            curve = [{**point, "ssim": None} for point in curve]
        if opened.phantom is not None:
            values |= self._true(cell, opened, RivalCandidate(fitted, clip, step_px), report, step_px)
        return values | dict.fromkeys(cannot) | {"not_measured": "; ".join(why)}, curve

    def _true(self, cell: Cell, opened: OpenClip, candidate: Candidate, report: Report, step_px: int = 1) -> Values:
        """The scores of a phantom's candidate against the truth, on a lattice of pixels."""
        if opened.phantom is None or not report.held_out:
            return {}
        place = (cell.clip, cell.holdout, step_px)
        if place not in self._truth:
            unused = {*report.held_out, *report.repeated}
            train = [frame for frame in range(report.frame_count) if frame not in unused]
            self._truth[place] = Truth(
                opened.phantom, opened.tissue, train, report.held_out, opened.tissue_right, step_px
            )
        return dataclasses.asdict(self._truth[place].score(candidate))


class _OnTheWay:
    """SSIM and depth agreement of the held-out frames, each time they are scored during training.

    last_db  the psnr_tissue of each frame of the last scoring: of the model as training left it
    took_s   what judging has taken so far; nobody who reconstructs a clip waits for it
    """

    def __init__(self, clip: DepthClip) -> None:
        self.last_db: dict[int, float] = {}
        self.took_s = 0.0
        self._clip, self._last = clip, -1
        self._before_s: list[float] = []
        self._ssim: list[list[float]] = []
        self._errors_mm: list[list[NDArray[np.float32]]] = []

    def judge(self, frame: int, view: RenderedFrame) -> None:
        """Frames come in rising order; one that does not rise begins the next scoring."""
        start = time.perf_counter()
        if frame <= self._last or not self._ssim:
            self.last_db.clear()
            self._before_s.append(self.took_s)
            self._ssim.append([])
            self._errors_mm.append([])
        self._last = frame
        truth, tissue = self._clip.rgb[frame], self._clip.tissue[frame]
        self.last_db[frame] = psnr_tissue(view.rgb, truth, tissue)
        self._ssim[-1].append(ssim(view.rgb, truth, tissue))
        self._errors_mm[-1].append(depth_errors_mm(view.depth_mm, self._clip.depth_mm[frame], tissue))
        self.took_s += time.perf_counter() - start

    def completed(self, curve: Sequence[Values], *, in_t_post_s: bool = True) -> list[Values]:
        """The points of curve.csv with both scores, and with a t_post_s that judging is taken out of if it is there."""
        return [
            {
                **point,
                "t_post_s": float(str(point["t_post_s"])) - before_s * in_t_post_s,
                "ssim": _mean_of_known(found),
                "depth_agreement_mm": depth_agreement_mm(errors),
            }
            for point, before_s, found, errors in zip(curve, self._before_s, self._ssim, self._errors_mm, strict=True)
        ]


def command_of(cell: Cell, source: Source, device: DeviceName = "auto") -> str:
    """The command line that measures this cell, as a shell reads it."""
    limit = {"--iterations": cell.iterations} if cell.iterations else {"--budget-s": f"{cell.budget_s:g}"}
    given: dict[str, object] = {}
    if source.argument == str(source.clip):
        given = {flag_of(name): path for name, path in source.files.items()}
        given |= {flag_of(name): value for name, value in source.options.model_dump(exclude_unset=True).items()}
    own = {"--series": cell.series, "--holdout": cell.holdout, "--seeds": cell.seed, **limit, "--out": "DIR"}
    own |= {} if device == "auto" else {"--device": device}
    options = [str(part) for option in {**given, **own}.items() for part in option]
    return shlex.join(["python", "-m", "lab", "evaluate", source.argument, *options])


def render_ms(render: Callable[[float], object]) -> float:
    """Median milliseconds of rendering a time, at times spread over the clip; of slow methods few are timed."""
    took: list[float] = []
    for t in np.random.default_rng(0).permutation(np.linspace(0, 1, UNTIMED_RENDERS + TIMED_RENDERS, endpoint=False)):
        start = time.perf_counter()
        render(float(t))
        took.append(time.perf_counter() - start)
        if sum(took) > MAX_TIMING_S:
            break
    return 1000 * float(np.median(took[min(UNTIMED_RENDERS, len(took) - 1) :]))


def scene_renderer(scene: TrainedScene, device: Device) -> Callable[[float], object]:
    """A function that renders the scene at a time, at the clip's size, including deformation."""
    model = model_of(scene, device)
    camera = camera_vector(camera_in_units(scene.intrinsics, scene.world_from_camera[0], scene.units_per_mm))
    return lambda t: model.render(camera, t)


def seconds_of(run: Mapping[str, float], opening: Mapping[str, float], judging_s: float) -> dict[str, float]:
    """Seconds by stage as `reconstruct` itself would report them of this clip.

    Opening it (decoding, stereo) belongs to every run, although it is done once for all runs on the clip, and the run's
    t_post_s has it already. Judging held-out frames on the way by more than psnr_tissue belongs to none: it is taken
    out of t_post_s, and t_train_s never had it.
    """
    return {**opening, **run, "t_post_s": run["t_post_s"] - judging_s}


def _reported(report: Report, seconds: Mapping[str, float]) -> Values:
    """The columns from the quality report; seconds by stage as JSON."""
    return {name: getattr(report, name) for name in (*SCORES, "iterations", "width", "height")} | {
        "copy_blend_db": report.baseline_blend_db,
        "copy_flow_db": report.baseline_flow_db,
        "warp_db": report.baseline_warp_db,
        "warp_clear_db": report.baseline_warp_clear_db,
        "t_train_s": seconds["t_train_s"],
        "t_post_s": seconds["t_post_s"],
        "seconds": json.dumps({name: round(value, 3) for name, value in seconds.items()}),
        "bases": report.bases,
    }


def _size(scene: TrainedScene) -> Values:
    """N, and the model's numbers per Gaussian, without those of the confidence layer."""
    floats = sum(tensor.numel() for name, tensor in scene.tensors().items() if name != "seen")
    return {"gaussians": len(scene.gaussians), "floats_a_gaussian": floats / len(scene.gaussians)}


def _speed(render: Callable[[float], object], report: Report) -> Values:
    median_ms = render_ms(render)
    step_ms = 1000 * report.seconds["optimise_s"] / report.iterations
    return {"step_ms": step_ms, "render_ms": median_ms, "render_fps": 1000 / median_ms}


def _stored_loss_held_out_db(report: Report, trained_db: Mapping[int, float]) -> float | None:
    """What held-out frames of the stored scene score below those of the model as training left it, on the frames that
    were scored then: the price of rounding, and of strays taken out. The report's own scores are of the stored scene.
    """
    stored_db = {each.frame: each.psnr_tissue_db for each in report.frames}
    known = {frame: score for frame, score in stored_db.items() if score is not None and frame in trained_db}
    return _mean_of_known([trained_db[frame] - score for frame, score in known.items()])


def _mean_of_known(scores: Sequence[float]) -> float | None:
    """The mean of the known scores; a frame without tissue has NaN."""
    known = [score for score in scores if not math.isnan(score)]
    return float(np.mean(known)) if known else None
