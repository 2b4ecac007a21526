"""A drop on a lens blurs a fixed part of one eye's picture; what changes in the scene changes in both."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.clip.calibration import RectifiedClip
from intrasplat.clip.splashes import falls, lost_detail
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.stereo import estimate_depth, match_eyes
from intrasplat.stereo.registration import MIN_CORRELATION
from lab.conditions import CONDITIONS, Recording, clean_clip
from lab.phantom import PhantomSettings
from tests.intrasplat.stereo.test_stereo import HEIGHT, WIDTH, clip_of, draw_pair, slanted, texture

FRAMES, FIRST, DISPARITY_PX = 24, 8, 12
ROW, COLUMN, RADIUS_PX = 70, 120, 22
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]


def disc(column: int, radius_px: float = RADIUS_PX) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = np.hypot(ROWS - ROW, COLUMNS - column) < radius_px
    return inside


def blurred(rgb: NDArray[np.uint8], column: int) -> NDArray[np.uint8]:
    return np.where(disc(column)[..., None], cv2.GaussianBlur(rgb, (0, 0), 8.0), rgb).astype(np.uint8)


def recorded(left: int | None = None, right: int | None = None) -> RectifiedClip:
    """Still tissue; from frame FIRST on a disc at these columns of the eyes is blurred."""
    left_rgb, right_rgb = draw_pair(slanted(DISPARITY_PX + 1, DISPARITY_PX - 1))
    before = left_rgb, right_rgb
    after = (
        left_rgb if left is None else blurred(left_rgb, left),
        right_rgb if right is None else blurred(right_rgb, right),
    )
    noise = np.random.default_rng(0).integers(-1, 2, (FRAMES, 2, HEIGHT, WIDTH, 3))
    eyes = [
        [
            np.clip(rgb + grain, 0, 255).astype(np.uint8)
            for rgb, grain in zip(before if i < FIRST else after, each, strict=True)
        ]
        for i, each in enumerate(noise)
    ]
    return clip_of([(pair[0], pair[1]) for pair in eyes])


def notices(clip: DepthClip) -> list[str]:
    return [each.text for each in clip.assumptions if each.code is NoticeCode.SPLASHES]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_drop_on_a_lens_is_no_tissue_of_that_eye_and_the_other_sees_what_it_hides(side: str) -> None:
    clip = estimate_depth(recorded(**{side: COLUMN}))
    assert clip.right is not None
    wet, dry = (clip, clip.right) if side == "left" else (clip.right, clip)
    drop = disc(COLUMN)
    assert wet.tissue[: FIRST - 2].all()
    assert wet.tissue[FIRST:, drop].mean() < 0.02
    assert wet.tissue[FIRST:, ~disc(COLUMN, 2 * RADIUS_PX)].all()
    in_left = disc(COLUMN if side == "left" else COLUMN + DISPARITY_PX, RADIUS_PX - 2)
    assert not clip.depth_mm[FIRST:, in_left].any()
    inner = disc(COLUMN + (-DISPARITY_PX if side == "left" else DISPARITY_PX))
    assert dry.tissue[:, inner].all()
    assert f"{side} eye's picture in frames {FIRST} to {FRAMES - 1}" in notices(clip)[0]


@pytest.mark.parametrize(("left", "right"), [(None, None), (COLUMN, COLUMN - DISPARITY_PX)], ids=["clean", "scene"])
def test_clean_lenses_and_tissue_that_changes_for_both_eyes_have_no_drops(left: int | None, right: int | None) -> None:
    clip = estimate_depth(recorded(left, right))
    assert not notices(clip)
    assert clip.tissue.all()


def test_a_drop_does_not_make_the_eyes_colours_disagree() -> None:
    clean = clean_clip(PhantomSettings(width=320, height=256, frames=16, motion="still", tools=()))
    wet = CONDITIONS["splash_stereo"].apply(clean, 4, 0).clip
    assert isinstance(wet, Recording)
    drawn = wet.stereo_recording()
    clip = match_eyes(drawn.clip, drawn.calibration, "every8", Hooks(), Timings())
    assert notices(clip)
    assert clip.registration is not None
    assert clip.registration.colour_correlation is not None
    assert clip.registration.colour_correlation < MIN_CORRELATION
    assert NoticeCode.EYES_DISAGREE not in {each.code for each in clip.warnings}


def test_held_out_frames_do_not_decide_where_drops_are() -> None:
    wet, dry = recorded(left=COLUMN), recorded()
    pairs = [w if index % 2 else d for index, (w, d) in enumerate(zip(wet.pairs(), dry.pairs(), strict=True))]
    clip = estimate_depth(clip_of(pairs), measured_frames=range(0, FRAMES, 2))
    assert not notices(clip)
    assert clip.tissue.all()


def test_masks_that_cannot_be_written_are_copied() -> None:
    masks = np.broadcast_to(np.True_, (FRAMES, HEIGHT, WIDTH))
    clip = estimate_depth(dataclasses.replace(recorded(right=COLUMN), tissue_right=masks))
    assert clip.right is not None
    assert clip.right.tissue[FIRST:, disc(COLUMN)].mean() < 0.02


def test_smooth_tissue_that_comes_into_view_is_no_drop() -> None:
    """Detail falls from much to the usual amount."""
    rough = texture(HEIGHT, WIDTH, 0)
    rough[disc(COLUMN)] = 128 + 6 * (rough[disc(COLUMN)] - 128)
    before, after = (
        np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        for grey in (rough, texture(HEIGHT, WIDTH, 0))
    )
    with ThreadPoolExecutor() as pool:
        rgb = np.stack([before if index < FIRST else after for index in range(FRAMES)])
        assert lost_detail(rgb, lambda _: None, range(FRAMES), pool) == ()


def test_the_largest_fall_has_its_run_of_frames() -> None:
    detail = np.zeros((24, 1, 2))
    detail[10:16, 0, 1] = -2.0
    fall, bounds = falls(detail)
    assert fall[0].tolist() == [0.0, 2.0]
    assert bounds[:, 0, 1].tolist() == [10, 16]


def test_a_clip_of_one_eye_warns_of_a_part_that_loses_its_detail() -> None:
    wet, dry = (np.stack([left for left, _ in recorded(left=column).pairs()]) for column in (COLUMN, None))
    with ThreadPoolExecutor() as pool:
        (warning,) = lost_detail(wet, lambda _: None, range(FRAMES), pool)
        assert warning.code is NoticeCode.DETAIL_LOST
        assert f"In frames {FIRST} to {FRAMES - 1}" in warning.text
        assert lost_detail(dry, lambda _: None, range(FRAMES), pool) == ()
        assert lost_detail(wet, lambda _: ~disc(COLUMN, 2 * RADIUS_PX), range(FRAMES), pool) == ()
