"""Places frames that lie far from one another: features with stereo depth at both ends, and a robust rigid fit.

Optical flow follows neighbouring frames of a video. It finds nothing between stills, or when the endoscope has jumped.

Symbols: N features, M matches, H hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.clip.features import Features, find_features, matched
from intrasplat.poses.rigid import Reals, StereoCamera, align

WIDTH = 960
"""Maximum width in px of the picture in which features are found."""
MIN_CONTRAST = 0.01
"""Minimum contrast of a feature: tissue has less than SIFT's usual 0.04 in most places."""
MIN_CONFIDENCE = 128
"""Minimum confidence of a feature's depth, of 255."""
HYPOTHESES = 400
NEAR_PX = 2.0
"""A match agrees with a motion below this residual, px of the coarse grid: tissue deforms between far frames."""
MIN_MATCHES, MIN_SHARE = 12, 0.4
"""Minimum number, and share of all matches, that agree: of frames without common tissue up to 10 agree, or a sixth."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Features of a frame, and their measurements [N, 3] (column, row, disparity), px of the coarse grid."""

    features: Features
    seen: Reals


@dataclass(frozen=True, eq=False)
class FarMotion:
    """A rigid motion between two frames, and the matches that agree with it.

    motion         [4, 4] from the first frame's camera axes to the second's, mm
    before, after  [M, 3] measurements of the matches in both frames, px of the coarse grid
    share          of all matches of the two frames that agree
    """

    motion: Reals
    before: Reals
    after: Reals
    share: float


def landmarks(clip: DepthClip, index: int, camera: StereoCamera, step: int) -> Landmarks:
    """The features of a frame whose stereo depth is reliable. step: pixels of a cell of the coarse grid."""
    grey = cv2.createCLAHE(2.0, (8, 8)).apply(cv2.cvtColor(clip.rgb[index], cv2.COLOR_RGB2GRAY))
    depth_mm = clip.depth_mm[index]
    usable = clip.tissue[index] & (depth_mm > 0) & (clip.depth_confidence[index] >= MIN_CONFIDENCE)
    found = find_features(grey, WIDTH, usable, MIN_CONTRAST)
    columns, rows = np.clip(np.rint(found.points).astype(np.intp), 0, np.array(grey.shape[::-1]) - 1).T
    exact = usable[rows, columns]
    descriptors = found.descriptors[exact]
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))  # compared by Hellinger
    points, depth = found.points[exact], depth_mm[rows, columns][exact].astype(np.float64)
    clip.let_go(index)
    seen = np.column_stack([(points + 0.5) / step - 0.5, camera.fx * camera.baseline_mm / depth])
    return Landmarks(Features(points, descriptors), seen)


def far_motion(camera: StereoCamera, one: Landmarks, other: Landmarks) -> FarMotion | None:
    """The rigid motion from one frame to another, and its matches. The same frames give the same motion.

    None: the frames show no common tissue that could be matched.
    """
    pairs = matched(one.features, other.features, mutual=True)
    if len(pairs) < MIN_MATCHES:
        return None
    before, after = one.seen[pairs[:, 0]], other.seen[pairs[:, 1]]
    points = camera.points_mm(before)
    motions = _hypotheses(points, camera.points_mm(after))
    moved = np.einsum("hij,mj->hmi", motions[:, :3, :3], points) + motions[:, None, :3, 3]
    off_px = np.linalg.norm(camera.seen(moved.reshape(-1, 3)).reshape(moved.shape) - after, axis=2)
    best = (off_px < NEAR_PX).sum(1).argmax()
    near = off_px[best] < 2 * NEAR_PX
    before, after = before[near], after[near]
    if len(before) < MIN_MATCHES:
        return None
    found = align(camera, before, after, np.ones(len(before)), motions[best])
    agrees = found.residual_px < NEAR_PX
    if np.count_nonzero(agrees) < max(MIN_MATCHES, MIN_SHARE * len(pairs)):
        return None
    return FarMotion(found.motion, before[agrees], after[agrees], float(agrees.sum() / len(pairs)))


def _hypotheses(points: Reals, there: Reals) -> Reals:
    """[H, 4, 4] rigid motions that best take three points each, of points [M, 3], to their places there [M, 3]."""
    rng = np.random.default_rng(0)
    some = rng.integers(len(points), size=(HYPOTHESES, 3))
    one, two = points[some], there[some]
    middle, middle_there = one.mean(1, keepdims=True), two.mean(1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("hki,hkj->hij", two - middle_there, one - middle))
    flip = np.ones((HYPOTHESES, 3))
    flip[:, 2] = np.linalg.det(u @ vt)
    motions = np.tile(np.eye(4), (HYPOTHESES, 1, 1))
    motions[:, :3, :3] = (u * flip[:, None]) @ vt
    motions[:, :3, 3] = (middle_there - middle @ motions[:, :3, :3].transpose(0, 2, 1))[:, 0]
    return motions
