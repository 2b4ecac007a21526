"""Depth that is a picture, a disparity or of another unit is told by instruments, by the path, or by the right eye.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, open_clip
from intrasplat.errors import InputError
from intrasplat.notices import NoticeCode

FRAMES, HEIGHT, WIDTH, FOCAL_PX = 9, 128, 160, 150.0
Reals = NDArray[np.float64]


def plane(x_mm: float) -> tuple[Reals, Reals, Reals]:
    """z (mm) of a slanted plane and its places (mm), each [H, W], seen by a camera that has moved x_mm to the right."""
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL_PX
    z = np.broadcast_to((60 + 0.7 * x_mm) / (1 - 0.7 * x), (HEIGHT, WIDTH))
    return z, z * x + x_mm, z * y[:, None]


def picture(x_mm: float) -> NDArray[np.uint8]:
    """The plane's texture as seen from there."""
    random = np.random.default_rng(3)
    texture = cv2.GaussianBlur(random.integers(0, 256, (500, 500, 3), dtype=np.uint8), (0, 0), 2)
    texture = cv2.normalize(texture, None, 20, 235, cv2.NORM_MINMAX)
    _, x, y = plane(x_mm)
    return cv2.remap(texture, np.float32(4 * x + 250), np.float32(4 * y + 250), cv2.INTER_LINEAR)


def clip_of(
    studio, change: Callable[[Reals], Reals], *, step_mm: float = 0.0, path_mm: float | None = None, tool: float = 0.7
) -> Path:
    """An EndoNeRF folder of the plane with a tool at `tool` times its depth, whose depth images hold change(depth).

    The camera moves step_mm a frame to the right; its poses say path_mm.
    """
    mask = np.zeros((FRAMES, HEIGHT, WIDTH), np.bool_)
    mask[:, 40:70, :50] = True
    depth = np.stack([plane(step_mm * i)[0] for i in range(FRAMES)])
    held = change(np.where(mask, tool * depth, depth))
    kind = np.uint8 if held.max() < 256 else np.uint16
    studio.images("clip/images/{}.png", np.stack([picture(step_mm * i) for i in range(FRAMES)]))
    studio.images("clip/depth/{}.png", np.rint(held).astype(kind))
    studio.masks("clip/masks", mask)
    poses = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    poses[:, 0, 3] = np.arange(FRAMES) * (step_mm if path_mm is None else path_mm)
    studio.poses("clip", poses, HEIGHT, WIDTH, FOCAL_PX)
    return studio.root / "clip"


def as_it_is(depth: Reals) -> Reals:
    return depth


def disparity(depth: Reals) -> Reals:
    return FOCAL_PX * 4.3 / depth


def stretched(depth: Reals) -> Reals:
    """To 1 to 255 in each frame."""
    low, high = (extreme(depth, axis=(1, 2), keepdims=True) for extreme in (np.min, np.max))
    return 1 + 254 * (depth - low) / (high - low)


def codes(path: Path) -> set[NoticeCode]:
    clip = open_clip(path)
    assert isinstance(clip, DepthClip)
    return {each.code for each in clip.warnings}


@pytest.mark.parametrize("step_mm", [0.0, 0.4])
def test_depth_in_millimetres_is_doubted_by_nothing(studio, step_mm: float) -> None:
    assert codes(clip_of(studio, as_it_is, step_mm=step_mm)) == set()


@pytest.mark.parametrize("bits", [8, 16])
def test_depth_stretched_for_display_is_refused(studio, bits: int) -> None:
    top = (1 << bits) - 1
    with pytest.raises(InputError, match="stretched for display") as caught:
        open_clip(clip_of(studio, lambda depth: np.rint(stretched(depth) * (top / 255))))
    assert caught.value.field == "clip"
    assert "before it was scaled" in caught.value.remedy


def test_outliers_at_both_ends_are_no_stretching(studio) -> None:
    def with_outliers(depth: Reals) -> Reals:
        depth[:, :2, :2], depth[:, -2:, -2:] = 1, 255
        return depth

    assert codes(clip_of(studio, with_outliers)) == set()


def test_depth_in_which_instruments_lie_behind_tissue_is_doubted(studio) -> None:
    """Disparity of one eye that rests: only instruments tell, and tissue without them tells nothing."""
    assert codes(clip_of(studio, disparity)) == {NoticeCode.DEPTH_INVERTED}
    assert codes(clip_of(studio, lambda depth: 255 - depth)) == {NoticeCode.DEPTH_INVERTED}
    assert codes(clip_of(studio, disparity, tool=1.0)) == set()


@pytest.mark.parametrize("change", [disparity, lambda depth: 200 - depth], ids=["disparity", "nearness"])
def test_depth_that_a_moving_camera_contradicts_is_refused(studio, change: Callable[[Reals], Reals]) -> None:
    with pytest.raises(InputError, match="grows where the moving camera shows that tissue is nearer") as caught:
        open_clip(clip_of(studio, change, step_mm=0.4))
    assert "baseline" in caught.value.remedy


@pytest.mark.parametrize(("factor", "said"), [(4.0, "4"), (256.0, "25")])
def test_a_unit_that_a_moving_camera_contradicts_is_told(studio, factor: float, said: str) -> None:
    clip = open_clip(clip_of(studio, lambda depth: depth * factor, step_mm=0.4))
    assert isinstance(clip, DepthClip)
    texts = [each.text for each in clip.warnings if each.code is NoticeCode.DEPTH_UNUSUAL]
    assert any(f"by the camera's path it is {said}" in text for text in texts)


def test_a_path_that_goes_the_other_way_does_not_speak_against_the_depth(studio) -> None:
    assert codes(clip_of(studio, as_it_is, step_mm=0.4, path_mm=-0.4)) == set()


@pytest.mark.parametrize("change", [as_it_is, disparity])
def test_the_right_eyes_pictures_tell_disparity_from_depth(studio, change: Callable[[Reals], Reals]) -> None:
    path = clip_of(studio, change, tool=1.0)
    studio.images("clip/images_right/{}.png", np.stack([picture(4.3)] * FRAMES))
    if change is as_it_is:
        assert codes(path) == set()
        return
    with pytest.raises(InputError, match="grows where the right eye shows that tissue is nearer"):
        open_clip(path)


@pytest.mark.parametrize(
    ("factor", "said"), [(256, "times 256 (6"), (100, "hundredths of a millimetre (6"), (1000, "micrometres (6")]
)
def test_an_unusual_depth_names_the_units_that_it_may_be_in(studio, factor: int, said: str) -> None:
    clip = open_clip(clip_of(studio, lambda depth: np.minimum(depth * factor, 65535)))
    assert isinstance(clip, DepthClip)
    assert said in clip.warnings[0].text
