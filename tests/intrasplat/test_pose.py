"""Poses: what callers may write, and where the camera then stands."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from intrasplat.errors import InputError
from intrasplat.pose import MatrixPose, OrbitPose, parse_pose, world_from_camera

IDENTITY = "1 0 0 0  0 1 0 0  0 0 1 0"
DEPTH_MM = 80.0


@pytest.mark.parametrize("text", [IDENTITY, IDENTITY + " 0 0 0 1", ",".join(IDENTITY.split())])
def test_twelve_or_sixteen_numbers_are_a_matrix(text: str) -> None:
    pose = parse_pose(text)
    assert isinstance(pose, MatrixPose)
    assert world_from_camera(pose, DEPTH_MM)[:3] == ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))


def test_the_orbit_at_rest_is_the_camera_of_frame_zero() -> None:
    matrix = world_from_camera(parse_pose("orbit:0,0,1"), DEPTH_MM)
    assert matrix == ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))


def test_yaw_moves_the_camera_right_pitch_up_and_zoom_nearer() -> None:
    right = world_from_camera(OrbitPose(yaw_deg=10, pitch_deg=0, zoom=1), DEPTH_MM)
    up = world_from_camera(OrbitPose(yaw_deg=0, pitch_deg=10, zoom=1), DEPTH_MM)
    near = world_from_camera(OrbitPose(yaw_deg=0, pitch_deg=0, zoom=2), DEPTH_MM)
    assert right[0][3] > 1
    assert up[1][3] < -1  # y points down
    assert near[2][3] == pytest.approx(DEPTH_MM / 2)


@given(st.floats(-180, 180), st.floats(-90, 90), st.floats(0.1, 10))
def test_every_orbit_is_rigid_and_looks_at_the_pivot_from_its_distance(yaw: float, pitch: float, zoom: float) -> None:
    rows = world_from_camera(OrbitPose(yaw_deg=yaw, pitch_deg=pitch, zoom=zoom), DEPTH_MM)[:3]
    assert isinstance(parse_pose(" ".join(repr(value) for row in rows for value in row)), MatrixPose)
    distance_mm = DEPTH_MM / zoom
    looked_at = [row[3] + row[2] * distance_mm for row in rows]
    assert looked_at == pytest.approx([0, 0, DEPTH_MM], abs=1e-6 * DEPTH_MM * 10)


@given(st.floats(-180, 180), st.floats(-90, 90), st.floats(0.1, 10), st.tuples(*[st.floats(-200, 200)] * 3))
def test_an_orbit_about_a_point_looks_at_it_from_the_same_side_and_distance(
    yaw: float, pitch: float, zoom: float, about_mm: tuple[float, float, float]
) -> None:
    text = ",".join(map(repr, (yaw, pitch, zoom, *about_mm)))
    rows = world_from_camera(parse_pose(f"orbit:{text}"), DEPTH_MM)[:3]
    default = world_from_camera(OrbitPose(yaw_deg=yaw, pitch_deg=pitch, zoom=zoom), DEPTH_MM)[:3]
    assert [row[:3] for row in rows] == [row[:3] for row in default]
    looked_at = [row[3] + row[2] * DEPTH_MM / zoom for row in rows]
    assert looked_at == pytest.approx(about_mm, abs=1e-9 * DEPTH_MM * 10)


def test_the_default_point_may_be_named() -> None:
    named = parse_pose(f"orbit:12,-7,1.5,0,0,{DEPTH_MM}")
    assert world_from_camera(named, DEPTH_MM) == world_from_camera(parse_pose("orbit:12,-7,1.5"), DEPTH_MM)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "0 numbers"),
        ("1 2 3", "3 numbers"),
        ("a b c", "not a number"),
        (IDENTITY.replace("1 0", "nan 0", 1), "not finite"),
        (IDENTITY.replace("1 0", "2 0", 1), "not rigid"),
        ("1 0 0 0  0 1 0 0  0 0 -1 0", "mirror image"),
        ("1 0 0 99999  0 1 0 0  0 0 1 0", "99999 mm"),
        (IDENTITY + " 0 0 0 2", "last row"),
        ("orbit:1,2", "3 or 6 numbers, 2"),
        ("orbit:1,2,1,5", "3 or 6 numbers, 4"),
        ("orbit:0,0,1,0,20000,0", "y is 20000"),
        ("orbit:0,0,1,0,0,inf", "not finite"),
        ("orbit:0,95,1", "pitch is 95"),
        ("orbit:0,0,0", "zoom is 0"),
        (f"orbit:{math.inf},0,1", "not finite"),
    ],
)
def test_a_pose_that_cannot_be_meant_names_the_field_and_the_reason(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        parse_pose(text)
    assert caught.value.field == "pose"
    assert caught.value.remedy
