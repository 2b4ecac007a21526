"""The right eye's depth and masks, moved from the left eye, against a scene that is known exactly."""

from __future__ import annotations

import dataclasses
from functools import cache, partial

import numpy as np
import pytest

from intrasplat.camera import to_camera, unproject
from intrasplat.clip import DepthClip
from intrasplat.clip.calibration import rectify
from intrasplat.stereo import estimate_depth
from intrasplat.stereo.right_eye import ROWS_AT_ONCE, moved_depth, moved_tissue, nearest_known, painted_over
from lab.phantom import Phantom, PhantomSettings, make_phantom

HEIGHT, WIDTH = 24, 80
FOCAL_BASELINE = 800.0  # disparity 8 at 100 mm, 16 at 50 mm


def step_mm() -> np.ndarray:
    """A near square before a far wall."""
    depth_mm = np.full((HEIGHT, WIDTH), 100.0, np.float32)
    depth_mm[8:16, 30:50] = 50.0
    return depth_mm


def test_a_surface_moves_by_its_disparity_and_the_nearer_one_hides_the_other() -> None:
    moved, confidence = moved_depth(step_mm(), np.full((HEIGHT, WIDTH), 200, np.uint8), FOCAL_BASELINE, 0.0)
    np.testing.assert_allclose(moved[10:14, 15:33], 50.0)  # 30:50 less 16
    np.testing.assert_allclose(moved[10:14, 0:13], 100.0)
    assert (moved[10:14, 35:41] == 0).all()  # wall that the square hides from the left eye
    assert (moved[:, WIDTH - 7 :] == 0).all()  # the strip that only the right eye sees
    assert (confidence[moved > 0] == 200).all()
    assert (confidence[moved == 0] == 0).all()


def test_rows_move_alike_wherever_they_lie() -> None:
    copies = ROWS_AT_ONCE // HEIGHT + 2
    confidence = np.full((HEIGHT, WIDTH), 200, np.uint8)
    one, _ = moved_depth(step_mm(), confidence, FOCAL_BASELINE, 0.25)
    many, _ = moved_depth(np.tile(step_mm(), (copies, 1)), np.tile(confidence, (copies, 1)), FOCAL_BASELINE, 0.25)
    np.testing.assert_array_equal(many, np.tile(one, (copies, 1)))


def test_only_what_is_wanted_takes_the_nearest_known_value() -> None:
    values = np.float32([[7, 0, 0, 0, 3]])
    known = values > 0
    np.testing.assert_array_equal(nearest_known(values, known)[0, [0, 1, 3, 4]], [7, 7, 3, 3])
    wanted = np.array([[False, True, False, False, False]])
    np.testing.assert_array_equal(nearest_known(values, known, wanted), [[7, 7, 0, 0, 3]])
    np.testing.assert_array_equal(nearest_known(values, np.zeros_like(known)), values)


def test_depth_that_is_missing_stays_missing() -> None:
    depth_mm = step_mm()
    depth_mm[:, 20:28] = 0
    moved, _ = moved_depth(depth_mm, np.full((HEIGHT, WIDTH), 200, np.uint8), FOCAL_BASELINE, 0.0)
    assert (moved[2:6, 13:19] == 0).all()


def test_an_instrument_without_depth_moves_with_its_nearest_part_that_has_some() -> None:
    depth_mm, tissue = step_mm(), np.ones((HEIGHT, WIDTH), np.bool_)
    tissue[8:16, 30:50] = False
    depth_mm[8:16, 30:40] = 0
    moved = moved_tissue(tissue, depth_mm, FOCAL_BASELINE, 0.0)
    assert not moved[8:16, 14:34].any()
    assert moved[8:16, 40:].all()
    assert moved[:6].all()


def test_an_instrument_that_leaves_the_left_picture_goes_on_in_the_strip_of_the_right_eye() -> None:
    depth_mm, tissue = np.full((HEIGHT, WIDTH), 100.0, np.float32), np.ones((HEIGHT, WIDTH), np.bool_)
    tissue[8:16, 60:] = False
    depth_mm[8:16, 60:] = 50.0
    moved = moved_tissue(tissue, depth_mm, FOCAL_BASELINE, 0.0)
    assert not moved[9:15, 44:].any()
    assert moved[:6, 44:].all()


def test_an_instrument_goes_on_in_the_direction_in_which_it_leaves_the_left_picture() -> None:
    height, width, disparity_px = 96, 160, 32.0
    y, x = np.mgrid[:height, :width]
    tissue = (np.abs(y - 0.8 * (x - 80)) >= 8) | (x <= 80)  # goes down to the right, and on beyond the border
    depth_mm = np.full((height, width), FOCAL_BASELINE / disparity_px, np.float32)
    moved = moved_tissue(tissue, depth_mm, FOCAL_BASELINE, 0.0)
    truth = (np.abs(y - 0.8 * (x + disparity_px - 80)) < 8) & (x + disparity_px > 80)
    assert not moved[truth].any()
    assert (~moved & ~truth).sum() < 0.6 * truth.sum()
    below = (y < 60 + 0.5 * (width - x)) | (x < width - 40)  # a part at the picture's lower border stays there
    assert not moved_tissue(below, depth_mm, FOCAL_BASELINE, 0.0)[64:, width - 30 :].any()


