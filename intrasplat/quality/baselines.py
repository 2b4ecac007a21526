"""The copy baselines: scores of held-out frames that are copied from their neighbours in time, without a model.

Symbols: H W pixels; a, b the nearest earlier and later training frames of held-out frame i, s = (i - a) / (b - a).
A fixed camera and slow tissue make copying strong, so every quality figure is compared with these two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import DepthClip
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.scoring import Mapping

Flow = NDArray[np.float32]  # [H, W, 2] px

MIN_FLOW_PX = 16
"""The optical flow's finest patches do not fit into a smaller image; its flow is 0."""


@dataclass(frozen=True)
class CopyBaselines:
    """psnr_tissue in dB of each held-out frame, [F] in the given order. Only training frames are copied."""

    blend_db: tuple[float, ...]
    flow_db: tuple[float, ...]


def copy_baselines(
    clip: DepthClip, train: Sequence[int], held_out: Sequence[int], mapping: Mapping = map
) -> CopyBaselines:
    """Score both methods of copying; `mapping` may use several threads.

    blend  (1 - s) C_a + s C_b
    flow   the same, after warping C_a and C_b to time i along their shares of the optical flow (DIS) between them
    A pixel that shows an instrument in one neighbour is copied from the other alone. Outside the training frames' span
    the nearest one is copied.

    Raises:
        ValueError: there are held-out frames but no training frame.
    """
    if held_out and not train:
        raise ValueError(f"{len(held_out)} held-out frames have no training frame to be copied from")
    between = {index: _neighbours(index, train) for index in held_out}

    def score(first: int) -> list[tuple[float, float]]:
        """Scores of all frames between two neighbours, which share their flow; `first` is one of these frames."""
        pair = between[first]
        frames = [index for index in held_out if between[index] == pair]
        found = score_between(pair, frames)
        for index in (*pair, *frames):
            clip.let_go(index)
        return found

    def score_between(pair: tuple[int, int], frames: Sequence[int]) -> list[tuple[float, float]]:
        if pair[0] == pair[1]:
            alone = [psnr_tissue(clip.rgb[pair[0]], clip.rgb[index], clip.tissue[index]) for index in frames]
            return list(zip(alone, alone, strict=True))
        flows, found = _flows(clip.rgb[pair[0]], clip.rgb[pair[1]]), []
        for index in frames:
            blend, warp = _copies(clip, *pair, index, flows)
            truth, tissue = clip.rgb[index], clip.tissue[index]
            found.append((psnr_tissue(blend, truth, tissue), psnr_tissue(warp, truth, tissue)))
        return found

    firsts = list({pair: index for index, pair in reversed(between.items())}.values())[::-1]
    found = [scores for group in mapping(score, firsts) for scores in group]
    blends, warps = zip(*found, strict=True) if found else ((), ())
    return CopyBaselines(blends, warps)


def _neighbours(index: int, train: Sequence[int]) -> tuple[int, int]:
    """The nearest training frames before and after; outside their span, the nearest one twice."""
    earlier = max((each for each in train if each < index), default=None)
    later = min((each for each in train if each > index), default=None)
    nearest = later if earlier is None else earlier
    assert nearest is not None
    return nearest if earlier is None else earlier, nearest if later is None else later


def _copies(
    clip: DepthClip, earlier: int, later: int, index: int, flows: tuple[Flow, Flow]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The held-out frame copied by blending and by flow, [H, W, 3] in [0, 1]."""
    share = (index - earlier) / (later - earlier)
    frames = [clip.rgb[each].astype(np.float32) / np.float32(255) for each in (earlier, later)]
    tissue = [clip.tissue[each].astype(np.float32) for each in (earlier, later)]
    forward, backward = flows
    # From time i back to a is -share of the motion a -> b; the flow b -> a at the same pixel approximates it.
    warped = [_warp(frames[0], share * backward), _warp(frames[1], (1 - share) * forward)]
    warped_tissue = [_warp(tissue[0], share * backward), _warp(tissue[1], (1 - share) * forward)]
    return _blend(frames, tissue, share), _blend(warped, warped_tissue, share)


def _blend(frames: list[NDArray[np.float32]], tissue: list[NDArray[np.float32]], share: float) -> NDArray[np.float32]:
    """(1 - share) of the first + share of the second; where only one is tissue, that one alone."""
    weights = [(1 - share) * tissue[0], share * tissue[1]]
    nowhere = weights[0] + weights[1] <= 0
    weights = [
        np.where(nowhere, np.float32(plain), each) for plain, each in zip((1 - share, share), weights, strict=True)
    ]
    second = (weights[1] / (weights[0] + weights[1]))[..., None]
    return np.asarray((1 - second) * frames[0] + second * frames[1], dtype=np.float32)


def _flows(earlier: NDArray[np.uint8], later: NDArray[np.uint8]) -> tuple[Flow, Flow]:
    """Forward and backward flow: pixel x of `earlier` shows the point that `later` shows at x + forward(x)."""
    if min(earlier.shape[:2]) < MIN_FLOW_PX:
        still = np.zeros((*earlier.shape[:2], 2), np.float32)
        return still, still
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (earlier, later)]
    estimator = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    forward = np.asarray(estimator.calc(grey[0], grey[1], np.empty(0)), dtype=np.float32)
    backward = np.asarray(estimator.calc(grey[1], grey[0], np.empty(0)), dtype=np.float32)
    return forward, backward


def _warp(image: NDArray[np.float32], flow: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image sampled at x + flow(x)."""
    rows, columns = np.indices(flow.shape[:2], dtype=np.float32)
    return np.asarray(
        cv2.remap(
            image, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ),
        dtype=np.float32,
    )
