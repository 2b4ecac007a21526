"""Follower: a model that follows a feed, pair by pair, and shows its newest moment and its past.

A pair is rectified and matched; optical flow carries the Gaussians to it; a few steps of training teach it, half of
them on it and half on frames of the window (window.py). Every S used frames the oldest S become a segment, a scene of
its own that does not change any more.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from threading import Lock
from typing import Literal

import numpy as np
import torch

from intrasplat.clip import DepthClip
from intrasplat.errors import TrainingDiverged
from intrasplat.fusion import FusionSettings, fuse
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.live.camera import Placer
from intrasplat.live.cover import Cover, with_spares
from intrasplat.live.eyes import EyesSettings, LiveEyes
from intrasplat.live.motion import Carried, FlowStart
from intrasplat.live.pair import FeedPair
from intrasplat.live.trusted import Trusted
from intrasplat.live.window import Moment, Window
from intrasplat.machine.cores import cores
from intrasplat.machine.hooks import always, ignore
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.methods.fast import INSTANT
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.splat.cpu.threads import alone
from intrasplat.splat.layout import COLOUR, MEAN
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.splat.optimize import rates_at
from intrasplat.train.loop import check_sums
from intrasplat.train.start import start_gaussians, stride_for
from intrasplat.train.targets import units_per_mm

RATES = replace(
    INSTANT.rates,
    **{
        name: replace(getattr(INSTANT.rates, name), end=4.5 * (getattr(INSTANT.rates, name).end or 0.0))
        for name in ("motion_mean", "motion_quaternion", "motion_log_scale")
    },
)
"""Rates of a clip's last steps, with a faster motion: it must follow each frame in a few steps, and what all frames
share must not follow the newest one."""
MIN_PSNR_DB = 16.0
"""The model begins anew if it shows a pair worse, once it has learnt it: the feed shows something else."""
MAX_LOST_S = 1.0
"""Seconds of the source's clock after which a lost camera's frame begins a model in a world of its own."""
MIN_DEPTH_SHARE = 0.05
"""A pair is not used if a smaller share of its picture is tissue with depth."""
MANY_CORES = 4
"""With fewer cores, steps before a pair is ready use one. Those that learn it use all, while the next one is read."""
LOOK_EVERY = 2
"""Used frames from one look at what is to be trusted to the next."""
MIN_STEPS = 2
"""Steps that a pair gets, however short the time is."""


class Added(StrEnum):
    """What became of a pair."""

    FIRST = "first"
    FOLLOWED = "followed"
    NO_SCENE = "no_scene"
    """It shows too little tissue with depth, or nothing that the eyes can be registered by."""
    NO_TISSUE = "no_tissue"
    """It does not show tissue."""
    LOST = "lost"
    """The moving camera's pose was not found."""
    RESTARTED = "restarted"
    """The model showed something else, was lost for long or diverged, and began anew with this pair."""


@dataclass(frozen=True)
class FollowSettings:
    """How a feed is followed.

    eyes             how pairs are read
    segment_frames   S, used frames of a segment; the window has S to 2 S of them
    points           Gaussians that the first frame starts with, about
    spare            Gaussians for tissue that comes into view, as a share of these
    steps            steps of training for each pair; None: as many as fit into the time that add() is given
    first_steps      steps for the first pair, if steps are given
    opening          steps in which the rates fall to those that they keep
    camera           whether the endoscope moves; "fixed": its motion counts as the tissue's
    keep_s           seconds of the past that are segments
    seed             of the order of frames
    """

    eyes: EyesSettings = field(default_factory=EyesSettings)
    segment_frames: int = 8
    points: int = 20_000
    spare: float = 0.25
    steps: int | None = None
    first_steps: int = 30
    opening: int = 100
    camera: Literal["fixed", "moving"] = "fixed"
    keep_s: float = 20.0
    seed: int = 0


