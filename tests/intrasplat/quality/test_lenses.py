"""A lens that is fogged or smeared is named, beside the other eye or beside the other frames, with its frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.clip.types import Eye
from intrasplat.notices import NoticeCode
from intrasplat.quality.lenses import lens_warnings
from lab.phantom import PhantomSettings
from tests.intrasplat.phantoms import matched_stereo

FRAMES, WIPED = 24, 12
TRAIN = tuple(index for index in range(FRAMES) if index % 8 != 1)
Spoil = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]


def smeared(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(rgb, (0, 0), 2.0), np.uint8)


def fogged(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return (0.6 * rgb + 0.4 * 170).astype(np.uint8)


@cache
def clear() -> DepthClip:
    return matched_stereo(PhantomSettings(width=320, height=256, frames=FRAMES, camera=("advance",), tools=()))[0]


def spoilt(eye: Eye, spoil: Spoil, end: int = FRAMES) -> NDArray[np.uint8]:
    return np.stack([spoil(rgb) if index < end else rgb for index, rgb in enumerate(eye.rgb)])


def test_clear_lenses_are_not_warned_of() -> None:
    assert lens_warnings(clear(), TRAIN) == []


@pytest.mark.parametrize(("spoil", "what"), [(smeared, "sharpness"), (fogged, "contrast")])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_lens_that_is_worse_all_the_time_is_named_with_its_frames(side: str, spoil: Spoil, what: str) -> None:
    clip = clear()
    assert clip.right is not None
    if side == "right":
        clip = dataclasses.replace(clip, right=dataclasses.replace(clip.right, rgb=spoilt(clip.right, spoil)))
    else:
        clip = dataclasses.replace(clip, rgb=spoilt(clip, spoil))
    (warning,) = lens_warnings(clip, TRAIN)
    assert warning.code is NoticeCode.EYES_UNLIKE
    assert f"frames 0 to {FRAMES - 1} the {side} eye has" in warning.text
    assert what in warning.text


@pytest.mark.parametrize("eyes", [1, 2])
def test_lenses_that_are_smeared_until_they_are_wiped_are_named(eyes: int) -> None:
    clip = clear()
    assert clip.right is not None
    right = dataclasses.replace(clip.right, rgb=spoilt(clip.right, smeared, WIPED)) if eyes == 2 else None
    clip = dataclasses.replace(clip, rgb=spoilt(clip, smeared, WIPED), right=right)
    (warning,) = lens_warnings(clip, TRAIN)
    assert warning.code is NoticeCode.SHARPNESS_CHANGES
    assert f"frames 0 to {WIPED - 1} " in warning.text


def test_held_out_frames_are_not_read() -> None:
    clip = clear()
    rgb = clip.rgb.copy()
    rgb[[index for index in range(FRAMES) if index not in TRAIN]] = 0
    assert lens_warnings(dataclasses.replace(clip, rgb=rgb), TRAIN) == []
