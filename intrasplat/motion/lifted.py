"""A clip's frames on the coarse grid, and optical flow between two of them lifted to 3D.

Symbols: h w cells of the coarse grid.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import unproject
from intrasplat.clip import DepthClip
from intrasplat.motion.complete import complete_depth

Floats = NDArray[np.float32]

ROUND_TRIP_PX = 1.0
"""A difference of this much between forward and backward flow, in px of the coarse grid, halves the confidence."""
SMOOTH_PX = 4.0
"""Standard deviation of the Gaussian mean of displacements, in px of the coarse grid: depth is noisy."""
COLOUR_SMOOTH_PX = 2.0
"""The same for changes of colour: illumination varies over smaller patches than motion does."""
SURROUNDINGS = 0.1
"""Weight of the wider surroundings' mean in an average; full trust has 1."""
LOST, LOST_SMOOTH_PX = 0.1, 1.0
"""A track of less confidence is lost and ends on the surrounding surface; width of the transition, px of the grid."""
PARALLAX_SMOOTH_PX = 4.0
"""Standard deviation of the Gaussian mean of the flow due to camera motion, px of the coarse grid."""
MIN_DEPTH_MM = 1e-3


def cell_means(image: NDArray[Any], step: int) -> NDArray[Any]:
    """Means [h, w, ...] over cells of step by step pixels. Cell (i, j) starts at pixel (step i, step j).

    Pixels beyond the last whole cell are ignored.
    """
    h, w = image.shape[0] // step, image.shape[1] // step
    means: NDArray[Any] = cv2.resize(image[: h * step, : w * step], (w, h), interpolation=cv2.INTER_AREA)
    return means


