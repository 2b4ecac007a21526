"""Tests with a few frames whether the camera is fixed: most of a fixed camera's picture rests most of the time."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, spread
from intrasplat.motion.lifted import cell_means

LOOK_WIDTH = 160
LOOKS = 8
"""Number of frames that are compared, spread over the clip."""
RESTING_PX, RESTING_SHARE = 0.25, 0.4
"""Tissue with less flow (px of the small picture) rests. This share of textured tissue must rest in half of the frames
compared."""
MOVED_PX = 0.8
"""A camera counts as fixed below this root mean square over frames of the median flow: half a degree."""
MIN_SEEN = 0.1
"""Minimum share of the picture with textured tissue."""
MIN_CONTRAST = 3.0
"""Minimum standard deviation of a patch's grey levels for its flow to count."""


def camera_rests(clip: DepthClip, train: Sequence[int]) -> bool:
    """Whether so much of the picture rests that the camera must be fixed. False: the path has to be estimated."""
    step = -(-clip.intrinsics.width // LOOK_WIDTH)
    solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def small(index: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        rgb = np.ascontiguousarray(clip.rgb[index])
        grey = cv2.cvtColor(np.asarray(cell_means(rgb, step)), cv2.COLOR_RGB2GRAY)
        tissue = clip.tissue[index][step // 2 :: step, step // 2 :: step][: grey.shape[0], : grey.shape[1]]
        clip.let_go(index)
        return grey, tissue

    looks = spread(train, LOOKS)
    first, tissue = small(looks[0])
    values = first.astype(np.float32)
    variance = cv2.blur(values * values, (9, 9)) - cv2.blur(values, (9, 9)) ** 2
    telling = tissue & (variance > MIN_CONTRAST**2)
    medians, rests = [], []
    for index in looks[1:]:
        grey, there = small(index)
        seen = telling & there
        if np.count_nonzero(seen) < MIN_SEEN * seen.size:
            return False
        moved = np.linalg.norm(solver.calc(first, grey, None)[seen], axis=1)
        medians.append(np.median(moved))
        rests.append(np.mean(moved < RESTING_PX) > RESTING_SHARE)
    return bool(medians) and float(np.sqrt(np.mean(np.square(medians)))) < MOVED_PX and np.mean(rests) >= 0.5
