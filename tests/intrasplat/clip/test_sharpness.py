"""Frames that are blurred beside those around them are found; frames of clean and of soft clips are not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from intrasplat.clip import DepthClip, split_frames
from intrasplat.clip.sharpness import frame_weights
from intrasplat.notices import NoticeCode
from lab.conditions.light import _line
from lab.phantom import Motion
from tests.intrasplat.phantoms import phantom_clip

FRAMES = 24
ALL = list(range(FRAMES))
HALF = [0, 2, 3, 6, 7, 9, 11, 12, 15, 18, 20, 23]


def drawn(motion: Motion = "breathing", *, moving_camera: bool = False) -> DepthClip:
    return phantom_clip(motion, frames=FRAMES, width=160, height=128, moving_camera=moving_camera)


def smeared(clip: DepthClip, frames: Iterable[int], length_px: float) -> DepthClip:
    rgb = clip.rgb.copy()
    for index in frames:
        rgb[index] = cv2.filter2D(rgb[index], -1, _line(length_px, 0.7 * index))
    return replace(clip, rgb=rgb)


@pytest.mark.parametrize("motion", ["still", "breathing", "pull", "cut"])
@pytest.mark.parametrize("moving_camera", [False, True])
def test_no_frame_of_a_clean_clip_is_blurred(motion: Motion, moving_camera: bool) -> None:
    clip = drawn(motion, moving_camera=moving_camera)
    split = split_frames(clip)
    assert not split.weights
    assert split.sharp == split.train
    assert not split.warnings


@pytest.mark.parametrize("frames", [[0], [5], [10, 11], [FRAMES - 1], HALF])
def test_blurred_frames_are_found_wherever_they_are_and_no_others(frames: list[int]) -> None:
    found = frame_weights(smeared(drawn(), frames, 6.0), ALL, ALL)
    assert set(found) == set(frames)
    assert max(found.values()) <= 0.5


def test_the_more_a_frame_is_blurred_the_less_it_weighs() -> None:
    weights = [frame_weights(smeared(drawn(), [8], px), ALL, ALL).get(8, 1.0) for px in (0.5, 2.5, 4.0, 8.0)]
    assert weights == sorted(weights, reverse=True)
    assert weights[0] == 1
    assert weights[-1] == 0


def test_frames_that_are_all_blurred_alike_weigh_the_same() -> None:
    clip = drawn()
    soft = np.stack([cv2.GaussianBlur(picture, (0, 0), 2.0) for picture in clip.rgb])
    assert frame_weights(replace(clip, rgb=soft), ALL, ALL) == {}


def test_pictures_enlarged_without_smoothing_weigh_the_same() -> None:
    """No fine detail at all is left to compare: pixels repeat in squares of four."""
    clip = drawn()
    rgb = clip.rgb[:, ::4, ::4].repeat(4, axis=1).repeat(4, axis=2)[:, : clip.rgb.shape[1], : clip.rgb.shape[2]]
    train = split_frames(clip).train
    assert frame_weights(replace(clip, rgb=rgb), range(clip.frame_count), train) == {}


def test_veiled_and_dark_frames_are_not_blurred() -> None:
    rgb = drawn().rgb.copy()
    rgb[5] = rgb[5] // 2 + 90
    rgb[9] = rgb[9] // 3
    assert frame_weights(replace(drawn(), rgb=rgb), ALL, ALL) == {}


def test_stills_that_show_different_tissue_are_not_compared() -> None:
    random = np.random.default_rng(0)
    stills = [cv2.GaussianBlur(random.normal(0, 1, (128, 160, 3)), (0, 0), random.uniform(1, 4)) for _ in ALL]
    rgb = np.stack([np.clip(120 + 40 * each / each.std(), 0, 255).astype(np.uint8) for each in stills])
    assert frame_weights(replace(drawn(), rgb=rgb), ALL, ALL) == {}


def test_blurred_frames_that_are_held_out_are_not_scored_and_the_report_names_all() -> None:
    split = split_frames(smeared(drawn(), [9, 12], 6.0))
    assert 9 not in split.held_out
    assert 9 in split.repeated
    assert list(split.weights) == [12]
    assert 12 in split.train
    assert 12 not in split.sharp
    (warning,) = split.warnings
    assert warning.code is NoticeCode.BLURRED_FRAMES
    assert "9, 12 (2 of 24)" in warning.text


def test_held_out_frames_do_not_decide_on_others() -> None:
    held_out = [1, 9, 17]
    train = [index for index in ALL if index not in held_out]
    one = frame_weights(smeared(drawn(), [12], 3.0), ALL, train)
    assert frame_weights(smeared(drawn(), [12, *held_out], 3.0), ALL, train)[12] == one[12]
