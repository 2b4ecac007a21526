"""Scores of views with detail from recorded frames: only those that the report has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.errors import TrainingDiverged
from intrasplat.quality.report import detail_scores
from intrasplat.report import DetailScores
from intrasplat.splat.metrics import psnr_tissue, ssim
from intrasplat.train.scoring import FrameRenderer, Mapping, judged_pixels


def measure_detail(
    clip: DepthClip, frames: Sequence[int], left: FrameRenderer, right: FrameRenderer, mapping: Mapping = map
) -> DetailScores:
    """Score the renders of these frames (clip indices) from both eyes; `mapping` may use several threads.

    Raises:
        TrainingDiverged: a render contains NaN or infinity.
    """

    def from_left(index: int) -> tuple[float, float]:
        shown, truth, tissue = _finite(left, index), clip.rgb[index], clip.tissue[index]
        found = psnr_tissue(shown, truth, tissue), ssim(shown, truth, tissue)
        clip.let_go(index)
        return found

    def from_right(index: int) -> float:
        assert clip.right is not None
        found = psnr_tissue(_finite(right, index), clip.right.rgb[index], judged_pixels(clip.right, index))
        clip.right.let_go(index)
        return found

    tissue_db, similarity = np.array(list(mapping(from_left, frames))).reshape(-1, 2).T.tolist()
    right_db = [] if clip.right is None else list(mapping(from_right, frames))
    return detail_scores(tissue_db, right_db, similarity)


def _finite(render: FrameRenderer, index: int) -> NDArray[np.float32]:
    rgb = render(index).rgb
    if not np.isfinite(rgb).all():
        raise TrainingDiverged(f"Frame {index} renders as NaN or infinity with detail from recorded frames.")
    return rgb
