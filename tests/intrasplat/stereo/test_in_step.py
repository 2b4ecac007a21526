"""Eyes that are out of step: by some frames throughout, or from a lost frame on."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from intrasplat.camera import Intrinsics
from intrasplat.clip.calibration import RectifiedClip, rectify
from intrasplat.notices import NoticeCode
from intrasplat.stereo import estimate_depth
from intrasplat.stereo.depth import _in_step, _Received
from intrasplat.stereo.in_step import Lag, Profile, find_lag, row_profile
from lab.phantom import PhantomSettings, make_phantom

COUNT, HEIGHT, WIDTH, DISPARITY_PX = 30, 120, 160, 12


def profiles(motion_px: np.ndarray, noise: float = 2.0) -> tuple[list[Profile], list[Profile]]:
    """Of both eyes of a texture that moves up and down."""
    random = np.random.default_rng(4)
    cells = random.integers(20, 236, (60, 50, 3), dtype=np.uint8)
    texture = cv2.resize(cells, (WIDTH + 60, HEIGHT + 120), interpolation=cv2.INTER_CUBIC)
    eyes: tuple[list[Profile], list[Profile]] = ([], [])
    for shift_px in motion_px:
        moved = cv2.warpAffine(texture, np.float32([[1, 0, 0], [0, 1, shift_px]]), texture.shape[1::-1])[
            60 : 60 + HEIGHT
        ]
        for eye, start in zip(eyes, (0, DISPARITY_PX), strict=True):
            seen = moved[:, start : start + WIDTH] + random.normal(0, noise, (HEIGHT, WIDTH, 3))
            eye.append(row_profile(np.clip(seen, 0, 255).astype(np.uint8)))
    return eyes


BREATHING_PX = 20 * np.sin(np.arange(COUNT) / 3.3)
SHAKING_PX = np.cumsum(np.random.default_rng(0).normal(0, 2, COUNT))


@pytest.mark.parametrize(
    "motion_px", [BREATHING_PX, SHAKING_PX, np.zeros(COUNT)], ids=["breathing", "shaking", "still"]
)
def test_eyes_in_step_stay(motion_px: np.ndarray) -> None:
    assert find_lag(*profiles(motion_px)) is None


@pytest.mark.parametrize("motion_px", [BREATHING_PX, SHAKING_PX], ids=["breathing", "shaking"])
@pytest.mark.parametrize("k", [-3, -1, 1, 5])
def test_a_constant_lag_is_found(motion_px: np.ndarray, k: int) -> None:
    left, right = profiles(motion_px)
    right = right[-k:] + right[:-k]  # left frame t and right frame t + k show one moment
    assert find_lag(left, right) == Lag(k, k, 0)


@pytest.mark.parametrize("lost", [8, 15, 22])
def test_a_lost_frame_is_found_in_either_eye(lost: int) -> None:
    left, right = profiles(SHAKING_PX)
    fewer = [*right[:lost], *right[lost + 1 :], right[-1]]
    lag = find_lag(left, fewer)
    assert lag is not None
    assert (lag.before, lag.after) == (0, -1)
    assert abs(lag.at - lost) <= 1
    sources = lag.sources(COUNT)
    assert all(source in (None, t if t < lost else t - 1) for t, source in enumerate(sources))
    assert sources.count(None) == 3
    other = find_lag([*left[:lost], *left[lost + 1 :], left[-1]], right)
    assert other is not None
    assert (other.before, other.after) == (0, 1)


def test_short_clips_and_unlike_eyes_tell_nothing() -> None:
    left, right = profiles(SHAKING_PX)
    assert find_lag(left[:7], right[1:8]) is None
    assert find_lag(left[:8], right[:8]) is None
    assert find_lag(left, profiles(SHAKING_PX, noise=300.0)[1]) is None


@pytest.mark.parametrize("k", [-1, 1])
def test_depth_is_that_of_eyes_in_step(k: int) -> None:
    drawn = make_phantom(PhantomSettings(width=160, height=128, frames=16, tools=())).stereo_recording()
    pairs = list(drawn.clip.pairs())
    late = [(left, pairs[(t - k) % 16][1]) for t, (left, _) in enumerate(pairs)]
    clip = rectify(drawn.clip, drawn.calibration)
    found = estimate_depth(replace(clip, pairs=lambda: iter(late)))
    assert found.skipped == ((0,) if k < 0 else (15,))
    assert NoticeCode.EYES_OUT_OF_STEP in [each.code for each in found.warnings]
    sound = estimate_depth(replace(clip, pairs=lambda: iter(pairs)), measured_frames=list(found.used))
    assert sound.skipped == ()
    assert NoticeCode.EYES_OUT_OF_STEP not in [each.code for each in sound.warnings]
    for t in found.used:
        np.testing.assert_array_equal(found.depth_mm[t], sound.depth_mm[t])


def test_damage_moves_along_with_the_right_eye() -> None:
    frames = [np.full((8, 8, 3), t, np.uint8) for t in range(5)]
    camera = Intrinsics(width=8, height=8, fx=8, fy=8, cx=4, cy=4)
    clip = RectifiedClip(
        5, camera, 4.0, 0.0, lambda: iter(zip(frames, frames, strict=True)), np.ones((5, 8, 8), np.bool_),
        np.arange(5) / 30, damaged=(3,),
    )  # fmt: skip
    right, small = np.stack(frames), [np.zeros((4, 4), np.float32) for _ in frames]
    received = _Received(np.stack(frames), right, (small, list(small)), ([], []), {})
    moved = _in_step(clip, received, [1, 2, 3, 4, None])
    assert moved.damaged == (2, 3)
    np.testing.assert_array_equal(right[:4, 0, 0, 0], [1, 2, 3, 4])