class Follower:
    """Follows one feed. One thread calls add(); any thread asks for scenes.

    on_segment is called with every segment as the thread of add() writes it off. A pair for which is_tissue is False is
    not learnt.
    """

    def __init__(
        self,
        calibration: StereoCalibration | Path,
        settings: FollowSettings | None = None,
        device: Device = CPU,
        on_segment: Callable[[TrainedScene], None] = ignore,
        is_tissue: Callable[[DepthClip], bool] = always,
    ) -> None:
        self.settings = settings or FollowSettings()
        self._is_tissue = is_tissue
        self.segments: tuple[TrainedScene, ...] = ()
        self.used = 0
        self.iteration = 0
        self._calibration, self._device, self._on_segment = calibration, device, on_segment
        self._eyes: LiveEyes | None = None
        self._window: Window | None = None
        self._lock = Lock()
        self._scene: tuple[int, TrainedScene] | None = None
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="feed")
        self._ahead: tuple[FeedPair, Future[DepthClip | Added]] | None = None
        self._range_of: DepthClip | None = None
        self._rehearsed = self._version = 0
        self._motion_error = 0.0
        self._flow: FlowStart
        self._placer: Placer
        self._cover: Cover
        self._trusted: Trusted
        torch.set_num_threads(1)  # the kernels have threads of their own

    @property
    def newest(self) -> Moment | None:
        """The newest moment that the model knows; None: none so far."""
        return None if self._window is None else self._window.newest

    @property
    def span(self) -> tuple[Moment, Moment] | None:
        """The oldest and the newest moment of the window; None: nothing is known so far."""
        with self._lock:
            return None if self._window is None else (self._window.moments[0], self._window.newest)

    @property
    def gaussians(self) -> int:
        """The number of Gaussians of the model."""
        window = self._window
        return 0 if window is None else window.model.count

    def add(self, pair: FeedPair, budget_s: float = 0.2, coming: Callable[[], FeedPair | None] = ignore) -> Added:
        """Learn a pair; budget_s: seconds from now that it may take, where settings.steps is None.

        The window's frames train until the pair is read and its motion is known. While it is learnt, the pair that
        coming() gives is read ahead; the caller adds it next, or never.

        Raises:
            InputError: its pictures have another size than those before, or the calibration does not fit them.
        """
        end_s = time.perf_counter() + budget_s
        ahead, self._ahead = self._ahead, None
        clip = ahead[1] if ahead is not None and ahead[0] is pair else self._reader.submit(self._read_tissue, pair)
        reading = self._reader.submit(self._prepared, pair, clip)
        try:
            self._rehearse(reading)
            ready = reading.result()
            if isinstance(ready, Added):
                return ready
            following = coming()
            if following is not None:
                self._ahead = following, self._reader.submit(self._read_tissue, following)
            if self._window is None or ready.carried is None:
                return self._begin(ready, end_s)
            self._go_on(self._window, ready.moment, ready.carried)
            self._learn(self._window, end_s, self.settings.steps)
            shown = self._window.shown()
            if _psnr_db(shown, ready.moment.clip) < MIN_PSNR_DB:
                return self._begin(ready, end_s)
            self._flow.look_at(shown)
            self._look(self._window)
        except TrainingDiverged:
            self._window = None  # what it has learnt is lost
            ready = reading.result()
            return ready if isinstance(ready, Added) else self._begin(ready, end_s)
        return Added.FOLLOWED

    def write_off(self) -> None:
        """Make all that the model knows a segment; the next pair begins another model."""
        scene = None if self._window is None else self._current()
        if scene is not None:
            self._keep(scene)
            self._window = None

    def close(self) -> None:
        """End the thread that reads pairs. Scenes can still be had; no pair can be added."""
        self._reader.shutdown()

    def read(self, pair: FeedPair) -> DepthClip | None:
        """The clip of one frame that a pair gives; None: it shows too little tissue with depth."""
        if self._eyes is None:
            size = pair.left.shape[1], pair.left.shape[0]
            self._eyes = LiveEyes(self._calibration, self.settings.eyes, size, pair.pixel_aspect)
        clip = self._eyes.moment(pair.left, pair.right, pair.source_s)
        if clip is None:
            return None
        known = np.count_nonzero(clip.tissue[0] & (clip.depth_mm[0] > 0))
        return clip if known >= MIN_DEPTH_SHARE * clip.field_pixels else None

    def scene_at(self, source_s: float | None = None) -> tuple[TrainedScene, float] | None:
        """The scene that shows a second of the source's clock, and the model time t of that second in it.

        None: nothing is known yet. A second before or between what is known becomes the nearest known one; source_s
        None is the newest moment.
        """
        scene = self._current()
        if scene is None:
            return None
        if source_s is not None and source_s < scene.frame_times_s[0]:
            earlier = [each for each in self.segments if each.frame_times_s[0] <= source_s]
            scene = earlier[-1] if earlier else next(iter(self.segments), scene)
        last = scene.frame_count - 1
        place = last if source_s is None else np.interp(source_s, scene.frame_times_s, np.arange(last + 1))
        return scene, float(place) / scene.frame_count

    def _current(self) -> TrainedScene | None:
        """The scene of the window."""
        with self._lock:
            if self._window is None:
                return None if self._scene is None else self._scene[1]
            if self._scene is None or self._scene[0] != self._version:
                self._scene = self._version, self._scene_of(self._window, len(self._window.moments))
            return self._scene[1]

    def _scene_of(self, window: Window, end: int) -> TrainedScene:
        """The scene of the window's first `end` frames."""
        return window.scene(end, self._trusted.trust(), self._motion_error, seed=self.settings.seed)

    def _look(self, window: Window) -> None:
        """Look at how the model shows what it has just learnt; from now on its scene is another one."""
        with self._lock:
            if self.used % LOOK_EVERY == 1:
                self._trusted.look(window)
            self._version += 1

    def _read_tissue(self, pair: FeedPair) -> DepthClip | Added:
        """The clip of one frame that a pair gives, or why it is not used."""
        with one_opencv_thread():
            clip = self.read(pair)
            if clip is None:
                return Added.NO_SCENE
            return clip if self._is_tissue(clip) else Added.NO_TISSUE

    def _prepared(self, pair: FeedPair, read: Future[DepthClip | Added]) -> _Ready | Added:
        """What can be computed of a pair without the model, or why it is not used.

        After a segment, the disparities that it showed become the range of the pair after this one.
        """
        clip = read.result()
        if isinstance(clip, Added):
            return clip
        with one_opencv_thread():
            seen, self._range_of = self._range_of, None
            if seen is not None and self._eyes is not None:
                self._eyes.follow_range(seen)
            window = self._window
            if window is not None and self.settings.camera == "moving":
                placed = self._placer.placed(clip)
                if placed is None and pair.source_s - window.newest.source_s < MAX_LOST_S:
                    return Added.LOST
                clip, window = placed or clip, None if placed is None else window
            if window is None:
                self._flow, self._placer = FlowStart(clip), Placer(clip)
                return _Ready(Moment.of(clip, pair, units_per_mm(clip, [0])), None)
            return _Ready(Moment.of(clip, pair, window.scale), self._flow.to(clip))

    def _begin(self, ready: _Ready, end_s: float) -> Added:
        """Begin a model with a frame; the one that was there becomes a segment."""
        moment, settings, is_first = ready.moment, self.settings, self.used == 0
        self.write_off()
        stride = stride_for(settings.points, moment.clip.intrinsics)
        fusion = FusionSettings(mode="fill", stride=stride)
        cloud = fuse(moment.clip, [0], fusion, seed=settings.seed, right=moment.clip.right)
        gaussians = with_spares(start_gaussians(cloud, INSTANT, moment.scale), settings.spare)
        window = Window(gaussians, moment, settings.segment_frames, self._device)
        with self._lock:
            self._window, self._cover = window, Cover(len(gaussians), stride)
            self._trusted = Trusted(len(gaussians))
            self.used, self.iteration, self._rehearsed = self.used + 1, 0, 0
            self._version += 1
        self._learn(window, end_s, settings.first_steps)
        self._flow.look_at(window.shown())
        self._look(window)
        return Added.FIRST if is_first else Added.RESTARTED

    def _go_on(self, window: Window, moment: Moment, carried: Carried) -> None:
        """Carry the model to the next frame; write a segment off where the window is full."""
        if window.is_full:
            self._write_off(window)
        means_mm = window.model.deformed_mean(window.slot).T / np.float32(window.scale)
        moved_mm, colour = carried.of(means_mm)
        with self._lock:
            window.append(moment, ((MEAN, moved_mm * np.float32(window.scale)), (COLOUR, colour)))
            self.used, self._version = self.used + 1, self._version + 1
            self._trusted.forget(self._cover.renew(window))

    def _write_off(self, window: Window) -> None:
        """Make the window's first segment a scene of the past."""
        assert self._eyes is not None
        count = self.settings.segment_frames
        with self._lock:
            self._motion_error = window.motion_error(count + 1)
        self._keep(self._scene_of(window, count + 1))  # one more frame: no gap is between them
        with self._lock:
            window.give_up()
        self._range_of = window.newest.clip

    def _keep(self, segment: TrainedScene) -> None:
        """Add a segment, and forget those before keep_s."""
        self._on_segment(segment)
        all_of_them = [*self.segments, segment]
        begins_s = segment.frame_times_s[-1] - self.settings.keep_s
        self.segments = tuple(each for each in all_of_them if each.frame_times_s[-1] >= begins_s)

    def _rehearse(self, reading: Future[_Ready | Added]) -> None:
        """Train frames of the window: half the steps given or, if None, until the pair is read."""
        window, steps, made = self._window, self.settings.steps, 0
        with alone(is_alone=cores() < MANY_CORES):
            while window is not None and (made < steps // 2 if steps is not None else not reading.done()):
                self._step(window, self._drawn(window))
                made += 1
        self._rehearsed = made

    def _learn(self, window: Window, end_s: float, steps: int | None) -> None:
        """Train the newest frame; once it had as many steps as others had beside its reading, others in turn."""
        made, others = 0, self._rehearsed
        fixed = self.settings.steps is not None
        while made + self._rehearsed < (steps or 0) if fixed else made < MIN_STEPS or time.perf_counter() < end_s:
            slot, newest = window.slot, made - (others - self._rehearsed)
            if newest > others:
                slot, others = self._drawn(window), others + 1
            self._step(window, slot)
            made += 1

    def _drawn(self, window: Window) -> int:
        """A slot of the window, drawn by the number of the step."""
        return int(np.random.default_rng([self.settings.seed, self.iteration]).integers(len(window.moments)))

    def _step(self, window: Window, slot: int) -> None:
        """One step on the frame in a slot. Raises TrainingDiverged."""
        iteration = self.iteration + 1
        rates = rates_at(RATES, min(1.0, iteration / self.settings.opening))
        with self._lock:
            sums = window.model.step(window.moments[slot].frames, INSTANT.loss, rates, iteration)
        check_sums(sums, iteration)
        self.iteration = iteration


@dataclass(frozen=True, eq=False)
class _Ready:
    """A pair that was read, and the motion to it; None where there is no frame before it."""

    moment: Moment
    carried: Carried | None


def _psnr_db(shown: DepthClip, clip: DepthClip) -> float:
    """psnr_tissue of the left eye as the model shows it; NaN without tissue."""
    return psnr_tissue(shown.rgb[0], clip.rgb[0], clip.tissue[0])
