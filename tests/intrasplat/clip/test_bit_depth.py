"""Pictures of 8, 10, 12 and 16 bits in 16-bit files are as bright as their cameras showed them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, StereoClip, open_clip
from intrasplat.errors import InputError
from intrasplat.notices import NoticeCode


def deep(frames: NDArray[np.uint8], bits: int) -> NDArray[np.uint16]:
    """The frames as a camera of that many bits stores them in 16; the brightest pixel is white."""
    levels = (1 << bits) - 1
    bright = frames.astype(np.float64) * (255 / frames.max())
    return np.rint(bright * levels / 255).astype(np.uint16)


def told(clip: StereoClip | DepthClip) -> list[str]:
    return [each.text for each in clip.assumptions if each.code is NoticeCode.BIT_DEPTH]


def write(studio, left: NDArray[np.uint16], right: NDArray[np.uint16]) -> Path:
    studio.images("clip/left/{}.png", left)
    studio.images("clip/right/{}.png", right)
    return studio.root / "clip"


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_stereo_frames_are_scaled_by_the_bits_that_they_use_and_say_so(studio, bits: int) -> None:
    clip = open_clip(write(studio, *(deep(eye, bits) for eye in studio.eyes(3))))
    assert isinstance(clip, StereoClip)
    for index, shown in enumerate(clip.pairs()):
        for eye, given in zip(shown, studio.eyes(3), strict=True):
            np.testing.assert_allclose(eye, given[index] * (255 / given.max()), atol=1)
    assert len(told(clip)) == (bits < 16)
    assert all(f"read as {bits}-bit pictures" in text for text in told(clip))


def test_both_eyes_and_all_frames_are_scaled_alike(studio) -> None:
    """The right eye is dark, and so are all frames but one: each by itself would look like 10 bits."""
    left, right = (deep(eye, 12) for eye in studio.eyes(3))
    left[:2] //= 8
    right //= 8
    clip = open_clip(write(studio, left, right))
    assert isinstance(clip, StereoClip)
    for index, (shown_left, shown_right) in enumerate(clip.pairs()):
        np.testing.assert_allclose(shown_left, left[index] / 4095 * 255, atol=1)
        np.testing.assert_allclose(shown_right, right[index] / 4095 * 255, atol=1)


def test_a_packed_clip_of_12_bits_is_recognised(studio) -> None:
    left, right = (deep(eye, 12) for eye in studio.eyes(3))
    clip = open_clip(studio.images("packed/{}.png", np.concatenate([left, right], axis=2)))
    assert isinstance(clip, StereoClip)
    assert next(clip.pairs())[0].max() == 255
    assert len(told(clip)) == 1


def test_a_clip_with_depth_is_scaled_and_its_depth_is_not(studio) -> None:
    folder = studio.endonerf()
    studio.images("endonerf/images/frame-{}.color.png", deep(studio.eyes(3, 64, 80)[0], 12))
    studio.images("endonerf/depth/frame-{}.depth.png", np.full((3, 64, 80), 70, dtype=np.uint16))
    clip = open_clip(folder)
    assert isinstance(clip, DepthClip)
    assert clip.rgb.max() == 255
    assert (clip.depth_mm == 70).all()
    assert len(told(clip)) == 1


def test_alpha_is_no_brightness(studio) -> None:
    for side, eye in zip(("left", "right"), studio.eyes(1), strict=True):
        pixels = np.dstack([deep(eye, 12)[0], np.full((80, 96), 65535, np.uint16)])
        assert cv2.imwrite(str(studio.image(f"clip/{side}/0.png", eye[0])), pixels)
    clip = open_clip(studio.root / "clip")
    assert isinstance(clip, StereoClip)
    assert next(clip.pairs())[0].max() == 255


def test_a_jpeg_of_12_bits_is_refused_by_name(studio) -> None:
    for side, eye in zip(("left", "right"), studio.eyes(1), strict=True):
        path = studio.image(f"clip/{side}/0.jpg", eye[0])
        data = bytearray(path.read_bytes())
        data[data.index(b"\xff\xc0") + 4] = 12
        path.write_bytes(data)
    with pytest.raises(InputError, match="is a JPEG of 12 bits a colour") as caught:
        next(open_clip(studio.root / "clip").pairs())
    assert "PNG" in caught.value.remedy


def test_black_frames_tell_no_depth(studio) -> None:
    black = np.zeros((2, 80, 96, 3), dtype=np.uint16)
    clip = open_clip(write(studio, black, black))
    assert isinstance(clip, StereoClip)
    assert told(clip) == []
    assert next(clip.pairs())[0].max() == 0
