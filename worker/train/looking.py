"""How a run's frames look from the endoscope's own pose, and how held-out ones score on the way.

Symbols: H W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.input.clip import DepthClip, FrameSplit, spread
from worker.machine.hooks import Hooks
from worker.model.metrics import psnr_tissue
from worker.raster.model import Model
from worker.train.loop import Run
from worker.train.targets import solid_depth_mm

SAMPLED_FRAMES = 8
"""Training frames that are looked at, spread over the clip: enough to compare, cheap to render."""


@dataclass(frozen=True, eq=False)
class View:
    """A frame as the model renders it from the endoscope's own pose.

    rgb [H, W, 3] float32, unclamped; depth_mm [H, W] float32, 0 where alpha < 0.5; alpha [H, W] float32
    """

    rgb: NDArray[np.float32]
    depth_mm: NDArray[np.float32]
    alpha: NDArray[np.float32]


def sample_frames(frames: Sequence[int], count: int = SAMPLED_FRAMES) -> list[int]:
    """At most `count` of the frames, evenly spread, first and last among them."""
    return spread(frames, count)


def view_function(run: Run, scale: float, model: Model | None = None) -> Callable[[int], View]:
    """Renders frame i from the endoscope's pose, in mm, of this model instead of the run's own if there is one."""

    def view_of(index: int) -> View:
        image = (model or run.model).render(run.frames.cameras[index], float(run.frames.t[index])).copy()
        return View(image[:3].transpose(1, 2, 0), solid_depth_mm(image[3], image[4], scale), image[4])

    return view_of


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
