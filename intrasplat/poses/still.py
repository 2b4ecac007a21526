"""Whether the camera stands still, seen in a few frames: most of a fixed camera's picture rests most of the time."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, spread
from intrasplat.motion.lifted import cell_means

LOOK_WIDTH = 160
LOOKS = 8
"""Frames that are looked at, spread over the clip."""
RESTING_PX, RESTING_SHARE = 0.25, 0.4
"""Flow below which tissue rests, px of the small picture, and the share of textured tissue that must rest, in half of
the frames looked at."""
MOVED_PX = 0.8
"""Root mean square over the frames of the median flow, below which a camera counts as fixed: half a degree."""
MIN_SEEN = 0.1
"""Share of the picture that must show textured tissue."""
MIN_CONTRAST = 3.0
"""Standard deviation of a patch's grey levels for its flow to tell something."""


def camera_rests(clip: DepthClip, train: Sequence[int]) -> bool:
    """Whether so much of the picture rests that only a fixed camera explains it. False: look closer."""
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
