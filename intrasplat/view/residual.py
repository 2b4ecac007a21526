"""Residuals of recorded frames, and the points of a view that they are carried to (intrasplat/view/detail.py).

Symbols: H W pixels of the view, h w of a recorded picture, m n cells of the view, N Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.splat.cpu.threads import run
from intrasplat.view.transfer import ONE, carry, gather

Floats = NDArray[np.float32]
Pose = NDArray[np.float64]

CELL_PX = 8
"""Motion is smooth: it is averaged in cells of so many pixels along each side. Angles are those of their middles."""
NEAR_CELLS, FAR_CELLS, LITTLE = 0.7, 6.0, np.float32(0.02)
"""Standard deviations of the mean of neighbouring cells, and of the one that fills in where no Gaussian's centre lies,
with this weight."""
SHOWN = 0.05
"""Largest relative difference of depth of a Gaussian that the view shows, from the view's depth."""
MAX_DEPTH_ERROR = 0.06
"""Relative difference of depth at which an eye saw another point: nearer tissue hid this one."""
MIN_SEEN = np.float32(0.3)
"""Validity from which on a pixel takes part in the flow between two frames."""
MIN_SIDE_PX = 48
"""Pictures with a shorter side have no flow: OpenCV's crashes in some of them."""
FLOW_CELLS = 1.0
"""Standard deviation, in cells, of the mean of what the motion of the model leaves between two frames."""


@dataclass(frozen=True, eq=False)
class Residual:
    """A training frame's residual for one eye.

    planes    [h + 2, w + 2, 4] int16, with a border of zeros: R G B times validity, and validity, times ONE; it is 1
              where the recorded picture shows tissue, and falls to 0 towards what it does not
    depth_mm  [h + 2, w + 2] of the model in that eye
    grey      [h, w] of the recorded picture, in steady light
    lens, world_from_eye   its camera; [4, 4] mm
    means_mm  [3, N] the Gaussians' centres at that frame, world
    """

    planes: NDArray[np.int16]
    depth_mm: Floats
    grey: NDArray[np.uint8]
    lens: Intrinsics
    world_from_eye: Pose
    means_mm: Floats


