"""A run's frames rendered from the endoscope's own pose, and the score of held-out ones during training.

Symbols: H W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from worker.input.clip import spread
from worker.model.metrics import psnr_tissue
from worker.raster.model import Model
from worker.train.hooks import RenderedFrame
from worker.train.run import Run
from worker.train.targets import solid_depth_mm

SAMPLED_FRAMES = 8
"""Training frames that are scored, spread over the clip: enough to compare, cheap to render."""
MAX_SCORED_FRAMES = 16
"""Held-out frames of one score during training."""


FrameRenderer = Callable[[int], RenderedFrame]
"""Renders the frame of this index from the endoscope's own pose."""


def sample_frames(frames: Sequence[int], count: int = SAMPLED_FRAMES) -> list[int]:
    """At most `count` of the frames, evenly spread, first and last among them."""
    return spread(frames, count)


def frame_renderer(run: Run, model: Model | None = None) -> FrameRenderer:
    """Renders frames of the run in mm; with `model`, by that model instead of the run's own."""

    def render(index: int) -> RenderedFrame:
        image = (model or run.model).render(run.frames.cameras[index], float(run.frames.t[index])).copy()
        depth_mm = solid_depth_mm(image[3], image[4], run.frames.scale)
        return RenderedFrame(image[:3].transpose(1, 2, 0), depth_mm, image[4])

    return render


def held_out_psnr(run: Run, render: FrameRenderer) -> float:
    """Mean psnr_tissue over at most sixteen held-out frames, evenly spread; NaN without any. The hooks see each."""
    clip, scores = run.setup.clip, []
    for index in sample_frames(run.setup.split.held_out, MAX_SCORED_FRAMES):
        frame = render(index)
        run.setup.hooks.on_held_out(index, frame)
        if clip.tissue[index].any():  # else it has no score
            scores.append(psnr_tissue(frame.rgb, clip.rgb[index], clip.tissue[index]))
    return float(np.mean(scores)) if scores else math.nan
