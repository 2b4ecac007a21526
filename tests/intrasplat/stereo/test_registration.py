"""A right eye that is turned, enlarged or of other colours is measured and corrected; one that fits nothing is told."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, partial

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import to_camera, unproject_at
from intrasplat.clip import DepthClip
from intrasplat.clip.calibration import RectifiedClip, rectify
from intrasplat.notices import NoticeCode
from intrasplat.stereo import estimate_depth
from intrasplat.stereo.registration import Colours, MatchedPair, Registration, colours_of
from intrasplat.stereo.turn import EyeRotation
from lab.phantom import PhantomSettings, make_phantom
from tests.intrasplat.stereo.test_stereo import clip_of, draw_pair, slanted

Picture = NDArray[np.uint8]


@cache
def drawn() -> RectifiedClip:
    phantom = make_phantom(PhantomSettings(width=320, height=256, frames=3, motion="breathing"))
    recording = phantom.stereo_recording()
    clip = rectify(recording.clip, recording.calibration)
    return dataclasses.replace(clip, pairs=partial(iter, list(clip.pairs())))


def with_right(change: Callable[[Picture, int], Picture]) -> RectifiedClip:
    """The drawn clip with another right eye."""
    pairs = [(left, change(right, i)) for i, (left, right) in enumerate(drawn().pairs())]
    return dataclasses.replace(drawn(), pairs=partial(iter, pairs))


def turned(turn: EyeRotation) -> RectifiedClip:
    matrix, size = turn.from_rectified(drawn().intrinsics), (drawn().intrinsics.width, drawn().intrinsics.height)

    def redraw(right: Picture, _: int) -> Picture:
        shown = cv2.warpPerspective(right, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(shown, np.uint8)

    return with_right(redraw)


@cache
def sound() -> DepthClip:
    return estimate_depth(drawn())


def codes(clip: DepthClip) -> list[NoticeCode]:
    return [warning.code for warning in clip.warnings]


def test_an_exact_calibration_stays_as_it_is_and_no_doubt_is_told() -> None:
    found = sound().registration
    assert found is not None
    assert found.moved_px < 0.15
    assert (found.gain, found.offset) == ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    assert found.colour_correlation is not None
    assert found.colour_correlation > 0.99
    assert codes(sound()) == []


@pytest.mark.parametrize(
    "turn",
    [
        EyeRotation(roll_rad=np.deg2rad(0.1)),
        EyeRotation(roll_rad=np.deg2rad(-1.0)),
        EyeRotation(lower_px=0.5, pitch_rad=np.deg2rad(0.1)),
        EyeRotation(yaw_rad=np.deg2rad(0.15)),
        EyeRotation(lower_px=-2.0, zoom=0.004),
    ],
    ids=["0.1 degrees of roll", "a degree of roll", "pitch", "yaw", "zoom"],
)
def test_a_turned_right_eye_is_measured_and_costs_no_depth(turn: EyeRotation) -> None:
    clip = estimate_depth(turned(turn))
    found, right = clip.registration, clip.right
    assert found is not None
    assert right is not None
    assert found.lower_px == pytest.approx(turn.lower_px, abs=0.03)
    assert found.roll_deg == pytest.approx(np.rad2deg(turn.roll_rad), abs=0.01)
    assert found.pitch_deg == pytest.approx(np.rad2deg(turn.pitch_rad), abs=0.04)
    assert found.yaw_deg == pytest.approx(np.rad2deg(turn.yaw_rad), abs=0.03)
    assert found.zoom == pytest.approx(turn.zoom, abs=0.0004)
    assert found.residual_px < 0.1
    misfit = turn.moved_px(drawn().intrinsics)
    assert found.moved_px == pytest.approx(misfit, abs=0.15)
    assert (NoticeCode.ROWS_MISALIGNED in codes(clip)) == (misfit > 0.5)
    both = (clip.depth_confidence[0] > 128) & (sound().depth_confidence[0] > 128)
    assert both.mean() > 0.6
    assert np.median(np.abs(clip.depth_mm[0] - sound().depth_mm[0])[both]) < 0.3
    np.testing.assert_allclose(right.world_from_camera[0][:3, :3], turn.rotation, atol=1e-3)


def test_the_turned_eyes_depth_and_instruments_lie_at_its_own_pixels() -> None:
    turn = EyeRotation(lower_px=5.0, roll_rad=np.deg2rad(1.0))
    clip, k = estimate_depth(turned(turn)), drawn().intrinsics
    assert clip.right is not None
    assert sound().right is not None
    matrix, size = turn.from_rectified(k), (k.width, k.height)
    for name in ("tissue", "depth_mm"):
        expected = getattr(sound().right, name)[0].astype(np.float32)
        expected = cv2.warpPerspective(expected, matrix, size, flags=cv2.INTER_NEAREST)[10:-10, 10:-10]
        found = getattr(clip.right, name)[0].astype(np.float32)[10:-10, 10:-10]
        assert (np.abs(found - expected) > 1.0 - 0.5 * (name == "tissue")).mean() < 0.03


def test_a_turn_projects_a_point_to_where_its_picture_shows_it() -> None:
    turn, k = EyeRotation(3.0, 0.01, -0.02, 0.03, 0.01), drawn().intrinsics
    calibrated, pose = np.eye(4), np.eye(4)
    pose[:3, :3] = turn.rotation
    x, y = np.array([20.0, 160.0, 300.0]), np.array([30.0, 128.0, 200.0])
    point_mm = unproject_at(x, y, np.full(3, 80.0, np.float32), k, calibrated)
    seen_mm, there = to_camera(point_mm, pose), turn.camera(k)
    projected = seen_mm[:, :2] / seen_mm[:, 2:] * (there.fx, there.fy) + (there.cx, there.cy)
    moved = np.stack([x - 0.5, y - 0.5, np.ones(3)], axis=1) @ turn.from_rectified(k).T
    np.testing.assert_allclose(moved[:, :2] / moved[:, 2:] + 0.5, projected, atol=1e-9)
    np.testing.assert_allclose(moved[:, 2] * 80.0, seen_mm[:, 2], atol=1e-9)
    middle = turn.from_rectified(k) @ (k.cx - 0.5, k.cy - 0.5, 1.0)
    assert middle[0] / middle[2] + 0.5 == pytest.approx(k.cx)


def test_a_brighter_right_eye_gets_the_left_ones_colours() -> None:
    gain, offset = np.array([1.1, 1.0, 0.9]), 6.0
    brighter = with_right(lambda right, _: np.clip(np.rint(right * gain + offset), 0, 255).astype(np.uint8))
    clip = estimate_depth(brighter)
    assert clip.registration is not None
    assert clip.right is not None
    assert sound().right is not None
    np.testing.assert_allclose(clip.registration.gain, gain, atol=0.015)
    np.testing.assert_allclose(clip.registration.offset, offset, atol=1.0)
    dull = sound().right.rgb[0].max(axis=2) < 220  # what is burnt out cannot be brought back
    off_levels = np.abs(clip.right.rgb[0][dull].astype(float) - sound().right.rgb[0][dull])
    assert off_levels.mean() < 1.0
    assert codes(clip) == [NoticeCode.EYES_COLOURED_APART]


def swapped_channels(right: Picture, _: int) -> Picture:
    return np.ascontiguousarray(right[..., ::-1])


def burnt_out(right: Picture, _: int) -> Picture:
    return np.clip(2.5 * right.astype(np.float32), 0, 255).astype(np.uint8)


def of_another_lens(right: Picture, _: int) -> Picture:
    k = drawn().intrinsics
    y, x = np.mgrid[: k.height, : k.width].astype(np.float32)
    across, down = (x - k.cx) / k.fx, (y - k.cy) / k.fy
    stretched = 1 + 0.15 * (across**2 + down**2)
    places = (across * stretched * k.fx + k.cx, down * stretched * k.fy + k.cy)
    return np.asarray(cv2.remap(right, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), np.uint8)


@pytest.mark.parametrize("change", [swapped_channels, burnt_out, of_another_lens])
def test_eyes_that_fit_no_calibration_are_told(change: Callable[[Picture, int], Picture]) -> None:
    assert NoticeCode.EYES_DISAGREE in codes(estimate_depth(with_right(change)))


def dead_red(right: Picture, _: int) -> Picture:
    return np.ascontiguousarray(right * np.array([0, 1, 1], np.uint8))


@pytest.mark.parametrize("change", [swapped_channels, dead_red])
def test_colours_that_do_not_follow_each_other_are_left_alone(change: Callable[[Picture, int], Picture]) -> None:
    given = with_right(change)
    clip = estimate_depth(given)
    assert codes(clip) == [NoticeCode.EYES_DISAGREE]
    assert clip.registration is not None
    assert clip.registration.gain == (1.0, 1.0, 1.0)
    assert clip.right is not None
    for shown, (_, recorded) in zip(clip.right.rgb, given.pairs(), strict=True):
        np.testing.assert_array_equal(shown, recorded)


def test_too_little_to_compare_colours_by_is_told() -> None:
    assert colours_of([dataclasses.replace(pair, sure=np.zeros_like(pair.sure)) for pair in [matched()]]) == Colours()
    unknown = Registration(drawn().intrinsics, 4.0, matches=200)
    assert [notice.code for notice in unknown.notices()] == [NoticeCode.COLOURS_UNKNOWN]


def matched() -> MatchedPair:
    left, right = next(iter(drawn().pairs()))
    return MatchedPair(left, right, np.zeros(left.shape[:2], np.float32), np.ones(left.shape[:2], np.bool_))


def test_few_matches_tell_the_rows_and_no_turn() -> None:
    disparity = slanted(width=96, height=72)
    clip = estimate_depth(clip_of([draw_pair(disparity, row_shift_px=1.0)]))
    assert clip.registration is not None
    assert 0 < clip.measurements["vertical_matches"] < 150
    assert clip.registration.lower_px == pytest.approx(1.0, abs=0.1)
    assert (clip.registration.roll_deg, clip.registration.yaw_deg, clip.registration.zoom) == (0.0, 0.0, 0.0)


def test_held_out_pictures_of_either_eye_change_nothing_of_the_registration() -> None:
    pairs = list(drawn().pairs())
    poisoned = [pairs[0], (255 - pairs[1][0], np.roll(pairs[1][1], 9, axis=0) // 2), pairs[2]]
    one, other = (
        estimate_depth(dataclasses.replace(drawn(), pairs=partial(iter, each)), measured_frames=[0, 2])
        for each in (pairs, poisoned)
    )
    assert one.registration == other.registration
    assert one.right is not None
    assert other.right is not None
    np.testing.assert_array_equal(one.right.rgb[[0, 2]], other.right.rgb[[0, 2]])
    np.testing.assert_array_equal(one.right.depth_mm[[0, 2]], other.right.depth_mm[[0, 2]])
