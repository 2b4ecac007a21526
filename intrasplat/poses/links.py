"""Matches between two frames of a clip: optical flow on a coarse grid, with stereo disparity at both ends.

Symbols: h w cells of the coarse grid, M matches.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import local

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from intrasplat.clip import DepthClip
from intrasplat.motion.lifted import cell_means
from intrasplat.poses.rigid import Aligned, Reals, StereoCamera, align
from intrasplat.poses.wide import FarMotion, Landmarks, far_motion, landmarks

Floats = NDArray[np.float32]

FLOW_WIDTH = 320
"""Maximum width in px of the field of view at which flow is computed: the clip is reduced by the smallest whole factor
that fits."""
MATCH_STEP = 5
"""Cells of the grid between neighbouring matches."""
PATCH_PX = 11
"""Side of the patches that refine the flow. Dense flow is smoother than the true motion, and attributes 4 % of the
parallax to a rotation of the camera. Wider patches are too smooth as well."""
SHADE_PX, CONTRAST, MIN_SPREAD = 10.0, 40.0, 10.0
"""Contrast normalisation before patches are compared: width of the local mean and deviation; target standard deviation
in levels of 255; what is added to the measured one, so that noise is not amplified."""
MAX_OFF = 25.0
"""Maximum mean difference of two patches, in those levels; unrelated textures have 27 or more, most matches 5 to 20."""
LOST = -1e4
"""Position of a patch that was not found."""
ROUND_TRIP_PX = 1.0
"""A forward-backward difference of this much halves the trust in a match."""
MIN_TRUST, MIN_MATCH_TRUST = 0.5, 0.1
"""Minimum confidence of depth at both ends of a match; minimum trust of a match that counts."""
AGREES_PX = 1.5
"""Residual below which a match agrees with the fit."""
FEATURE_TRUST = 8.0
"""Trust in a match of features: those of flow lie so near to one another that they count much less each."""
FLOW_SUFFICES = 0.35
"""From this agreeing share on of what both frames show, flow is used rather than features."""
PSEUDO_BASELINE_MM = 4.3
"""Given depth is converted to the disparity of a stereo camera with this baseline."""


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame on the coarse grid.

    grey, even  [h, w] grey levels, and the same with even contrast
    disparity   [h, w] px of the grid, 0 where there is none
    trust       [h, w] confidence of the disparity, 0 to 1; 0 off tissue
    """

    grey: NDArray[np.uint8]
    even: NDArray[np.uint8]
    disparity: Floats
    trust: Floats


@dataclass(frozen=True, eq=False)
class FrameLink:
    """Matches from frame a to frame b.

    cells  [M]     indices among a's cells with depth, which are the same in all links of a
    before [M, 3]  (column, row, disparity) in a, px of the coarse grid
    after  [M, 3]  in b
    trust  [M]     in [0, 1]; of features FEATURE_TRUST
    overlap        share of a's cells with depth that were found in b
    flow [h, w, 2] an initial flow for another link
    """

    a: int
    b: int
    cells: NDArray[np.intp]
    before: Reals
    after: Reals
    trust: Reals
    overlap: float
    flow: Floats = field(repr=False)

    def agreeing(self, residual_px: Reals) -> float:
        """The share of a's cells with depth that match as expected. residual_px [M]: of the matches."""
        return self.overlap * float(np.mean(residual_px < AGREES_PX)) if len(residual_px) else 0.0


