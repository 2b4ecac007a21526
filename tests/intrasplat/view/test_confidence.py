"""Confidence is high where trust is and the endoscope's view agrees, low on rough tissue and where colours differ."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from intrasplat.camera import Intrinsics
from intrasplat.view.confidence import confidence, evidence, seen_from_endoscope

SHAPE = (24, 32)
GREY = np.full((3, *SHAPE), 0.5, np.float32)
CAMERA = Intrinsics(width=32, height=24, fx=40.0, fy=40.0, cx=16.0, cy=12.0)


def likely(trust: float, rgb: np.ndarray = GREY, known: np.ndarray = GREY) -> np.ndarray:
    return confidence(evidence(np.full(SHAPE, trust, np.float32), rgb, known))


def test_the_more_the_gaussians_are_trusted_the_likelier_a_pixel_is_right() -> None:
    levels = [float(likely(trust).mean()) for trust in (0.0, 0.1, 0.5, 0.9, 1.0)]
    assert levels == sorted(levels)
    assert 0 < levels[0] < 0.3
    assert 0.9 < levels[-1] < 1


def test_where_the_endoscope_sees_another_colour_the_pixel_is_likely_wrong() -> None:
    known = GREY.copy()
    known[:, :, 16:] = 0.3
    found = likely(0.9, known=known)
    assert (found[:, 16:] < 0.4).all()
    assert (found[:, :16] > 0.8).all()


def test_rough_tissue_is_less_likely_right_than_smooth() -> None:
    rough = GREY.copy()
    rough[:, :, 20:] += np.where(np.indices((24, 12)).sum(0) % 2, 0.1, -0.1)
    found = likely(0.9, rough, rough)
    assert found[:, 25:].max() < found[:, :15].min() - 0.05


@pytest.mark.parametrize(("pixels", "width"), [(3, 32), (-5, 32), (3, 64)])
def test_a_place_is_looked_up_where_the_endoscope_sees_it(pixels: int, width: int) -> None:
    """A plane from a camera beside the endoscope, which may have more pixels: its picture moves by the disparity."""
    picture = cv2.blur(np.random.default_rng(0).random((*SHAPE, 3)), (5, 5)).transpose(2, 0, 1).astype(np.float32)
    depth_mm, zoom = 50.0, width // 32
    pose = np.eye(4)
    pose[0, 3] = pixels * depth_mm / CAMERA.fx
    camera = CAMERA if zoom == 1 else Intrinsics(width=64, height=48, fx=80.0, fy=80.0, cx=32.0, cy=24.0)
    plane = np.full((camera.height, camera.width), depth_mm, np.float32)
    found = seen_from_endoscope(picture, plane, (camera, pose), (CAMERA, np.eye(4)))
    column = np.clip(np.arange(32) + pixels, 0, 31)
    if zoom == 1:
        np.testing.assert_allclose(found, picture[:, :, column], atol=1e-4)
    else:  # four pixels lie about the centre of one
        coarse = found.reshape(3, 24, 2, 32, 2).mean((2, 4))
        assert np.corrcoef(coarse.ravel(), picture[:, :, column].ravel())[0, 1] > 0.95
