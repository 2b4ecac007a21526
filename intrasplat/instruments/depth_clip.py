"""Finds the instruments of a clip that has depth and no masks.

Symbols: T frames, H W pixels; h w pixels of the coarse picture; nearness: 1 / depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.errors import Cancelled
from intrasplat.instruments.find import FoundMask, Image, Rgb, smooth_nearness
from intrasplat.instruments.finder import Finder, looked_at
from intrasplat.instruments.segmenter import Segmenter
from intrasplat.machine.cores import cores
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.notices import NoticeCode

STAGE = "masks"
"""Name of the stage in progress reports."""


def with_instruments_found(
    clip: DepthClip, measured: Sequence[int], hooks: Hooks, segmenter: Segmenter | None = None
) -> DepthClip:
    """The clip with masks of its left eye, for a clip without any. Frames are independent of each other.

    Args:
        measured: frames from which the tissue's colour may be measured: those that are not held out.

    Raises:
        Cancelled: hooks.should_stop said so.
    """
    finder = Finder.of((clip.rgb[i] for i in looked_at(measured)), clip.field_of_view, segmenter)
    tissue = mapped_zeros(clip.tissue.shape, np.bool_)
    wanted = clip.used
    evidence = np.zeros((clip.frame_count, 3))

    def find(i: int) -> float:
        if hooks.should_stop():
            raise Cancelled("stopped while finding instruments")
        found: FoundMask = finder(clip.rgb[i], lambda coarse: nearness_of(coarse, clip.depth_mm[i]))
        tissue[i] = clip.tissue[i] & ~found.tool
        evidence[i] = found.seen, found.clear, found.missed
        masked = 1 - np.count_nonzero(tissue[i]) / clip.field_pixels
        let_go(tissue[i])
        clip.let_go(i)
        return masked

    hooks.report_stage(STAGE, 0.0)
    shares = []
    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        for masked in pool.map(find, wanted):
            shares.append(masked)
            hooks.report_stage(STAGE, len(shares) / len(wanted))
    share = float(np.mean(shares))
    masks, assumption, warnings = finder.report(share, evidence[list(wanted)])
    kept = (each for each in clip.assumptions if each.code is not NoticeCode.MASKS)
    return replace(
        clip, tissue=tissue, masks=masks, assumptions=(*kept, assumption), warnings=(*clip.warnings, *warnings)
    )


def nearness_of(coarse: Rgb, depth_mm: Image) -> Image:
    """Nearness [h, w] of a coarse picture [h, w, 3], from the depth [H, W] at full size, where 0 is invalid."""
    size = coarse.shape[1::-1]
    valid = (depth_mm > 0).astype(np.float32)
    inverse = valid / np.maximum(depth_mm, np.float32(1e-3))
    near, trust = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (inverse, valid))
    return smooth_nearness(coarse, near / np.maximum(trust, np.float32(1e-6)), trust)
