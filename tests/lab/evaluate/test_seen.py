"""Which frames show which tissue: a pan shows new tissue as it goes, a fixed endoscope does not, masks hide."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.evaluate.seen import SeenPoints, seen_points, share_covered
from lab.evaluate.truth import Truth
from lab.phantom import CameraPath, Phantom, PhantomSettings, make_phantom
from lab.phantom import tissue as painted

FRAMES = 13


@pytest.fixture(scope="module", autouse=True)
def _without_vessels() -> Iterator[None]:
    """Which take most of the time of making a phantom, and hide nothing."""

    def none(*given: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return np.zeros(given[-1], np.float32), np.zeros(given[-1], np.float32)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(painted, "draw_vessels", none)
        yield


@cache
def made(*camera: CameraPath) -> tuple[Phantom, NDArray[np.bool_], NDArray[np.bool_]]:
    """A phantom, and where its left and its right eye show tissue."""
    phantom = make_phantom(PhantomSettings(96, 80, FRAMES, camera=camera, period_frames=12.0))
    frames = [phantom.frame(index) for index in range(FRAMES)]
    return phantom, np.stack([each.tissue for each in frames]), np.stack([each.tissue_right for each in frames])


def seen(*camera: CameraPath) -> SeenPoints:
    phantom, tissue, _ = made(*camera)
    return seen_points(phantom, range(FRAMES), tissue)


def test_a_pan_shows_new_tissue_as_it_goes_and_leaves_the_old() -> None:
    fixed, pan = seen(), seen("pan")
    assert fixed.shown[0].sum() > 0.8 * fixed.by_any.sum()
    assert pan.by_any.sum() > 2.2 * pan.shown[0].sum()
    assert not (pan.shown[0] & pan.shown[-1]).any()
    first = pan.first[pan.shown[-1]]
    assert first.min() > 2
    assert (pan.first[~pan.by_any] == -1).all()


def test_the_right_eye_sees_beyond_the_left_and_masks_hide() -> None:
    phantom, tissue, tissue_right = made()
    left, both = seen_points(phantom, [0], tissue), seen_points(phantom, [0], tissue, tissue_right)
    assert both.by_any.sum() > 1.01 * left.by_any.sum()
    assert not (left.by_any & ~both.by_any).any()
    bare = seen_points(phantom, [0], np.ones_like(tissue))
    assert bare.by_any.sum() > left.by_any.sum() > 0.6 * bare.by_any.sum()


def test_a_point_that_is_shown_lies_on_the_surface_that_the_pixels_show() -> None:
    phantom, _, _ = made("pan")
    frame = FRAMES - 1
    pose = phantom.world_from_camera(frame)
    points = phantom.surface.vertices_mm(frame)[seen("pan").shown[frame]]
    local_mm, camera = (points - pose[:3, 3]) @ pose[:3, :3], phantom.settings.intrinsics
    columns, rows = (
        np.floor(f * local_mm[:, axis] / local_mm[:, 2] + c).astype(int)
        for axis, f, c in ((0, camera.fx, camera.cx), (1, camera.fy, camera.cy))
    )
    depth_mm = phantom.surface_pixels(frame).depth_mm[rows, columns]
    assert np.median(np.abs(local_mm[:, 2] - depth_mm)) < 0.3


def test_what_is_drawn_everywhere_covers_all_and_half_a_picture_covers_half() -> None:
    phantom, _, _ = made()
    points = seen()
    solid = np.ones((FRAMES, 80, 96), np.bool_)
    assert share_covered(phantom, points, solid) == 1
    solid[:, :, 48:] = False
    assert share_covered(phantom, points, solid) == pytest.approx(0.5, abs=0.06)
    moving, along = made("pan")[0], seen("pan")
    assert share_covered(moving, along, solid) > 0.6, "the left half sees most of what a pan to the right passes"


def test_views_off_the_axis_follow_the_endoscope() -> None:
    phantom, tissue, tissue_right = made("pan")
    held_out = [1, 6, 12]
    train = [frame for frame in range(FRAMES) if frame not in held_out]
    truth = Truth(phantom, tissue, train, held_out, tissue_right)
    for views in truth.off_axis.values():
        for view in views:
            offset_mm = np.linalg.norm(view.pose[:3, 3] - phantom.world_from_camera(view.frame)[:3, 3])
            assert 8 < offset_mm < 25
            assert view.judged.mean() > 0.6