def test_a_clip_without_instruments_has_none_in_the_right_eye() -> None:
    assert moved_tissue(np.ones((HEIGHT, WIDTH), np.bool_), step_mm(), FOCAL_BASELINE, 0.0).all()


def test_a_label_lies_at_the_same_pixels_in_both_eyes_and_an_instrument_does_not() -> None:
    random = np.random.default_rng(0)
    left, right = random.integers(0, 255, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    never_tissue = np.zeros((HEIGHT, WIDTH), np.bool_)
    never_tissue[:4, :20] = never_tissue[10:20, 40:60] = True
    right[:4, :20] = left[:4, :20]
    label = painted_over(left, right, never_tissue)
    assert label[:4, :20].all()
    assert not label[10:].any()


@cache
def drawn() -> tuple[Phantom, DepthClip]:
    phantom = make_phantom(PhantomSettings(width=320, height=256, frames=2, motion="breathing"))
    recording = phantom.stereo_recording()
    return phantom, estimate_depth(rectify(recording.clip, recording.calibration))


def test_the_right_eye_of_a_phantom_has_its_pose_and_its_depth() -> None:
    phantom, clip = drawn()
    assert clip.right is not None
    np.testing.assert_allclose(clip.right.world_from_camera[0], phantom.world_from_right(0), atol=1e-3)
    truth_mm = phantom.surface_pixels(0, phantom.world_from_right(0)).depth_mm
    both = clip.right.tissue[0] & (clip.right.depth_mm[0] > 0) & (truth_mm > 0)
    assert both.mean() > 0.6
    off_mm = np.abs(clip.right.depth_mm[0] - truth_mm)[both]
    assert np.median(off_mm) < 1.0
    assert np.percentile(off_mm, 90) < 3.0


def test_the_moved_masks_cover_the_right_eyes_instrument() -> None:
    phantom, clip = drawn()
    assert clip.right is not None
    truth = phantom.stereo_recording().tissue_right[0]
    assert (~truth).any()
    assert clip.right.tissue[0][~truth].mean() < 0.05  # instrument that is taken for tissue
    assert (~clip.right.tissue[0][truth]).mean() < 0.1


def test_both_eyes_see_a_point_at_their_own_pixels() -> None:
    _, clip = drawn()
    assert clip.right is not None
    pixels = np.flatnonzero(clip.depth_confidence[0] > 200)[::97]
    points_mm = unproject(pixels, clip.depth_mm[0].reshape(-1)[pixels], clip.intrinsics, clip.world_from_camera[0])
    x, y, z = to_camera(points_mm, clip.right.world_from_camera[0]).T
    k = clip.right.intrinsics
    column, row = np.floor(k.fx * x / z + k.cx).astype(int), np.floor(k.fy * y / z + k.cy).astype(int)
    inside = (column >= 0) & (column < k.width)
    there_mm = clip.right.depth_mm[0][row[inside], column[inside]]
    seen = there_mm > 0
    assert seen.mean() > 0.9
    assert np.median(np.abs(there_mm - z[inside])[seen]) == pytest.approx(0, abs=0.2)


def test_a_label_is_found_though_the_eyes_colours_differ() -> None:
    phantom, _ = drawn()
    recording = phantom.stereo_recording()
    clip = rectify(recording.clip, recording.calibration)
    label = np.s_[:20, 100:140]
    tissue = clip.tissue.copy()
    tissue[:, :20, 100:140] = False
    pairs = [(left.copy(), np.clip(1.15 * right + 6, 0, 255).astype(np.uint8)) for left, right in clip.pairs()]
    for left, right in pairs:
        left[label] = right[label] = 250
    found = estimate_depth(dataclasses.replace(clip, tissue=tissue, pairs=partial(iter, pairs)))
    assert found.registration is not None
    assert found.registration.gain[1] == pytest.approx(1.15, abs=0.03)
    assert found.right is not None
    assert not found.right.tissue[:, :20, 100:140].any()
    assert found.right.tissue[:, 30:, 100:140].mean() > 0.9


def test_frames_that_are_not_measured_do_not_change_the_right_eye_of_others() -> None:
    """A label is found in the measured frames alone, whatever the held-out ones show."""
    phantom, _ = drawn()
    recording = phantom.stereo_recording()
    clip = rectify(recording.clip, recording.calibration)
    label = np.s_[:20, 100:140]
    tissue, pairs = clip.tissue.copy(), [(left.copy(), right.copy()) for left, right in clip.pairs()]
    tissue[0][label] = False
    pairs[0][1][label] = pairs[0][0][label]
    spoilt = [pairs[0], (pairs[1][0], 255 - pairs[1][1])]
    given = dataclasses.replace(clip, tissue=tissue)
    one, other = (
        estimate_depth(dataclasses.replace(given, pairs=partial(iter, each)), measured_frames=[0])
        for each in (pairs, spoilt)
    )
    assert one.right is not None
    assert other.right is not None
    assert not one.right.tissue[0][label].any()
    np.testing.assert_array_equal(one.right.tissue[0], other.right.tissue[0])
    np.testing.assert_array_equal(one.right.depth_mm[0], other.right.depth_mm[0])
