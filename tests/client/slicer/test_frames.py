"""Where pictures and cameras lie in Slicer's world, by numbers worked out by hand and by projection."""

from __future__ import annotations

import dataclasses

import numpy as np

from client.slicer.frames import points_in_ras, ras_from_ijk, turned
from client.slicer.playback import Playback
from intrasplat_client.views import PictureCamera


def a_pose() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """world_from_camera: 20 degrees about y, then 10 about x, and 5, -3, 8 mm away."""
    a, b = np.deg2rad(20), np.deg2rad(10)
    pose = np.eye(4)
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    pose[:3, :3] = about_y @ about_x
    pose[:3, 3] = 5, -3, 8
    return pose


def camera_at(pose: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> PictureCamera:
    return PictureCamera(640, 512, 500.0, 510.0, 330.0, 250.0, tuple(pose[:3].ravel().tolist()))


CAMERA = camera_at(a_pose())


def test_a_point_is_seen_at_the_pixel_that_lies_over_it_in_ras() -> None:
    pose, depth_mm = a_pose(), 60.0
    in_camera = np.array([7.0, -4.0, depth_mm])
    in_world = pose[:3, :3] @ in_camera + pose[:3, 3]
    column = CAMERA.fx * in_camera[0] / in_camera[2] + CAMERA.cx - 0.5
    row = CAMERA.fy * in_camera[1] / in_camera[2] + CAMERA.cy - 0.5
    placed = ras_from_ijk(CAMERA, depth_mm) @ [column, row, 0, 1]
    np.testing.assert_allclose(placed[:3], points_in_ras(in_world[None].astype(np.float32))[0], atol=1e-4)


def test_the_example_of_the_docs() -> None:
    camera = dataclasses.replace(camera_at(np.eye(4)), fy=500.0, cx=320.0, cy=256.0)
    matrix = ras_from_ijk(camera, 50.0)
    expected = [[-0.1, 0, 0, 31.95], [0, -0.1, 0, 25.55], [0, 0, 1, 50], [0, 0, 0, 1]]
    np.testing.assert_allclose(matrix, expected, atol=1e-12)


def test_the_picture_keeps_its_handedness_and_its_scale() -> None:
    matrix = ras_from_ijk(CAMERA, 60.0)
    spacing_mm = np.linalg.norm(matrix[:3, :3], axis=0)
    np.testing.assert_allclose(spacing_mm, [60 / CAMERA.fx, 60 / CAMERA.fy, 1.0])
    np.testing.assert_allclose(np.linalg.det(matrix[:3, :3] / spacing_mm), 1.0)


def test_a_pose_comes_back_as_it_was_and_moves_points_as_they_move_in_ras() -> None:
    pose = a_pose()
    np.testing.assert_allclose(turned(turned(pose)), pose)
    np.testing.assert_allclose(turned(np.eye(4)), np.eye(4))
    point = np.array([[1.0, 2.0, 3.0]], np.float32)
    moved = point @ pose[:3, :3].T + pose[:3, 3]
    in_ras = points_in_ras(point) @ turned(pose)[:3, :3].T + turned(pose)[:3, 3]
    np.testing.assert_allclose(in_ras, points_in_ras(moved.astype(np.float32)), atol=1e-5)


def test_a_clip_plays_in_real_seconds_and_begins_again() -> None:
    playback = Playback((0.0, 0.1, 0.4, 0.5))
    shown = [playback.frame_after(seconds) for seconds in (0.0, 0.05, 0.1, 0.39, 0.45, 0.6, 0.66, 0.68)]
    assert shown == [0, 0, 1, 1, 2, 3, 3, 0]
    playback.stand_at(0.5)
    assert (playback.frame, playback.plays) == (2, False)
    playback.play()
    assert playback.plays
    assert Playback((0.0,)).frame == 0