class Frames:
    """The clip's frames on the coarse grid, computed on demand and cached, and links between them.

    Threads may share it.
    """

    def __init__(self, clip: DepthClip) -> None:
        k = clip.intrinsics
        step = -(-_field_width(clip) // FLOW_WIDTH)
        self._clip, self._step = clip, step
        right = clip.right
        baseline_mm = PSEUDO_BASELINE_MM
        if right is not None:
            baseline_mm = float(np.linalg.norm(right.world_from_camera[0, :3, 3] - clip.world_from_camera[0, :3, 3]))
        self.camera = StereoCamera(k.fx / step, k.fy / step, k.cx / step - 0.5, k.cy / step - 0.5, baseline_mm)
        self._others: dict[int, DepthClip] = {}
        self._cache: dict[int, TrackedFrame] = {}
        self._landmarks: dict[int, Landmarks] = {}
        self._thread = local()

    def take(self, index: int, moment: DepthClip) -> None:
        """Frame `index` is that of a clip of one frame, of the same cameras, which need not be one of this clip."""
        self._others[index] = moment

    def _source(self, index: int) -> tuple[DepthClip, int]:
        """The clip of a frame, and its index there."""
        return (self._others[index], 0) if index in self._others else (self._clip, index)

    def frame(self, index: int) -> TrackedFrame:
        """A frame of the clip."""
        if index not in self._cache:
            (clip, place), step = self._source(index), self._step
            grey = cell_means(cv2.cvtColor(clip.rgb[place], cv2.COLOR_RGB2GRAY), step)
            height, width = grey.shape
            pick = slice(step // 2, None, step)
            depth_mm = clip.depth_mm[place][pick, pick][:height, :width]
            usable = clip.tissue[place][pick, pick][:height, :width] & (depth_mm > 0)
            confidence = clip.depth_confidence[place][pick, pick][:height, :width] / np.float32(255)
            ratio = np.float32(self.camera.fx * self.camera.baseline_mm)
            disparity = np.where(usable, ratio / np.maximum(depth_mm, 1e-3), np.float32(0))
            clip.let_go(place)
            self._cache[index] = TrackedFrame(
                grey, even_contrast(grey), disparity, np.where(usable, confidence, np.float32(0))
            )
        return self._cache[index]

    def forget(self, index: int) -> None:
        """Free a frame's memory."""
        for each in (self._cache, self._landmarks, self._others):
            each.pop(index, None)

    def far_motion(self, a: int, b: int) -> FarMotion | None:
        """The motion from frame a to frame b, however far apart; None: they show no common tissue that matches."""
        for index in (a, b):
            if index not in self._landmarks:
                self._landmarks[index] = landmarks(*self._source(index), self.camera, self._step)
        return far_motion(self.camera, self._landmarks[a], self._landmarks[b])

    def far_link(self, a: int, b: int, far: FarMotion) -> tuple[FrameLink, Aligned]:
        """Matches from frame a to frame b, and the motion that they give from a's camera axes to b's.

        They are those of flow that starts from the features' motion, or the features' own if these agree on more.
        """
        flow, in_view = self.predicted(a, far.motion)
        link = self.link(a, b, flow)
        aligned = align(self.camera, link.before, link.after, link.trust, far.motion)
        overlap = in_view * far.share
        if link.agreeing(aligned.residual_px) > min(overlap, FLOW_SUFFICES * in_view):
            return link, aligned
        columns, rows = self._matched(self.frame(a))
        cells = cKDTree(np.stack([columns, rows], axis=1)).query(far.before[:, :2])[1]
        trust = np.full(len(cells), FEATURE_TRUST)
        link = FrameLink(a, b, np.asarray(cells, np.intp), far.before, far.after, trust, overlap, flow)
        return link, align(self.camera, far.before, far.after, trust, far.motion)

    def link(self, a: int, b: int, start: Floats | None = None) -> FrameLink:
        """Matches from frame a to frame b. start: an initial flow [h, w, 2], which is not changed."""
        one, two = self.frame(a), self.frame(b)
        flow = self._solver().calc(one.grey, two.grey, None if start is None else start.copy())
        columns, rows = self._matched(one)
        if not columns.size:  # OpenCV refuses to move no points
            nowhere = np.empty((0, 3))
            return FrameLink(a, b, np.empty(0, np.intp), nowhere, nowhere, np.empty(0), 0.0, flow)
        places = np.stack([columns, rows], axis=1).astype(np.float32)
        height, width = one.grey.shape
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        warped = cv2.remap(
            two.even, grid + flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128
        )
        near = _patches(one.even, warped, places, places)
        back = _patches(warped, one.even, near, places)
        moved = cv2.remap(
            flow, near[:, :1], near[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=LOST
        )
        there = near + moved[:, 0]
        x, y = there.T[:, :, None]

        def at(values: Floats) -> Floats:
            found: Floats = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
            return found[:, 0]

        trust_a, trust_b = one.trust[rows, columns], at(two.trust)
        agree = 1 / (1 + (np.square(back - places).sum(-1) / ROUND_TRIP_PX**2) ** 2)
        disparity_b = at(two.disparity * two.trust) / np.maximum(trust_b, 1e-3)
        trust = trust_a * trust_b * (trust_b > MIN_TRUST) * agree
        found = (trust > MIN_MATCH_TRUST) & (disparity_b > 0.1)
        cells = np.flatnonzero(found)
        before = np.stack([columns, rows, one.disparity[rows, columns]], axis=1)[cells].astype(np.float64)
        after = np.stack([x[:, 0], y[:, 0], disparity_b], axis=1)[cells].astype(np.float64)
        overlap = len(cells) / max(len(found), 1)
        return FrameLink(a, b, cells, before, after, trust[cells].astype(np.float64), overlap, flow)

    def predicted(self, a: int, b_from_a: Reals) -> tuple[Floats, float]:
        """The flow [h, w, 2] of frame a's tissue if it is rigid, and the share of it that stays in view."""
        one = self.frame(a)
        height, width = one.disparity.shape
        rows, columns = (each.ravel() for each in np.mgrid[0:height:8, 0:width:8])
        disparity = one.disparity[rows, columns]
        known = disparity > 0
        if not known.any():
            return np.zeros((height, width, 2), np.float32), 0.0
        filled = np.where(known, disparity, np.median(disparity[known]))
        seen = np.stack([columns, rows, filled], axis=1).astype(np.float64)
        moved = self.camera.points_mm(seen) @ b_from_a[:3, :3].T + b_from_a[:3, 3]
        there = self.camera.seen(moved)
        inside = (there[:, :2] >= 0).all(1) & (there[:, 0] < width) & (there[:, 1] < height) & (moved[:, 2] > 1)
        shift = (there - seen)[:, :2].reshape(-(-height // 8), -(-width // 8), 2).astype(np.float32)
        flow: Floats = cv2.resize(shift, (width, height), interpolation=cv2.INTER_LINEAR)
        return flow, float((inside & known).sum() / known.sum())

    def _solver(self) -> cv2.DISOpticalFlow:
        """The calling thread's solver: it has buffers."""
        if not hasattr(self._thread, "solver"):
            self._thread.solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        solver: cv2.DISOpticalFlow = self._thread.solver
        return solver

    def _matched(self, frame: TrackedFrame) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns and rows [M'] of the frame's cells that are matched: those with confident depth."""
        height, width = frame.grey.shape
        rows, columns = np.mgrid[MATCH_STEP // 2 : height : MATCH_STEP, MATCH_STEP // 2 : width : MATCH_STEP]
        known = frame.trust[rows, columns] > MIN_TRUST
        return columns[known], rows[known]


def _field_width(clip: DepthClip) -> int:
    """Width of the field of view in px."""
    if clip.field_of_view is None or not clip.field_of_view.any():
        return clip.intrinsics.width
    columns = np.flatnonzero(clip.field_of_view.any(0))
    return int(columns[-1] - columns[0] + 1)


def _patches(one: NDArray[np.uint8], two: NDArray[np.uint8], places: Floats, guess: Floats) -> Floats:
    """Positions [M, 2] in picture `two` of the patches at `places` in picture `one` (Lucas-Kanade, from a guess)."""
    if not len(places):
        return guess
    found, status, off = cv2.calcOpticalFlowPyrLK(
        one,
        two,
        places[:, None].copy(),
        guess[:, None].copy(),
        winSize=(PATCH_PX, PATCH_PX),
        maxLevel=0,
        criteria=(3, 10, 0.02),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    return np.where((status == 1) & (off < MAX_OFF), found[:, 0], np.float32(LOST)).astype(np.float32)


def even_contrast(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with locally even brightness and contrast: shading by the lamp moves with the camera."""
    off = grey - cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SHADE_PX)
    spread = np.sqrt(cv2.GaussianBlur(off * off, (0, 0), SHADE_PX))
    return np.asarray(np.clip(128 + CONTRAST * off / (spread + MIN_SPREAD), 0, 255), np.uint8)
