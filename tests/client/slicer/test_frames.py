"""Where pictures and cameras lie in Slicer's world, by numbers worked out by hand and by projection."""

from __future__ import annotations

import numpy as np

from client.slicer.frames import Camera, points_in_ras, ras_from_ijk, turned

CAMERA = Camera(width=640, height=512, fx=500.0, fy=510.0, cx=330.0, cy=250.0)


def a_pose() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """world_from_camera: 20 degrees about y, then 10 about x, and 5, -3, 8 mm away."""
    a, b = np.deg2rad(20), np.deg2rad(10)
    pose = np.eye(4)
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    pose[:3, :3] = about_y @ about_x
    pose[:3, 3] = 5, -3, 8
    return pose


def test_a_point_is_seen_at_the_pixel_that_lies_over_it_in_ras() -> None:
    pose, depth_mm = a_pose(), 60.0
    in_camera = np.array([7.0, -4.0, depth_mm])
    in_world = pose[:3, :3] @ in_camera + pose[:3, 3]
    column = CAMERA.fx * in_camera[0] / in_camera[2] + CAMERA.cx - 0.5
    row = CAMERA.fy * in_camera[1] / in_camera[2] + CAMERA.cy - 0.5
    placed = ras_from_ijk(CAMERA, pose, depth_mm) @ [column, row, 0, 1]
    np.testing.assert_allclose(placed[:3], points_in_ras(in_world[None].astype(np.float32))[0], atol=1e-4)


def test_the_example_of_the_docs() -> None:
    matrix = ras_from_ijk(Camera(width=640, height=512, fx=500, fy=500, cx=320, cy=256), np.eye(4), 50.0)
    expected = [[-0.1, 0, 0, 31.95], [0, -0.1, 0, 25.55], [0, 0, 1, 50], [0, 0, 0, 1]]
    np.testing.assert_allclose(matrix, expected, atol=1e-12)


def test_the_picture_keeps_its_handedness_and_its_scale() -> None:
    matrix = ras_from_ijk(CAMERA, a_pose(), 60.0)
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


def test_a_smaller_picture_covers_the_same_plane() -> None:
    small = CAMERA.resized(160)
    assert (small.width, small.height) == (160, 128)
    corners = [ras_from_ijk(each, a_pose(), 60.0) @ [-0.5, -0.5, 0, 1] for each in (CAMERA, small)]
    np.testing.assert_allclose(corners[0], corners[1])
