"""The confidence layer: the probability that each pixel of a view is right.

Symbols: H W pixels. A pixel is right if its depth errs by less than 2 % and its colour, in the mean of R G B, by
less than 0.03 of white. Its probability is a logistic function of three numbers (their ranks: docs/decisions/views.md):

trust         the Gaussians' trust (intrasplat/quality/trust.py), blended: how well training frames support them
disagreement  mean |difference| of R G B between the pixel and the endoscope's view of the same point at the same time.
              Where the endoscope sees that point, both show the same tissue.
texture       standard deviation of brightness around the pixel: where it is large, a small shift is a large error
"""

from __future__ import annotations

import math
from bisect import bisect_left

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.metrics import RIGHT_COLOUR

Image = NDArray[np.float32]

LEAST_TRUST, LEAST_DISAGREEMENT, LEAST_TEXTURE = 0.01, 0.005, 0.005
"""Lower limits of the three numbers; differences below them carry no information."""
WEIGHTS = np.array([1.0, -1.37, -0.48])
"""Weights of the trust's log odds, and of the logarithms of disagreement and texture. `python -m
lab.benchmarks.bm_confidence --fit` finds them."""
BIAS = -8.7
TEXTURE_SIDE_PX = 7
DETAIL_WEIGHT, DETAIL_BIAS = 0.9, -0.3
"""Of the weight with which recorded frames of two eyes reach a pixel: where they do, they bear the model out, too."""


def confidence(found: NDArray[np.float32], detail: Image | None = None) -> Image:
    """[H, W] confidence in (0, 1) from the evidence [3, H, W].

    detail: [H, W] in [0, 1], weight of the recorded frames in a view's detail; None: it has none, or of one eye alone.
    """
    odds = np.tensordot(WEIGHTS.astype(np.float32), found, axes=1) + np.float32(BIAS)
    if detail is not None:
        odds += np.float32(DETAIL_WEIGHT) * detail + np.float32(DETAIL_BIAS)
    return np.asarray(1 / (1 + np.exp(-odds)), np.float32)


def followed(scene: TrainedScene, t: float) -> float:
    """The factor of confidence at model time t: 1 at training times, least half way between them and beyond them.

    Where no number of bases follows the tissue, its places between training frames are guesses, although the Gaussians
    are right at those frames. Half way the factor is r / (r + s), where s = sqrt(scene.motion_error) is the size of
    colour errors there and r of those that are right: errors of one density near 0 are right in proportion to r / s.
    """
    times = scene.trained_t
    if not scene.motion_error or len(times) < 2:
        return 1.0
    after = min(max(bisect_left(times, t), 1), len(times) - 1)
    before, behind = times[after - 1], times[after]
    distance = min(1.0, min(abs(t - before), abs(t - behind)) / ((behind - before) / 2))
    size = distance * (2 - distance) * math.sqrt(scene.motion_error) / 255
    return RIGHT_COLOUR / (RIGHT_COLOUR + size)


def evidence(trust: Image, rgb: Image, known_rgb: Image) -> NDArray[np.float32]:
    """[3, H, W] log odds of trust [H, W], and logarithms of disagreement and texture.

    Args:
        rgb: [3, H, W] the view.
        known_rgb: [3, H, W] the endoscope's view of the same points (seen_from_endoscope).
    """
    likely = np.clip(trust, LEAST_TRUST, 1 - LEAST_TRUST)
    disagreement = np.abs(rgb - known_rgb).mean(0)
    return np.stack(
        [
            np.log(likely / (1 - likely)),
            np.log(disagreement + np.float32(LEAST_DISAGREEMENT)),
            np.log(_texture(rgb.mean(0)) + np.float32(LEAST_TEXTURE)),
        ]
    )


def seen_from_endoscope(
    endoscope_rgb: Image,
    depth_mm: Image,
    camera: tuple[Intrinsics, NDArray[np.float64]],
    endoscope: tuple[Intrinsics, NDArray[np.float64]],
) -> Image:
    """[3, H, W]: the endoscope's view [3, h, w], sampled at the points that the pixels of a view show.

    A point outside the endoscope's view gets the nearest pixel at the edge; a hidden point gets what hides it.

    Args:
        depth_mm: [H, W] depth of the view, above 0.
        camera, endoscope: intrinsics and world_from_camera [4, 4], mm, of the view and of the endoscope.
    """
    column, row = places_in_endoscope(depth_mm, camera, endoscope)
    picture = np.ascontiguousarray(endoscope_rgb.transpose(1, 2, 0))
    moved = cv2.remap(picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved.transpose(2, 0, 1), np.float32)


def places_in_endoscope(
    depth_mm: Image, camera: tuple[Intrinsics, NDArray[np.float64]], endoscope: tuple[Intrinsics, NDArray[np.float64]]
) -> tuple[Image, Image]:
    """Column and row [H, W], pixel (i, j) at (j, i), where the endoscope sees the points that a view's pixels show.

    The arguments are those of seen_from_endoscope.
    """
    (k, pose), (own_k, own_pose) = camera, endoscope
    height, width = depth_mm.shape
    own_from_view = (np.linalg.inv(own_pose) @ pose).astype(np.float32)
    x = ((np.arange(width, dtype=np.float32) + np.float32(0.5 - k.cx)) / np.float32(k.fx))[None]
    y = ((np.arange(height, dtype=np.float32) + np.float32(0.5 - k.cy)) / np.float32(k.fy))[:, None]
    points = [depth_mm * (row[0] * x + row[1] * y + row[2]) + row[3] for row in own_from_view[:3]]
    ahead = np.maximum(points[2], np.float32(1e-3))
    column = np.float32(own_k.fx) * points[0] / ahead + np.float32(own_k.cx - 0.5)
    row = np.float32(own_k.fy) * points[1] / ahead + np.float32(own_k.cy - 0.5)
    return column, row


def _texture(brightness: Image) -> Image:
    """[H, W] standard deviation of brightness in a square about each pixel."""
    side = (TEXTURE_SIDE_PX, TEXTURE_SIDE_PX)
    variance = cv2.blur(brightness * brightness, side) - cv2.blur(brightness, side) ** 2
    return np.asarray(np.sqrt(np.maximum(variance, 0)), np.float32)