class PointGrid:
    """The coarse grid of h w cells, step pixels apart: the pixels that it samples and their rays."""

    def __init__(self, clip: DepthClip, step: int) -> None:
        height, width = clip.tissue.shape[1:]
        self.step, self.size = step, (width // step, height // step)
        rows, columns = np.mgrid[0 : self.size[1], 0 : self.size[0]] * step + step // 2
        pixels = (rows * width + columns).ravel()
        rays = unproject(pixels, np.ones(pixels.size, np.float32), clip.intrinsics, np.eye(4))
        self.rays = rays.reshape(*rows.shape, 3).astype(np.float32)
        """[h, w, 3] points at depth 1, camera axes."""
        self.cells = np.stack(np.meshgrid(np.arange(self.size[0]), np.arange(self.size[1])), axis=-1).astype(np.float32)
        """[h, w, 2] column and row of every cell."""

    def cells_at(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Column and row in the grid, not rounded, of points (x, y, 1) in camera axes."""
        height, width = self.rays.shape[:2]
        (left, top, _), (right, bottom, _) = self.rays[0, 0], self.rays[-1, -1]
        return (x - left) * ((width - 1) / (right - left)), (y - top) * ((height - 1) / (bottom - top))

    def sample(self, values: NDArray[Any]) -> NDArray[Any]:
        """The cells' middle pixels [h, w] of an image, as a view."""
        return values[self.step // 2 :: self.step, self.step // 2 :: self.step][: self.size[1], : self.size[0]]


class CoarseFrame:
    """A frame on the coarse grid: colour, grey, depth, points (world, mm), and the confidence of depth and mask.

    Missing depth is completed from the surroundings; it is 0 in a frame without any depth. Only correct_depth() changes
    it.
    """

    def __init__(self, clip: DepthClip, index: int, grid: PointGrid) -> None:
        self.grey = cell_means(cv2.cvtColor(clip.rgb[index], cv2.COLOR_RGB2GRAY), grid.step)
        self.rgb = np.asarray(cell_means(clip.rgb[index], grid.step) / np.float32(255), np.float32)
        depth_mm = grid.sample(clip.depth_mm[index])
        usable = grid.sample(clip.tissue[index]) & (depth_mm > 0)
        pose = clip.world_from_camera[index].astype(np.float32)
        self.grid, self.axes, self.place_mm = grid, pose[:3, :3], pose[:3, 3]
        self._put(complete_depth(depth_mm, usable, np.ones_like(usable)))
        confidence = grid.sample(clip.depth_confidence[index]) / np.float32(255)
        self.trust = np.where(usable, confidence, np.float32(0))
        clip.let_go(index)

    def _put(self, depth_mm: Floats) -> None:
        self.depth_mm = depth_mm
        self.points_mm: Floats = (self.grid.rays * depth_mm[..., None]) @ self.axes.T + self.place_mm

    def correct_depth(self, depth_mm: Floats, where: NDArray[np.bool_]) -> None:
        """Take another depth [h, w], without any confidence; where: [h, w] bool."""
        self._put(np.where(where, depth_mm, self.depth_mm))
        self.trust[where] = 0

    def stands_at(self, other: CoarseFrame) -> bool:
        """Whether both frames have the same camera pose."""
        return np.array_equal(self.axes, other.axes) and np.array_equal(self.place_mm, other.place_mm)

    def parallax(self, other: CoarseFrame) -> Floats:
        """Flow [h, w, 2] to the other frame for tissue at rest, smoothed because depth is noisy."""
        x, y, z = np.moveaxis((self.points_mm - other.place_mm) @ other.axes, -1, 0)
        z = np.maximum(z, MIN_DEPTH_MM)
        exact = np.stack(self.grid.cells_at(x / z, y / z), axis=-1) - self.grid.cells
        return np.asarray(cv2.GaussianBlur(exact, (0, 0), PARALLAX_SMOOTH_PX), np.float32)


class Flows:
    """Optical flow (DIS) from one frame to others and back. Call in order of time: each flow initialises the next.

    The pictures are first warped by the flow due to camera motion, because DIS cannot match patches that are rotated,
    scaled or far away.
    """

    def __init__(self, start: CoarseFrame) -> None:
        self._solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._start = start
        self._left: Floats | None = None
        """Last flow [h, w, 2] without the parallax."""

    def to(self, target: CoarseFrame) -> tuple[Floats, Floats]:
        """Flows [h, w, 2] to another frame and back."""
        start, last = self._start, None if self._left is None else self._left.copy()
        if target.stands_at(start):
            self._left = self._solver.calc(start.grey, target.grey, last)
            return self._left, self._solver.calc(target.grey, start.grey, -self._left)
        cells = start.grid.cells
        there, back = start.parallax(target), target.parallax(start)
        self._left = self._solver.calc(start.grey, _seen_at(target.grey, cells + there, start.grey), last)
        to_start = cells + back
        first = -_sampled(self._left, to_start)
        left = self._solver.calc(target.grey, _seen_at(start.grey, to_start, target.grey), first)
        return self._left + _sampled(there, cells + self._left), left + _sampled(back, cells + left)


def _seen_at(grey: NDArray[np.uint8], places: Floats, outside: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture [h, w] at columns and rows [h, w, 2]; beyond its edges, `outside`."""
    (height, width), column, row = grey.shape, places[..., 0], places[..., 1]
    inside = (column >= 0) & (row >= 0) & (column <= width - 1) & (row <= height - 1)
    return np.where(inside, _sampled(grey, places), outside)


def _sampled(values: NDArray[Any], places: Floats) -> NDArray[Any]:
    """values [h, w, ...] at columns and rows [h, w, 2]; beyond their edges, those of the edge."""
    return np.asarray(cv2.remap(values, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def lifted(
    reference: CoarseFrame, target: CoarseFrame, forward: Floats, backward: Floats
) -> tuple[Floats, Floats, Floats]:
    """Displacement (mm), change of colour and confidence of every reference cell, from forward and backward flow."""
    places = reference.grid.cells + forward

    def at_target(values: Floats) -> Floats:
        moved: Floats = cv2.remap(values, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return moved

    round_trip = np.square(forward + at_target(backward))
    trust = at_target(target.trust)
    agree = 1 / (1 + ((round_trip[..., 0] + round_trip[..., 1]) / ROUND_TRIP_PX**2) ** 2)
    confidence = reference.trust * trust * (trust > 0.5) * agree
    point_mm = at_target(target.points_mm * target.trust[..., None]) / np.maximum(trust, 1e-3)[..., None]
    displacement = averaged(np.subtract(point_mm, reference.points_mm), confidence, SMOOTH_PX)
    if target.depth_mm.any():  # otherwise its surface is unknown
        displacement = _onto_surface(reference, target, displacement, confidence)
    colour = averaged(np.subtract(at_target(target.rgb), reference.rgb), confidence, COLOUR_SMOOTH_PX)
    return displacement, colour, np.minimum(confidence, 1).astype(np.float32)


def _onto_surface(reference: CoarseFrame, target: CoarseFrame, displacement: Floats, confidence: Floats) -> Floats:
    """The displacement [h, w, 3], with the ends of lost tracks moved along the line of sight onto target's surface.

    Hidden tissue thus stays on the surrounding surface. A displacement extrapolated from farther away, where tissue may
    be pulled towards the camera, would lift it into free space.
    """
    end_mm = (reference.points_mm + displacement - target.place_mm) @ target.axes
    z = np.maximum(end_mm[..., 2], MIN_DEPTH_MM)
    x, y = target.grid.cells_at(end_mm[..., 0] / z, end_mm[..., 1] / z)
    surface_mm = cv2.remap(target.depth_mm, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lost = cv2.GaussianBlur((confidence < LOST).astype(np.float32), (0, 0), LOST_SMOOTH_PX)
    if not target.stands_at(reference):  # the surface is unknown outside the view
        lost *= (x >= 0) & (y >= 0) & (x <= lost.shape[1] - 1) & (y <= lost.shape[0] - 1)
    along_mm = end_mm * (lost * (surface_mm / z - 1))[..., None]
    return np.asarray(displacement + along_mm @ target.axes.T, np.float32)


def averaged(values: Floats, confidence: Floats, over_px: float) -> Floats:
    """Normalised convolution: Gaussian mean [h, w, 3] weighted by confidence.

    Where no neighbour is trusted, wider surroundings fill in.
    """
    weight = np.asarray(cv2.GaussianBlur(confidence, (0, 0), over_px), np.float32)
    return _completed(cv2.GaussianBlur(values * confidence[..., None], (0, 0), over_px), weight)


def _completed(total: Floats, weight: Floats) -> Floats:
    """total [h, w, 3] / weight [h, w]; the result on a grid half as fine counts as one more observation (pull-push)."""
    height, width = weight.shape
    if min(height, width) < 2:
        return np.broadcast_to(total.sum((0, 1)) / max(float(weight.sum()), 1e-9), total.shape).astype(np.float32)
    half = ((width + 1) // 2, (height + 1) // 2)
    coarse = _completed(*(np.asarray(cv2.resize(x, half, interpolation=cv2.INTER_AREA)) for x in (total, weight)))
    wider = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray((total + SURROUNDINGS * wider) / (weight + SURROUNDINGS)[..., None], np.float32)
