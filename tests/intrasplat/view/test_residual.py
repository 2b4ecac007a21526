"""What the model's motion leaves between two recorded frames, and where views look for it."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.view.residual import CELL_PX, Points, Residual, flow_between
from intrasplat.view.transfer import ONE

WIDTH, HEIGHT, DEPTH_MM = 160, 128, 60.0
LENS = Intrinsics(width=WIDTH, height=HEIGHT, fx=150.0, fy=150.0, cx=80.0, cy=64.0)
MOVED_PX = np.array([2.5, -1.5])
INNER = np.s_[3:-3, 3:-3]


def texture(shift_px: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey levels [h, w] of a flat wall that has moved by shift_px on the picture."""
    fine = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(HEIGHT + 40, WIDTH + 40)), (0, 0), 2.5)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 20 - shift_px[::-1, None, None]
    grey = cv2.remap(fine.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    return np.clip(128 + 500 * grey, 0, 255).astype(np.uint8)


def residual(grey: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None) -> Residual:
    """Of a wall 60 mm before an eye at the origin, with a Gaussian in each cell, which the model leaves in place."""
    planes = np.zeros((HEIGHT + 2, WIDTH + 2, 4), np.int16)
    planes[1:-1, 1:-1, 3] = ONE if valid is None else valid * ONE
    y, x = np.mgrid[: HEIGHT // CELL_PX, : WIDTH // CELL_PX] * CELL_PX + CELL_PX / 2
    means_mm = np.stack([(x - 80) * DEPTH_MM / 150, (y - 64) * DEPTH_MM / 150, np.full(x.shape, DEPTH_MM)])
    depth_mm = np.full((HEIGHT + 2, WIDTH + 2), DEPTH_MM, np.float32)
    return Residual(planes, depth_mm, grey, LENS, np.eye(4), np.asarray(means_mm.reshape(3, -1), np.float32))


def opacity(of: Residual) -> NDArray[np.float32]:
    return np.ones(of.means_mm.shape[1], np.float32)


def test_the_flow_is_what_the_model_does_not_follow() -> None:
    before, after = residual(texture(np.zeros(2))), residual(texture(MOVED_PX))
    found = flow_between(before, after, opacity(before))
    assert np.abs(found[INNER] - MOVED_PX).mean() < 0.3
    followed_mm = np.array([*MOVED_PX * DEPTH_MM / 150, 0], np.float32)[:, None]
    followed = dataclasses.replace(after, means_mm=after.means_mm + followed_mm)
    assert np.abs(flow_between(before, followed, opacity(before))[INNER]).mean() < 0.15


@pytest.mark.parametrize("masked", ["before", "after"])
def test_what_a_frame_does_not_show_has_no_flow(masked: str) -> None:
    none = np.zeros((HEIGHT, WIDTH), np.bool_)
    before = residual(texture(np.zeros(2)), none if masked == "before" else None)
    after = residual(texture(MOVED_PX), none if masked == "after" else None)
    assert np.abs(flow_between(before, after, opacity(before))).max() < 1e-3


def test_flat_pictures_have_no_flow_because_that_would_crash() -> None:
    whole = residual(texture(np.zeros(2)))
    flat = dataclasses.replace(whole, grey=whole.grey[:30], planes=whole.planes[:32], depth_mm=whole.depth_mm[:32])
    assert not flow_between(flat, flat, opacity(flat)).any()


def test_views_from_beside_read_the_flow_where_the_eye_saw_the_points_and_shift_by_its_pixels() -> None:
    world_from_camera = np.eye(4)
    world_from_camera[0, 3] = 4.0  # mm to the right: points lie 10 px farther left
    view = Points(world_from_camera, LENS, np.full((HEIGHT, WIDTH), DEPTH_MM, np.float32))
    before, at_rest = residual(texture(np.zeros(2))), np.zeros((HEIGHT // CELL_PX, WIDTH // CELL_PX, 3), np.float32)
    columns = np.broadcast_to(np.arange(WIDTH // CELL_PX, dtype=np.float32), at_rest.shape[:2])
    read = view.apart_px(before, at_rest, np.ascontiguousarray(np.dstack([columns, columns])))
    np.testing.assert_allclose(read[:, :-2, 0] - columns[:, :-2], (10 + 0.5) / CELL_PX, atol=0.02)
    moved_mm = view.shifted(before, at_rest, np.full_like(read, 2.0))
    np.testing.assert_allclose(moved_mm[..., :2], 2.0 * DEPTH_MM / 150, rtol=1e-5)
    np.testing.assert_array_equal(moved_mm[..., 2], 0)
