"""Trains a rival on a clip and scores it like every model: same frames, same clock, same scores.

Learning rates follow the share of the budget that is used, so a larger budget lowers them later. The iterations of the
paper end a run that has budget left. With a number of iterations nothing reads the clock, and the same seed gives the
same numbers.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, Eye, FrameSplit
from intrasplat.errors import Cancelled, TrainingDiverged
from intrasplat.machine.cores import cores
from intrasplat.machine.hooks import Progress
from intrasplat.machine.timing import Stopwatch
from intrasplat.quality.checks import clip_warnings
from intrasplat.quality.report import Training, first_report
from intrasplat.quality.score import score_model
from intrasplat.report import Report
from intrasplat.splat.backend import CPU, Device
from intrasplat.splat.cpu import compile_kernels
from intrasplat.train.hooks import RenderedFrame, TrainingHooks
from intrasplat.train.loop import REPORT_EVERY_S
from intrasplat.train.run import CurvePoint
from intrasplat.train.scoring import FrameRenderer, score_held_out
from lab.evaluate.thinned import thinned, thinned_camera
from lab.evaluate.truth import Pose, ShownView
from lab.rivals.rival import Rival, Seen, torch_threads

SCORED_SECONDS = (1, 3, 10, 30, 60, 120, 300, 600, 1200)
"""Training times at which held-out frames are scored, the clock paused."""

Make = Callable[[Seen, int], Rival]
"""A rival before its first step, from what it may see and a seed."""


@dataclass(frozen=True)
class Length:
    """How long a rival trains: to the first of what is given, at least one of the two."""

    iterations: int | None
    budget_s: float | None

    def time_share(self, elapsed_s: float) -> float:
        """The used share of the budget of seconds; 0 without one."""
        return 0.0 if self.budget_s is None else elapsed_s / self.budget_s

    def progress(self, made: int, elapsed_s: float) -> float:
        """The share of the training that is done; 1 or more at the end."""
        of_iterations = 0.0 if self.iterations is None else made / self.iterations
        return max(of_iterations, self.time_share(elapsed_s))


class Renders:
    """A rival's pictures, each rendered once as long as it trains no further: the end of its curve, its report and the
    truth ask for the same ones. Several threads may call it."""

    def __init__(self, rival: Rival) -> None:
        self._rival, self._known = rival, dict[tuple[float, bytes, Intrinsics], RenderedFrame]()

    def __call__(self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics) -> RenderedFrame:
        key = (t, world_from_camera.tobytes(), intrinsics)
        if key not in self._known:
            self._known[key] = self._rival.render(t, world_from_camera, intrinsics)
        return self._known[key]

    def forget(self) -> None:
        """Drop all pictures, because the rival has been trained further."""
        self._known.clear()


@dataclass(frozen=True, eq=False)
class Fitted:
    """A trained rival, its pictures, its scored report and its curve."""

    rival: Rival
    renders: Renders
    report: Report
    curve: tuple[CurvePoint, ...]


def train_rival(
    rival: Rival, length: Length, clock: Stopwatch, hooks: TrainingHooks, score: Callable[[int], float]
) -> int:
    """Train to the end of its length, at least one iteration; returns the iterations made.

    Args:
        clock: t_train_s so far; paused while score is called.
        score: of the held-out frames in dB, given the iterations made; called at SCORED_SECONDS and at the end.

    Raises:
        Cancelled: hooks.should_stop said so.
        TrainingDiverged: a loss is not finite, or a Gaussian's place, or all Gaussians are transparent.
    """
    now = clock.elapsed_s
    marks = [mark for mark in SCORED_SECONDS if mark > now]
    made, reported, last_db, progress = 0, -math.inf, math.nan, length.progress(0, now)
    if progress >= 1:
        progress = 0.0  # the start took the whole budget: one iteration all the same
    while progress < 1:
        if hooks.should_stop():
            raise Cancelled(f"Stopped after {made} iterations.")
        made += 1
        rival.time_share = length.time_share(now)
        if not math.isfinite(rival.step(made, progress)):
            raise TrainingDiverged(f"The loss is not finite at iteration {made}.")
        now = clock.elapsed_s
        progress = length.progress(made, now)
        if marks and now >= marks[0] and progress < 1:
            marks = [mark for mark in marks if mark > now]
            with clock.paused():
                last_db = score(made)
        if now - reported >= REPORT_EVERY_S:
            reported = now
            known_db = None if math.isnan(last_db) else last_db
            hooks.on_progress(Progress("train", min(progress, 1.0), made, length.iterations or 0, psnr_db=known_db))
    with clock.paused():
        score(made)
    return made


def run_rival(
    name: str,
    make: Make,
    clip: DepthClip,
    split: FrameSplit,
    length: Length,
    *,
    seed: int,
    device: Device,
    waited_s: float,
    hooks: TrainingHooks,
    step_px: int = 1,
) -> Fitted:
    """Train a rival on the left eye of the clip's training frames, and judge it as every model is.

    Args:
        length: with a budget alone, the published iterations end the run, too.
        waited_s: from the request to the start of training. t_post_s is that and t_train_s: scoring belongs to neither.
        step_px: it is scored on that lattice of pixels alone (lab/evaluate/thinned.py), which hooks see.

    Raises:
        InputError: no training frame has valid depth.
        Cancelled: hooks.should_stop said so.
        TrainingDiverged: as train_rival, or a render is not finite.
    """
    scored = thinned(clip, step_px)
    if device == CPU:
        compile_kernels()  # as before the clock of a preset starts
    clock = Stopwatch()
    curve: list[CurvePoint] = []
    rival = make(Seen.of(clip, split.train, device.memory), seed)
    if length.iterations is None:
        length = Length(rival.published_steps, length.budget_s)
    renders = Renders(rival)
    start_s = clock.elapsed_s

    def render_as(eye: Eye | None) -> FrameRenderer:
        by: Eye = scored if eye is None else eye

        def view(index: int) -> RenderedFrame:
            return renders(float(clip.t[index]), by.world_from_camera[index], by.intrinsics)

        return view

    def score(made: int) -> float:
        t_train_s = clock.elapsed_s
        renders.forget()
        found = score_held_out(scored, split.held_out, render_as, hooks)
        if not math.isnan(found.left_db):
            right_db = None if math.isnan(found.right_db) else found.right_db
            curve.append(CurvePoint(t_train_s, made, found.left_db, right_db, waited_s + t_train_s))
        return found.left_db

    made = train_rival(rival, length, clock, hooks, score)
    t_train_s = curve[-1].t_train_s if curve else clock.elapsed_s
    seconds = {"start_s": start_s, "optimise_s": t_train_s - start_s, "t_train_s": t_train_s}
    seconds["t_post_s"] = waited_s + t_train_s
    doubts = clip_warnings(clip, split.train)
    first = first_report(scored, split, _training(name, rival, made, seed, device, seconds), doubts)
    return Fitted(rival, renders, score_model(first, scored, split.train, renders, hooks), tuple(curve))


def every_core() -> AbstractContextManager[None]:
    """Torch computes on every core within the block."""
    return torch_threads(cores())


class RivalCandidate:
    """A trained rival before the truth (lab/evaluate/truth.py), on a lattice of pixels."""

    def __init__(self, fitted: Fitted, clip: DepthClip, step_px: int) -> None:
        self._rival, self._renders, self._clip = fitted.rival, fitted.renders, clip
        self._drawn_by = thinned_camera(clip.intrinsics, step_px)

    def view(self, frame: int, pose: Pose) -> ShownView:
        shown = self._renders(float(self._clip.t[frame]), pose, self._drawn_by)
        unknown = np.full(shown.depth_mm.shape, np.nan, np.float32)  # no rival says how far to trust it
        return ShownView(shown.rgb, shown.depth_mm, unknown)

    def motion_mm(self, frame: int) -> NDArray[np.floating]:
        clip = self._clip
        return self._rival.motion_mm(float(clip.t[frame]), clip.world_from_camera[0], clip.intrinsics)


def _training(name: str, rival: Rival, made: int, seed: int, device: Device, seconds: Mapping[str, float]) -> Training:
    return Training(
        preset=name,
        eyes="left",
        seed=seed,
        device=str(device),
        iterations=made,
        frames_seen=0,
        gaussians=rival.gaussians,
        bases=0,
        scene_bytes=4 * rival.parameter_count,  # float32
        units_per_mm=1.0,
        seconds=dict(seconds),
        versions={"python": platform.python_version(), "torch": version("torch")},
    )
