"""Which Gaussians the clip really saw: what the confidence layer blends.

Symbols: N Gaussians, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from worker.clip import DepthClip
from worker.model import Model
from worker.targets import TrainingFrames

SAMPLED_FRAMES = 24
"""Training frames looked at, evenly spread: the share is known to a few per cent."""
BEHIND = 0.03
"""A Gaussian farther than the rendered surface by this share of its depth is hidden there."""


def seen_share(model: Model, clip: DepthClip, frames: TrainingFrames) -> NDArray[np.float32]:
    """[N] in [0, 1]: share of training frames in which a Gaussian's centre lay on visible tissue, times the stereo
    confidence of that pixel."""
    total = np.zeros(model.count, np.float64)
    sampled = _spread(frames.indices, SAMPLED_FRAMES)
    for index in sampled:
        camera = frames.cameras[index]
        image = model.render(camera, float(frames.t[index]))
        surface = image[3] / np.maximum(image[4], 1e-6)
        x, y, z = _camera_points(model.deformed_mean(float(frames.t[index])), camera)
        column, row = np.floor(camera[0] * x / z + camera[2]), np.floor(camera[1] * y / z + camera[3])
        height, width = surface.shape
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        i, j = row[inside].astype(int), column[inside].astype(int)
        visible = clip.tissue[index][i, j] & (z[inside] <= surface[i, j] * (1 + BEHIND))
        total[inside] += visible * (clip.depth_confidence[index][i, j] / 255.0)
    return (total / len(sampled)).astype(np.float32)


def _spread(indices: Sequence[int], count: int) -> list[int]:
    places = np.unique(np.linspace(0, len(indices) - 1, min(count, len(indices))).round().astype(int))
    return [indices[place] for place in places]


def _camera_points(
    mean: NDArray[np.float32], camera: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Camera x, y, z of means [3, N]; z that is not positive becomes -1 so that nothing divides by 0."""
    pose = camera[6:].reshape(3, 4)
    points = pose[:, :3] @ mean + pose[:, 3:]
    z = np.where(points[2] > 0, points[2], -1.0)
    return points[0], points[1], z
