"""Frames that show no whole scene are found, with the reason; frames that do are not."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip.empty_frames import COVERED, EMPTY_FRAME, EYE_LOST, FADE, SMEARED, TORN, EmptyFrames, find_empty
from intrasplat.clip.sampling import thumbnail
from intrasplat.notices import NoticeCode
from tests.intrasplat.clip.test_field_of_view import disc, tissue
from tests.intrasplat.phantoms import phantom_clip

COUNT = 24
TRAIN = [index for index in range(COUNT) if (index - 1) % 8]
Change = Callable[[NDArray[np.uint8]], None]


def pictures() -> NDArray[np.uint8]:
    """[T, H, W, 3] a texture that moves by 4 pixels a frame."""
    wide = tissue(4 * COUNT)
    return np.ascontiguousarray(wide[::4])


def found_in(
    *eyes: NDArray[np.uint8], fields: Sequence[NDArray[np.bool_]] = (), shares: Sequence[float] = ()
) -> dict[int, str]:
    thumbnails = [[thumbnail(rgb) for rgb in eye] for eye in eyes]
    return dict(find_empty(thumbnails, TRAIN, fields or [None] * len(eyes), shares).reasons)


def as_one_colour(colour: tuple[int, int, int]) -> Change:
    def change(rgb: NDArray[np.uint8]) -> None:
        rgb[:] = colour

    return change


def with_text(rgb: NDArray[np.uint8]) -> None:
    rgb[:] = (10, 30, 180)
    cv2.putText(rgb, "no signal", (30, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255))


@pytest.mark.parametrize("where", [0, 5, COUNT - 1])
@pytest.mark.parametrize(
    "change", [as_one_colour((0, 0, 0)), as_one_colour((255, 255, 255)), as_one_colour((20, 160, 60)), with_text]
)
def test_an_empty_picture_is_left_out_wherever_it_is(where: int, change: Change) -> None:
    eye = pictures()
    change(eye[where])
    assert found_in(eye) == {where: EMPTY_FRAME}
    noisy = np.clip(eye + np.random.default_rng(0).normal(0, 3, eye.shape), 0, 255).astype(np.uint8)
    assert found_in(noisy) == {where: EMPTY_FRAME}


@pytest.mark.parametrize("where", [[0], [5, 6], [9], [COUNT - 1]])
def test_pictures_taken_while_the_lens_is_wiped_are_left_out(where: list[int]) -> None:
    eye = phantom_clip(frames=COUNT, width=160, height=128).rgb.copy()
    assert found_in(eye) == {}
    for index in where:
        eye[index] = cv2.blur(cv2.GaussianBlur(eye[index], (0, 0), 5), (25, 1))
    assert found_in(eye) == dict.fromkeys(where, SMEARED)


@pytest.mark.parametrize("sigma_px", [0.5, 1, 2])
def test_pictures_that_are_merely_blurred_are_not(sigma_px: float) -> None:
    eye = phantom_clip(frames=COUNT, width=160, height=128).rgb.copy()
    for index in (5, 6, 12):
        eye[index] = cv2.GaussianBlur(eye[index], (0, 0), sigma_px)
    assert found_in(eye) == {}


def test_a_sound_clip_loses_nothing_not_even_when_its_light_changes() -> None:
    eye = pictures()
    assert found_in(eye) == {}
    for index in range(COUNT):
        eye[index] = eye[index] * (0.6 + 0.4 * abs(np.sin(index / 3)))
    assert found_in(eye) == {}


def test_a_clip_of_one_colour_is_empty_and_so_are_most_frames_of_one_that_lost_its_signal() -> None:
    assert found_in(np.full((COUNT, 80, 100, 3), 90, np.uint8)) == dict.fromkeys(range(COUNT), EMPTY_FRAME)
    eye = pictures()
    eye[6:] = 0
    assert found_in(eye) == dict.fromkeys(range(6, COUNT), EMPTY_FRAME)


def test_fades_are_left_out_up_to_nearly_full_light() -> None:
    eye = pictures()
    for index in range(6):
        eye[index] = eye[index] * (index / 6)
    assert found_in(eye) == {0: EMPTY_FRAME, 1: EMPTY_FRAME} | dict.fromkeys(range(2, 5), FADE)


def test_one_lost_eye_is_told_from_both() -> None:
    left, right = pictures(), pictures()
    right[10:13] = 0
    left[12] = 0
    assert found_in(left, right) == {10: EYE_LOST, 11: EYE_LOST, 12: EMPTY_FRAME}


def test_a_white_picture_in_a_round_field_is_empty() -> None:
    eye = np.where(disc(50)[..., None], pictures(), 0).astype(np.uint8)
    eye[7][disc(50)] = 250
    assert found_in(eye, fields=[disc(48)]) == {7: EMPTY_FRAME}


def test_frames_that_masks_cover_are_left_out() -> None:
    shares = np.full(COUNT, 0.8)
    shares[[3, 4]] = 0.0
    assert found_in(pictures(), shares=list(shares)) == {3: COVERED, 4: COVERED}


@pytest.mark.parametrize("upper", [True, False])
def test_a_torn_frame_is_left_out(upper: bool) -> None:
    eye = pictures()
    half = slice(0, 50) if upper else slice(50, None)
    eye[12][half] = eye[11][half]
    assert found_in(eye) == {12: TORN}


def test_held_out_frames_decide_about_no_other() -> None:
    eye = pictures()
    held_out = [index for index in range(COUNT) if index not in TRAIN]
    eye[held_out] = 0
    assert found_in(eye) == dict.fromkeys(held_out, EMPTY_FRAME)


def test_the_report_counts_and_names_them() -> None:
    empty = EmptyFrames({3: EMPTY_FRAME, 4: EMPTY_FRAME, 9: COVERED})
    shows_nothing, covered = empty.notices(24)
    assert (shows_nothing.code, covered.code) == (NoticeCode.FRAMES_SHOW_NOTHING, NoticeCode.FRAMES_WITHOUT_TISSUE)
    assert shows_nothing.text == "frames that show nothing were left out: 3, 4 (2 of 24)"
    assert empty.frames == (3, 4, 9)
    assert EmptyFrames().notices(24) == ()
