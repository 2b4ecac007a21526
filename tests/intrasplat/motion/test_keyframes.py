"""Keyframes: a fixed camera has one; where it moves on, tissue that comes into view later is followed, too."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from intrasplat.camera import unproject
from intrasplat.clip import DepthClip
from intrasplat.motion.keyframes import MAX_NEW_SHARE, keyframes, track_keyframes
from intrasplat.motion.tracks import Tracks, moved_along, track
from lab.phantom import CameraPath, Motion, Phantom, PhantomSettings, make_phantom

WIDTH, HEIGHT, FRAMES = 160, 128, 24
TRAIN = [index for index in range(FRAMES) if index % 8 != 1]


@cache
def drawn(motion: Motion, *camera: CameraPath) -> tuple[Phantom, DepthClip]:
    """Callers share the arrays."""
    made = make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=FRAMES, motion=motion, camera=camera))
    return made, made.depth_clip()


@cache
def followed(motion: Motion, *camera: CameraPath) -> list[Tracks]:
    return track_keyframes(drawn(motion, *camera)[1], TRAIN)


def error_mm(phantom: Phantom, clip: DepthClip, tracks: Tracks, row: int) -> NDArray[np.floating]:
    """Of displacements in one of the frames that tracks follow, where they are trusted."""
    start, frame = TRAIN[tracks.reference], TRAIN[tracks.followed[row]]
    cells = np.flatnonzero(tracks.confidence[row] > 0.5)
    rows, columns = np.divmod(cells, tracks.confidence.shape[2])
    pixels = (rows * WIDTH + columns) * tracks.step_px
    depth_mm = clip.depth_mm[start].ravel()[pixels]
    known = depth_mm > 0
    place_mm = unproject(pixels[known], depth_mm[known], clip.intrinsics, clip.world_from_camera[start])
    at_start = phantom.surface.vertices_mm(start)
    nearest = cKDTree(at_start).query(place_mm)[1]
    moved_mm = (phantom.surface.vertices_mm(frame) - at_start)[nearest]
    return np.linalg.norm(tracks.displacement_mm[row].reshape(-1, 3)[cells[known]] - moved_mm, axis=1)


def test_a_fixed_camera_has_one_keyframe_and_the_same_tracks_as_ever() -> None:
    _, clip = drawn("breathing")
    assert keyframes(clip, TRAIN) == [(0, list(range(len(TRAIN))))]
    (found,), expected = followed("breathing"), track(clip, TRAIN)
    np.testing.assert_array_equal(found.displacement_mm, expected.displacement_mm)
    np.testing.assert_array_equal(found.confidence, expected.confidence)


def test_where_no_sampled_pixel_has_depth_the_first_frame_is_followed() -> None:
    _, clip = drawn("breathing", "pan")
    sparse = dataclasses.replace(clip, depth_mm=np.zeros_like(clip.depth_mm))
    assert keyframes(sparse, TRAIN) == [(0, list(range(len(TRAIN))))]


def test_the_keyframes_of_a_pan_show_most_of_what_every_frame_shows() -> None:
    _, clip = drawn("breathing", "pan")
    keys = keyframes(clip, TRAIN)
    assert len(keys) > 2
    x_mm = clip.world_from_camera[TRAIN, 0, 3]
    view_mm = WIDTH / clip.intrinsics.fx * 80
    apart_mm = np.abs(x_mm[:, None] - x_mm[[key for key, _ in keys]]).min(axis=1)
    assert apart_mm.max() < (MAX_NEW_SHARE + 0.1) * view_mm
    for key, places in keys:
        assert key in places
        assert places == sorted(places)
        assert np.abs(x_mm[places] - x_mm[key]).max() < view_mm


def test_of_a_camera_that_comes_nearer_the_nearest_keyframe_comes_first() -> None:
    _, clip = drawn("breathing", "advance")
    keys = [key for key, _ in keyframes(clip, TRAIN)]
    depths_mm = [float(np.median(clip.depth_mm[TRAIN[key]][clip.depth_mm[TRAIN[key]] > 0])) for key in keys]
    assert len(keys) > 1
    assert depths_mm[0] == min(depths_mm)
    assert TRAIN[keys[0]] > 0


def test_held_out_frames_are_never_read() -> None:
    _, other = drawn("breathing", "pan")
    arrays = ("rgb", "tissue", "depth_mm", "world_from_camera")
    poisoned = dataclasses.replace(other, **{name: getattr(other, name).copy() for name in arrays})
    held_out = [index for index in range(FRAMES) if index not in TRAIN]
    poisoned.depth_mm[held_out], poisoned.rgb[held_out], poisoned.tissue[held_out] = np.nan, 0, False
    poisoned.world_from_camera[held_out] = np.nan
    assert keyframes(poisoned, TRAIN) == keyframes(other, TRAIN)


@pytest.mark.parametrize("path", ["pan", "advance", "roll"])
def test_tracks_of_every_keyframe_follow_the_tissue_where_much_of_it_is_in_view(path: CameraPath) -> None:
    phantom, clip = drawn("breathing", path)
    for tracks in followed("breathing", path):
        for row in range(0, len(tracks.confidence), 5):
            errors = error_mm(phantom, clip, tracks, row)
            if len(errors) > 0.2 * tracks.confidence[row].size:
                assert np.median(errors) < 0.8, f"frame {TRAIN[tracks.followed[row]]}"


def test_a_camera_that_rolls_over_tissue_at_rest_moves_nothing() -> None:
    _, clip = drawn("still", "roll")
    (tracks,) = followed("still", "roll")
    trusted = tracks.confidence > 0.5
    assert trusted[-1].mean() > 0.5
    assert np.median(np.linalg.norm(tracks.displacement_mm[trusted], axis=-1)) < 0.15
    assert clip.world_from_camera[TRAIN[-1], 0, 1] != 0


def test_what_left_the_view_keeps_the_last_displacement_that_is_known() -> None:
    _, clip = drawn("breathing", "pan")
    first = next(each for each in followed("breathing", "pan") if each.reference == 0)
    assert len(first.followed) < len(TRAIN)
    moved, pixels = moved_along(first, TRAIN, WIDTH), np.arange(0, WIDTH * HEIGHT, 97)
    last = TRAIN[first.followed[-1]]
    np.testing.assert_array_equal(moved(TRAIN[-1], pixels), moved(last, pixels))
    assert clip.frame_count == FRAMES


def test_progress_rises_to_its_end_over_all_keyframes() -> None:
    _, clip = drawn("breathing", "pan")
    shares: list[float] = []
    track_keyframes(clip, TRAIN, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1)


@pytest.mark.parametrize("camera", [(), ("pan",)])
def test_no_keyframe_is_blurred(camera: tuple[CameraPath, ...]) -> None:
    clip = drawn("still", *camera)[1]
    keys = [TRAIN[key] for key, _ in keyframes(clip, TRAIN)]
    others = [TRAIN[key] for key, _ in keyframes(clip, TRAIN, blurred=keys)]
    assert not set(keys) & set(others)
    assert all(set(places) for _, places in keyframes(clip, TRAIN, blurred=keys))
    assert [TRAIN[key] for key, _ in keyframes(clip, TRAIN, blurred=TRAIN)] == keys
