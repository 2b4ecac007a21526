"""What of the common motion is the camera's and what the tissue's."""

from __future__ import annotations

import numpy as np

from intrasplat.poses.certainty import aligned_sigma
from intrasplat.poses.common_motion import gauged
from intrasplat.poses.field import waves
from intrasplat.poses.rigid import Reals, exp, inverse
from intrasplat.poses.trajectory import trajectory_error

FRAMES = np.arange(96.0)
PERIOD = 30.0
PIVOT_MM = np.array([0.0, 0.0, 80.0])


def seen_as(camera: Reals, breath: Reals) -> Reals:
    """The cameras if the tissue's rigid motions [K, 4, 4] were taken to be theirs; the world is the first one."""
    apparent = np.stack([inverse(one) @ two for one, two in zip(breath, camera, strict=True)])
    return np.asarray(inverse(apparent[0]) @ apparent)


def breathing() -> Reals:
    """Tissue that heaves by 4 mm, sways by 2 and tilts by a degree."""
    angle = 2 * np.pi * FRAMES / PERIOD
    zero = np.zeros_like(angle)
    twists = np.stack([2 * np.cos(angle), zero, 4 * np.sin(angle), zero, np.radians(1) * np.cos(angle), zero], axis=1)
    return np.stack([exp(twist) for twist in twists])


def found(camera: Reals, breath: Reals) -> tuple[Reals, float]:
    """The cameras that are found, and their standard deviation in mm."""
    bent_mm = np.array([0.6, 0.1, 0.6, 0.1])
    result = gauged(seen_as(camera, breath), FRAMES, waves(FRAMES, PERIOD), bent_mm, PIVOT_MM, 45.0)
    return result.poses, aligned_sigma(result.covariance, result.poses)[0]


def test_a_fixed_camera_over_tissue_that_breathes_is_at_rest() -> None:
    camera = np.tile(np.eye(4), (96, 1, 1))
    before = trajectory_error(seen_as(camera, breathing()), camera)
    poses, sigma_mm = found(camera, breathing())
    after = trajectory_error(poses, camera)
    assert before.mm > 2
    assert after.mm < 0.2
    assert after.deg < 0.1
    assert sigma_mm < 0.3


def test_a_pan_over_tissue_that_breathes_is_found() -> None:
    done = FRAMES / 95
    camera = np.tile(np.eye(4), (96, 1, 1))
    camera[:, 0, 3] = 60 * (3 * done**2 - 2 * done**3)
    poses, _ = found(camera, breathing())
    error = trajectory_error(poses, camera)
    assert error.mm < 0.6
    assert error.deg < 0.2


def test_a_camera_that_sways_in_step_with_the_tissue_is_not_sure() -> None:
    camera = np.tile(np.eye(4), (96, 1, 1))
    camera[:, 0, 3] = 3 * np.sin(2 * np.pi * FRAMES / (1.1 * PERIOD))
    _, sigma_mm = found(camera, breathing())
    assert sigma_mm > 0.3


def test_without_a_deformation_all_motion_is_the_cameras() -> None:
    camera = np.tile(np.eye(4), (96, 1, 1))
    camera[:, 2, 3] = 5 * np.sin(FRAMES / 9)
    result = gauged(camera, FRAMES, np.zeros((96, 0)), np.zeros(0), PIVOT_MM, 45.0)
    assert (result.poses == camera).all()
    assert (result.tissue == np.eye(4)).all()