class Points:
    """The points that a view shows."""

    def __init__(self, world_from_camera: Pose, lens: Intrinsics, depth_mm: Floats) -> None:
        self._pose, self._lens, self.depth_mm = world_from_camera, lens, np.ascontiguousarray(depth_mm)
        down, across = (
            np.minimum(np.arange(CELL_PX // 2, size + CELL_PX // 2, CELL_PX), size - 1) for size in depth_mm.shape
        )
        coarse_mm = depth_mm[down[:, None], across]
        self._coarse_mm = np.where(coarse_mm > 0, coarse_mm, _median(coarse_mm[coarse_mm > 0]))
        self._x = np.asarray((across + 0.5 - lens.cx) / lens.fx, np.float32)[None]
        self._y = np.asarray((down + 0.5 - lens.cy) / lens.fy, np.float32)[:, None]

    def squared_angle(self, world_from_eye: Pose, world_from_other: Pose | None = None) -> Floats:
        """[m, n] squared angle, radians, in cells between the rays to an eye and the other, or the view."""
        x, y, z = self._seen_from(world_from_eye)
        other = self._pose if world_from_other is None else world_from_other
        view_mm = (np.linalg.inv(world_from_eye) @ other)[:3, 3].astype(np.float32)
        eye_length = np.sqrt(x * x + y * y + z * z)
        a, b, c = x - view_mm[0], y - view_mm[1], z - view_mm[2]
        view_length = np.sqrt(a * a + b * b + c * c)
        cosine = (x * a + y * b + z * c) / np.maximum(eye_length * view_length, np.float32(1e-6))
        return np.asarray(np.maximum(2 - 2 * cosine, 0), np.float32)

    def _seen_from(self, world_from_eye: Pose) -> tuple[Floats, Floats, Floats]:
        """x, y and z [m, n] of the points in the cells' middles, in an eye's axes, mm."""
        eye_from_view = (np.linalg.inv(world_from_eye) @ self._pose).astype(np.float32)
        x, y, z = (self._coarse_mm * (a * self._x + b * self._y + c) + d for a, b, c, d in eye_from_view[:3])
        return x, y, z

    def finer(self, weights: Floats) -> Floats:
        """[H, W] of weights in cells."""
        return np.asarray(cv2.resize(weights, self.depth_mm.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)

    def motion_mm(self, means_mm: Floats, others_mm: Sequence[Floats], opacity: Floats) -> list[Floats]:
        """[m, n, 3] motion, world axes, in the view's cells, from its time to each of some others.

        Args:
            means_mm: [3, N] the Gaussians' centres at the view's time; others_mm: at the other times.
            opacity: [N] theirs.
        """
        height, width = self.depth_mm.shape
        sums = np.zeros((-(-height // CELL_PX), -(-width // CELL_PX), 3 * len(others_mm) + 1), np.float32)
        view_from_world = np.ascontiguousarray(np.linalg.inv(self._pose)[:3], np.float32)
        gather(
            means_mm, np.stack(others_mm), opacity, view_from_world, _numbers(self._lens), self.depth_mm,
            np.float32(SHOWN), sums,
        )  # fmt: skip
        planes = cv2.GaussianBlur(sums, (0, 0), NEAR_CELLS) + LITTLE * cv2.GaussianBlur(sums, (0, 0), FAR_CELLS)
        mean = planes[..., :-1] / np.maximum(planes[..., -1:], np.float32(1e-9))
        return [mean[..., 3 * place : 3 * place + 3] for place in range(len(others_mm))]

    def carry(self, residual: Residual, moved_mm: Floats, weight: float, total: Floats) -> None:
        """Add a residual to total [H, W, 4]: R G B times weight, and weight, where the points were at its frame.

        moved_mm: [m, n, 3] motion from the view's time to the residual's, world axes.
        """
        eye_from_world = np.linalg.inv(residual.world_from_eye)
        turned = np.ascontiguousarray(moved_mm @ eye_from_world[:3, :3].T.astype(np.float32))
        eye_from_view = np.ascontiguousarray((eye_from_world @ self._pose)[:3], np.float32)
        run(
            carry, self.depth_mm, _numbers(self._lens), eye_from_view, turned, residual.planes, residual.depth_mm,
            _numbers(residual.lens), np.float32(MAX_DEPTH_ERROR), np.float32(weight), total,
        )  # fmt: skip

    def apart_px(self, residual: Residual, moved_mm: Floats, apart: Floats) -> Floats:
        """[m, n, 2] of flow_between() in the view's cells, at the residual's frame, which is the flow's first."""
        eye_from_world = np.linalg.inv(residual.world_from_eye)[:3, :3].astype(np.float32)
        seen = np.stack(self._seen_from(residual.world_from_eye), axis=-1) + moved_mm @ eye_from_world.T
        lens, z = residual.lens, np.maximum(seen[..., 2], np.float32(1e-3))
        u = (lens.fx * seen[..., 0] / z + lens.cx) * (apart.shape[1] / lens.width) - 0.5
        v = (lens.fy * seen[..., 1] / z + lens.cy) * (apart.shape[0] / lens.height) - 0.5
        found = cv2.remap(
            apart, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(found, np.float32)

    def shifted(self, residual: Residual, moved_mm: Floats, shift_px: Floats) -> Floats:
        """Motion [m, n, 3], of carry(), that leads so many pixels [m, n, 2] farther in the residual's picture."""
        lens, (_, _, z) = residual.lens, self._seen_from(residual.world_from_eye)
        across = np.stack([shift_px[..., 0] * z / np.float32(lens.fx), shift_px[..., 1] * z / np.float32(lens.fy)], -1)
        return np.asarray(moved_mm + across @ residual.world_from_eye[:3, :2].T.astype(np.float32), np.float32)


def flow_between(before: Residual, after: Residual, opacity: Floats) -> Floats:
    """What the model's motion leaves between two recorded frames of an eye: optical flow, px, in cells of the first.

    A point that the model moves from x in the first frame to y in the second is found there at y plus the flow at x.
    opacity: [N] of the Gaussians.
    """
    height, width = before.grey.shape
    cells = (-(-width // CELL_PX), -(-height // CELL_PX))
    if min(height, width) < MIN_SIDE_PX:
        return np.zeros((*cells[::-1], 2), np.float32)
    points = Points(before.world_from_eye, before.lens, before.depth_mm[1:-1, 1:-1])
    (moved_mm,) = points.motion_mm(before.means_mm, [after.means_mm], opacity)
    planes, valid = np.zeros_like(after.planes), after.planes[..., 3]
    planes[..., 3] = valid
    planes[1:-1, 1:-1, 0] = after.grey * (valid[1:-1, 1:-1] * np.float32(1 / 255))
    carried = np.zeros((height, width, 4), np.float32)
    points.carry(replace(after, planes=planes), moved_mm, 1.0, carried)
    is_seen = (carried[..., 3] > MIN_SEEN) & (before.planes[1:-1, 1:-1, 3] > MIN_SEEN * ONE)
    there = np.where(is_seen, carried[..., 0] / np.maximum(carried[..., 3], MIN_SEEN) * 255, before.grey)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST).calc(
        before.grey, np.rint(there).astype(np.uint8), np.zeros((height, width, 2), np.float32)
    )
    weights = is_seen.astype(np.float32)
    planes_of_cells = cv2.resize(np.dstack([flow * weights[..., None], weights]), cells, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(planes_of_cells, (0, 0), FLOW_CELLS)
    return np.asarray(smooth[..., :2] / (smooth[..., 2:] + np.float32(0.1)), np.float32)


def _numbers(lens: Intrinsics) -> Floats:
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy], np.float32)


def _median(values: Floats) -> np.float32:
    return np.float32(np.median(values)) if values.size else np.float32(1)
