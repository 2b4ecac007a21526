"""Render a run's frames from the endoscope's own poses, and score held-out frames during training.

Symbols: H W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, Eye, spread
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.splat.model import Model
from intrasplat.splat.step import camera_vector
from intrasplat.train.hooks import RenderedFrame, TrainingHooks
from intrasplat.train.run import Run
from intrasplat.train.targets import camera_in_units, solid_depth_mm

SAMPLED_FRAMES = 8
"""Training frames that are scored, spread over the clip: enough to compare, and quick to render."""
MAX_SCORED_FRAMES = 16
"""The most held-out frames in one score during training."""


CLOSED_SHARE = 0.03
"""Share of the image's width. A gap in the right eye's depth up to this size is a failure of stereo; a larger one is
tissue that the left eye does not see."""

FrameRenderer = Callable[[int], RenderedFrame]
"""Renders the frame of this index from an eye's own pose."""
PoseRenderer = Callable[[float, NDArray[np.float64], Intrinsics], RenderedFrame]
"""Renders model time t from world_from_camera [4, 4] in mm with a camera."""
Mapping = Callable[[Callable[[int], Any], Iterable[int]], Iterable[Any]]
"""A function like map(): applies a function to each frame and gives the results in order."""


def sample_frames(frames: Sequence[int], count: int = SAMPLED_FRAMES) -> list[int]:
    """At most `count` of the frames, evenly spread, first and last among them."""
    return spread(frames, count)


def frame_renderer(run: Run, model: Model | None = None, eye: Eye | None = None) -> FrameRenderer:
    """A function that renders frames of the run as recorded, depth in mm, from the left eye or `eye`, the right.
    `model` renders instead of the run's."""
    seen_by, scale = eye or run.setup.clip, run.frames.scale
    side = run.setup.sides[0 if eye is None else 1]

    def render(index: int) -> RenderedFrame:
        camera = camera_vector(camera_in_units(seen_by.intrinsics, seen_by.world_from_camera[index], scale, side))
        image = (model or run.model).render(camera, float(run.frames.t[index])).copy()
        depth_mm = solid_depth_mm(image[3], image[4], scale)
        rgb = image[:3].transpose(1, 2, 0)
        rgb = run.light.added(rgb, index, depth_mm, seen_by.intrinsics, right=eye is not None)
        return RenderedFrame(rgb, depth_mm, image[4])

    return render


@dataclass(frozen=True)
class HeldOutScore:
    """Mean psnr_tissue in dB over held-out frames of the left eye, and of the right eye; NaN where there is none."""

    left_db: float
    right_db: float


def held_out_score(run: Run, model: Model | None = None) -> HeldOutScore:
    """The score of the run's model, or of `model`, on held-out frames; see score_held_out."""
    setup = run.setup

    def render_as(eye: Eye | None) -> FrameRenderer:
        return frame_renderer(run, model, eye)

    return score_held_out(setup.clip, setup.split.held_out, render_as, setup.hooks)


def score_held_out(
    clip: DepthClip,
    held_out: Sequence[int],
    render_as: Callable[[Eye | None], FrameRenderer],
    hooks: TrainingHooks,
) -> HeldOutScore:
    """The score over at most MAX_SCORED_FRAMES of the held-out frames, evenly spread.

    Args:
        render_as: gives a renderer for the left eye (None) or for the clip's right eye.
        hooks: on_held_out receives the left eye's renders.
    """
    scores, frames, render = [], sample_frames(held_out, MAX_SCORED_FRAMES), render_as(None)
    for index in frames:
        frame = render(index)
        hooks.on_held_out(index, frame)
        if clip.tissue[index].any():  # else it has no score
            scores.append(psnr_tissue(frame.rgb, clip.rgb[index], clip.tissue[index]))
        clip.let_go(index)
    right = [] if clip.right is None else _right_scores(clip.right, frames, render_as(clip.right))
    return HeldOutScore(*(float(np.mean(each)) if each else math.nan for each in (scores, right)))


def _right_scores(right: Eye, frames: Sequence[int], render: FrameRenderer) -> list[float]:
    """psnr_tissue in dB of the right eye's frames, on tissue that the left eye sees too."""
    judged = ((index, judged_pixels(right, index)) for index in right.one_by_one(frames))
    return [psnr_tissue(render(index).rgb, right.rgb[index], pixels) for index, pixels in judged if pixels.any()]


def judged_pixels(right: Eye, index: int) -> NDArray[np.bool_]:
    """[H, W] tissue of the right eye that the left eye sees too."""
    side = 2 * round(CLOSED_SHARE * right.intrinsics.width / 2) + 1
    matched = (right.depth_mm[index] > 0).astype(np.uint8)
    seen = cv2.morphologyEx(matched, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)) > 0
    return np.asarray(seen & right.tissue[index])
