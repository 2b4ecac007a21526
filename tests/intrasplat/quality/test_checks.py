"""Doubts about a clip: each way of spoiling it is told in one sentence, and clean clips are not complained about."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import DepthClip, open_clip, split_frames
from intrasplat.notices import Notice, NoticeCode
from intrasplat.quality.checks import clip_warnings, picture_warnings, sequence_warnings
from intrasplat.train.scoring import sample_frames
from lab.conditions import CONDITIONS, CleanClip, clean_clip
from lab.phantom import MOTIONS, Motion, PhantomSettings, make_phantom
from tests.intrasplat.phantoms import phantom_clip

DATA = Path(os.environ.get("INTRASPLAT_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))


@pytest.fixture(scope="module")
def clean() -> CleanClip:
    return clean_clip(PhantomSettings(width=96, height=80, frames=20))


def doubts(clip: DepthClip) -> list[Notice]:
    train = split_frames(clip).train
    return picture_warnings(clip, sample_frames(train)) + sequence_warnings(clip, train)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("moving_camera", [False, True])
def test_clean_clips_are_not_doubted(motion: Motion, moving_camera: bool) -> None:
    assert doubts(phantom_clip(motion, frames=20, moving_camera=moving_camera)) == []


def test_a_real_clip_is_not_doubted() -> None:
    if not (DATA / "d4d_endonerf").exists():
        pytest.skip(f"{DATA} holds no real clip; set INTRASPLAT_DATA")
    clip = open_clip(DATA / "d4d_endonerf")
    assert isinstance(clip, DepthClip)
    assert doubts(clip) == []


@pytest.mark.parametrize(
    ("condition", "severity", "said"),
    [
        ("smoke", 2, "Even the dark tissue is pale"),
        ("smoke", 5, "Even the dark tissue is pale"),
        ("defocus", 5, "no fine detail"),
        ("white_balance", 4, "colour changes during the clip (blue over green"),
        ("blood", 2, "Blood covers"),
        ("blood", 5, "Blood covers"),
        ("duplicated_frames", 3, "repeat the one before"),
        ("hidden_at_start", 5, "in the first frame that later ones show"),
        ("masks_missing", 3, "have no mask although those before and after have"),
        ("depth_outliers", 2, "Depth jumps by more than 10%"),
        ("depth_noise", 4, "Depth jumps by more than 10%"),
    ],
)
def test_what_harms_a_scene_is_told(clean: CleanClip, condition: str, severity: int, said: str) -> None:
    given = CONDITIONS[condition].apply(clean, severity, 0)
    assert isinstance(given.clip, DepthClip)
    found = doubts(given.clip)
    assert sum(said in each.text for each in found) == 1
    assert len(found) == 1


def test_a_veil_is_named_with_its_frames(clean: CleanClip) -> None:
    rgb = clean.clip.rgb.copy()
    rgb[10:] = (0.5 * rgb[10:] + 100).astype(np.uint8)
    clip = dataclasses.replace(clean.clip, rgb=rgb)
    (warning,) = (each for each in picture_warnings(clip, [0, 4, 10, 14, 18]) if each.code is NoticeCode.VEILED)
    assert "about frames 10 to 18" in warning.text


def test_blood_is_not_told_as_changing_light_as_well(clean: CleanClip) -> None:
    clip = CONDITIONS["blood"].apply(clean, 5, 0).clip
    assert isinstance(clip, DepthClip)
    codes = {each.code for each in clip_warnings(clip, split_frames(clip).train)}
    assert NoticeCode.BLOOD in codes
    assert NoticeCode.BRIGHTNESS_CHANGES not in codes


@pytest.mark.parametrize(
    ("condition", "severity"),
    [
        ("smoke", 1), ("grey_scale", 5), ("highlights", 5), ("tools", 5), ("moving_camera", 5), ("black_border", 5),
        ("depth_holes", 5), ("depth_noise", 1), ("depth_outliers", 1), ("fast_pull", 5), ("cutting", 5),
        ("defocus", 1), ("white_balance", 2), ("few_frames", 5),
    ],
)  # fmt: skip
def test_what_does_no_harm_is_not(clean: CleanClip, condition: str, severity: int) -> None:
    given = CONDITIONS[condition].apply(clean, severity, 0)
    assert isinstance(given.clip, DepthClip)
    assert doubts(given.clip) == []


def test_depth_that_jumps_across_frames_that_were_left_out_is_told(clean: CleanClip) -> None:
    spoilt = CONDITIONS["depth_outliers"].apply(clean, 2, 0).clip
    assert isinstance(spoilt, DepthClip)
    skipped = tuple(index for index in range(1, 20, 2) if index % 8 != 1)
    for clip, jumps in ((spoilt, 1), (clean.clip, 0)):
        found = doubts(dataclasses.replace(clip, skipped=skipped))
        assert [each.code for each in found].count(NoticeCode.DEPTH_JUMPS) == jumps


def test_an_instrument_that_leaves_the_picture_is_no_missing_mask(clean: CleanClip) -> None:
    tissue = clean.clip.tissue.copy()
    tissue[8:] = True
    assert doubts(dataclasses.replace(clean.clip, tissue=tissue)) == []
    tissue[9] = clean.clip.tissue[9]  # held out: not looked at
    assert doubts(dataclasses.replace(clean.clip, tissue=tissue)) == []


def test_a_picture_of_one_colour_and_one_of_no_tissue_are_survived() -> None:
    clip = phantom_clip(frames=20)
    train = split_frames(clip).train
    flat = dataclasses.replace(clip, rgb=np.full_like(clip.rgb, 40))
    assert picture_warnings(flat, train) == []
    nothing = dataclasses.replace(clip, tissue=np.zeros_like(clip.tissue))
    assert picture_warnings(nothing, train) == []
    assert sequence_warnings(nothing, train) == []


def test_depth_of_a_camera_that_moves_does_not_jump() -> None:
    settings = PhantomSettings(width=160, height=128, frames=8, camera=("pan", "roll"))
    clip = make_phantom(settings).depth_clip()
    assert NoticeCode.DEPTH_JUMPS not in {each.code for each in doubts(clip)}
    resting = dataclasses.replace(clip, world_from_camera=np.tile(np.eye(4), (8, 1, 1)))
    assert NoticeCode.DEPTH_JUMPS in {each.code for each in doubts(resting)}
