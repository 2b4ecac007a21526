"""Score a model with the right eye: a real view from some degrees beside the left eye, at every held-out moment.

The right eye's tissue pixels that the left eye sees, too, are scored. The baseline warps the left eye's picture of the
same moment, which no model was trained on, by its stereo depth.

Symbols: H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.errors import TrainingDiverged
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import Report
from intrasplat.splat.metrics import Image, clear_of_highlights, psnr_tissue
from intrasplat.stereo.right_eye import nearest_known
from intrasplat.train.schedule import MIN_CYCLE_EPOCHS, MIN_CYCLE_ITERATIONS
from intrasplat.train.scoring import FrameRenderer, Mapping, judged_pixels

FAR_MM = 1e6
"""Depth at which both eyes see the same picture."""


@dataclass(frozen=True)
class RightScores:
    """Scores of the right eye's pictures of some frames in dB, one number per frame; NaN for a frame without tissue.

    psnr_db, warp_db         the model's score, and that of the warped left eye
    clear_db, warp_clear_db  the same without highlights
    """

    psnr_db: tuple[float, ...] = ()
    clear_db: tuple[float, ...] = ()
    warp_db: tuple[float, ...] = ()
    warp_clear_db: tuple[float, ...] = ()


def measure_right(clip: DepthClip, frames: Sequence[int], render: FrameRenderer, mapping: Mapping = map) -> RightScores:
    """Score the renders of these frames (clip indices) from the right eye's pose; nothing for a clip of one eye.

    `mapping` may use several threads.

    Raises:
        TrainingDiverged: a render contains NaN or infinity.
    """
    right = clip.right
    if right is None:
        return RightScores()

    def score(index: int) -> list[float]:
        shown = render(index).rgb
        if not np.isfinite(shown).all():
            raise TrainingDiverged(f"Frame {index} renders as NaN or infinity from the right eye: training diverged.")
        truth, judged = right.rgb[index], judged_pixels(right, index)
        found = [figure for image in (shown, warped_left(clip, index)) for figure in _scores(image, truth, judged)]
        for eye in clip.eyes:
            eye.let_go(index)
        return found

    rows = list(mapping(score, frames))
    model, clear, warp, warp_clear = zip(*rows, strict=True) if rows else ((), (), (), ())
    return RightScores(model, clear, warp, warp_clear)


def warped_left(clip: DepthClip, index: int) -> NDArray[np.uint8]:
    """The left eye's picture [H, W, 3] warped to the right eye by the right eye's depth; gaps take the nearest."""
    assert clip.right is not None
    right, left_k = clip.right, clip.intrinsics
    found_mm = nearest_known(right.depth_mm[index], right.depth_mm[index] > 0)
    depth_mm = np.where(found_mm > 0, found_mm, np.float32(FAR_MM))  # where no pixel has depth
    left_from_right = np.linalg.inv(clip.world_from_camera[index]) @ right.world_from_camera[index]
    across = (np.arange(depth_mm.shape[1], dtype=np.float32) + 0.5 - right.intrinsics.cx) / right.intrinsics.fx
    down = (np.arange(depth_mm.shape[0], dtype=np.float32)[:, None] + 0.5 - right.intrinsics.cy) / right.intrinsics.fy
    x, y, z = (depth_mm * (a * across + b * down + c) + d for a, b, c, d in left_from_right[:3].tolist())
    column, row = left_k.fx * x / z + left_k.cx - 0.5, left_k.fy * y / z + left_k.cy - 0.5
    warped = cv2.remap(clip.rgb[index], column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)


def _scores(image: Image, truth: NDArray[np.uint8], judged: NDArray[np.bool_]) -> tuple[float, float]:
    """psnr_tissue in dB over the judged pixels, and over those without highlights."""
    return psnr_tissue(image, truth, judged), psnr_tissue(image, truth, judged & clear_of_highlights(image, truth))


def too_few_steps(first: Report, right_db: float | None, warp_db: float | None) -> list[Notice]:
    """Warn if a model of both eyes is worse than the warped left eye after fewer steps than a cycle of training has.

    right_db, warp_db: mean psnr_db and warp_db of its RightScores; None: not known.
    """
    seen = first.iterations if first.frames_seen is None else first.frames_seen
    is_short = first.iterations < MIN_CYCLE_ITERATIONS or seen < MIN_CYCLE_EPOCHS * first.train_count
    if first.eyes != "both" or right_db is None or warp_db is None or right_db >= warp_db or not is_short:
        return []
    if any(each.code is NoticeCode.TIME_TOO_SHORT for each in first.warnings):
        return []
    text = (
        f"After {first.iterations} steps the model scores {right_db:.1f} dB from the right eye, where the left eye's "
        f"picture, warped by its depth, scores {warp_db:.1f} dB: it needs more steps. Give a larger budget_s."
    )
    return [Notice.warning(NoticeCode.TIME_TOO_SHORT, text)]
