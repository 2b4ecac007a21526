"""Gaussians for tissue that has none: where the camera moves on or near, or an instrument moves away.

Their number never changes. A new one takes the place of one that hardly any picture of late has used.

Symbols: N Gaussians, M new ones, k stride: distance in px at which the first frame's Gaussians started.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.fusion.points import cells_of, points_at
from intrasplat.live.window import SECOND_MOMENTS, WEIGHT, Window
from intrasplat.methods.fast import INSTANT
from intrasplat.splat.constants import SH_C0
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import COLOUR, COLOUR_ROW, GLOSS_ROW, LOG_SCALE, MEAN, QUATERNION, QUATERNION_ROW
from intrasplat.splat.model import FIRST_MOMENTS

UNUSED_LOGIT = -20.0
"""Of a Gaussian that is not drawn."""
FORGETTING = 0.9
"""Use of a Gaussian that the pictures no longer show, from one look to the next."""
MAX_USE_PX = 0.5
"""A Gaussian that filled more than these pixels of late keeps its place."""
CELL = 2
"""Strides along a square of tissue in which at least one Gaussian must be."""
LEAST_SHARE, MUCH_SHARE, LONG_FRAMES = 2e-3, 2e-2, 4
"""Share of the cells without a Gaussian that is left alone; that is filled at once; used frames after which less is."""


def with_spares(gaussians: Gaussians, share: float) -> Gaussians:
    """The Gaussians, and a share of as many that are not drawn yet."""
    count = len(gaussians)
    rows = torch.arange(count + round(share * count)) % count
    tensors = {name: each[rows] for name, each in gaussians.tensors().items()}
    tensors["opacity_logit"][count:] = UNUSED_LOGIT
    return dataclasses.replace(gaussians, **tensors)


class Cover:
    """How much each Gaussian was used of late, and the replacing of those that were not."""

    def __init__(self, count: int, stride: int) -> None:
        self.use_px = np.zeros(count, np.float32)
        self._stride, self._waited = stride, 0

    def renew(self, window: Window) -> NDArray[np.intp]:
        """Give Gaussians to the newest frame's tissue without any, if it is much or has not been for long; returns
        their columns [M]."""
        means_mm = window.model.deformed_mean(window.slot).T / np.float32(window.scale)
        pixels, share = self._bare(window.newest.clip, window.shown(), means_mm[self.use_px > 0])
        self._waited += 1
        if share < LEAST_SHARE or (share < MUCH_SHARE and self._waited < LONG_FRAMES):
            return np.zeros(0, np.intp)
        self._waited = 0
        used_px = self._look(window)
        columns = np.flatnonzero(used_px <= MAX_USE_PX)
        columns = columns[np.argsort(self.use_px[columns], kind="stable")][: len(pixels)]
        if len(columns):
            self._put(window, pixels[: len(columns)], columns, means_mm, used_px)
        return columns

    def _look(self, window: Window) -> NDArray[np.float32]:
        """[N] what the newest frame's pictures use, px; use_px learns it."""
        found = np.zeros_like(self.use_px)
        self.use_px *= np.float32(FORGETTING)
        camera = window.newest.clip.intrinsics
        cotangents = np.zeros((5, camera.height, camera.width), np.float32)
        cotangents[0] = 1  # the gradient of all red by a Gaussian's red is the sum of its blending weights
        for frame in window.newest.frames:
            used = window.model.image_gradient(frame.camera, frame.t, cotangents)[COLOUR_ROW] / np.float32(SH_C0)
            np.maximum(found, used, out=found)
        np.maximum(self.use_px, found, out=self.use_px)
        return found

    def _bare(
        self, clip: DepthClip, shown: DepthClip, means_mm: NDArray[np.floating]
    ) -> tuple[NDArray[np.intp], float]:
        """Pixels (flat) at the middles of grid cells of tissue without a Gaussian, those through which light passes
        first; their share of all cells."""
        camera, side, pose = clip.intrinsics, CELL * self._stride, clip.world_from_camera[0]
        across, down = -(-camera.width // side), -(-camera.height // side)
        cells, _ = cells_of(means_mm, camera, pose, side)
        filled = np.bincount(cells, minlength=across * down) > 0
        rows, columns = (each.ravel() for each in _middles(camera, self._stride))
        tissue, light = clip.tissue[0][rows, columns], ~shown.tissue[0][rows, columns]
        bare = tissue & (light | ~filled[rows // side * across + columns // side])
        found = np.flatnonzero(bare)
        found = found[np.argsort(~light[found], kind="stable")]
        return np.asarray(rows[found] * camera.width + columns[found], np.intp), len(found) / len(bare)

    def _put(
        self,
        window: Window,
        pixels: NDArray[np.intp],
        columns: NDArray[np.intp],
        means_mm: NDArray[np.floating],
        used_px: NDArray[np.float32],
    ) -> None:
        """Make the Gaussians in these columns points of the newest frame that move as their neighbours."""
        clip, scale = window.newest.clip, window.scale
        cloud = points_at(clip, 0, pixels)
        drawn = np.flatnonzero(used_px > MAX_USE_PX)
        _, near = cKDTree(means_mm[drawn]).query(cloud.points_mm)
        depth = np.linalg.norm(cloud.points_mm - clip.world_from_camera[0, :3, 3], axis=1) * scale
        width = INSTANT.spread * self._stride * depth / clip.intrinsics.fx
        arrays, chosen = window.model.arrays(), torch.from_numpy(columns)
        canonical, device = arrays["canonical"], arrays["canonical"].device
        motion = arrays[WEIGHT][:, :, torch.from_numpy(drawn[near])]
        state = torch.zeros(canonical.shape[0], len(columns))
        state[MEAN] = torch.from_numpy(cloud.points_mm.T * np.float32(scale))
        state[QUATERNION_ROW] = 1.0
        state[LOG_SCALE] = torch.from_numpy(np.log(width).astype(np.float32))
        state[COLOUR] = torch.from_numpy((cloud.rgb.T - np.float32(0.5)) / np.float32(SH_C0))
        now = motion[window.slot].clone()
        for rows in (QUATERNION, LOG_SCALE, slice(GLOSS_ROW, GLOSS_ROW + 1)):  # round, whatever the neighbour became
            motion[:, rows] = 0
            now[rows] = 0
        canonical[:, chosen] = state.to(device) - now
        arrays[WEIGHT][:, :, chosen] = motion
        arrays["opacity_logit"][chosen] = math.log(INSTANT.opacity / (1 - INSTANT.opacity))
        for name in (FIRST_MOMENTS, SECOND_MOMENTS):
            arrays[name][:, :, chosen] = 0
        for name in ("moments.canonical", "moments.opacity_logit"):
            arrays[name][..., chosen] = 0
        self.use_px[columns] = 2 * MAX_USE_PX


def _middles(camera: Intrinsics, stride: int) -> NDArray[np.intp]:
    """Rows and columns [2, h, w] of the middles of whole cells of `stride` px."""
    return np.mgrid[stride // 2 : camera.height : stride, stride // 2 : camera.width : stride]
