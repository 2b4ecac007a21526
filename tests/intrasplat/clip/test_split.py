"""Held-out frames: the papers' rule, the honest rule, lists, and frames that repeat one another."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, held_out_frames, open_clip, split_frames
from intrasplat.clip.split import PAUSE_FRAMES, REPEAT_LEVELS, find_repeats
from intrasplat.errors import InputError
from intrasplat.notices import NoticeCode

REAL_DATA = Path(os.environ.get("INTRASPLAT_DATA", Path(__file__).parents[3].parent / "shared/data"))


def clip_of(rgb: NDArray[np.uint8]) -> DepthClip:
    count, height, width = rgb.shape[:3]
    return DepthClip(
        rgb=rgb,
        tissue=np.ones((count, height, width), dtype=np.bool_),
        depth_mm=np.full((count, height, width), 60, dtype=np.float32),
        depth_confidence=np.full((count, height, width), 255, dtype=np.uint8),
        intrinsics=Intrinsics(width=width, height=height, fx=30, fy=30, cx=width / 2, cy=height / 2),
        world_from_camera=np.tile(np.eye(4), (count, 1, 1)),
        frame_times_s=np.arange(count) / 30,
    )


def distinct(count: int) -> DepthClip:
    return clip_of(np.random.default_rng(count).integers(0, 256, (count, 8, 10, 3), dtype=np.uint8))


def test_every8_is_the_rule_of_the_papers() -> None:
    split = split_frames(distinct(63), "every8")
    assert split.held_out == [1, 9, 17, 25, 33, 41, 49, 57]
    assert len(split.train) == 55
    assert split.repeated == []


def test_a_skipped_frame_is_not_held_out() -> None:
    split = split_frames(replace(distinct(20), skipped=(9, 10)), "every8")
    assert (split.held_out, split.repeated) == ([1, 17], [9, 10])
    assert not {9, 10} & set(split.train)


def test_blocks8_hides_every_third_block_of_eight_between_the_first_and_the_last() -> None:
    assert split_frames(distinct(96), "blocks8").held_out == [
        *range(8, 16),
        *range(32, 40),
        *range(56, 64),
        *range(80, 88),
    ]
    assert split_frames(distinct(20), "blocks8").held_out == [8, 9, 10, 11]


@pytest.mark.parametrize("holdout", ["every8", "blocks8", "none", "1,7,8", " 3 , 0 "])
@pytest.mark.parametrize("count", [9, 16, 17, 40])
def test_the_rule_alone_names_the_frames_that_the_split_holds_out(holdout: str, count: int) -> None:
    assert held_out_frames(count, holdout) == split_frames(distinct(count), holdout).held_out


@pytest.mark.parametrize("holdout", ["every8", "blocks8", "none", "1,7,8", " 3 , 0 "])
@pytest.mark.parametrize("count", [9, 17, 40])
def test_every_frame_is_in_exactly_one_list(holdout: str, count: int) -> None:
    split = split_frames(distinct(count), holdout)
    assert sorted(split.train + split.held_out + split.repeated) == list(range(count))
    assert split.train == sorted(split.train)


def test_none_holds_out_none_without_a_warning() -> None:
    split = split_frames(distinct(20), "none")
    assert (split.train, split.held_out, split.warnings) == (list(range(20)), [], ())


@pytest.mark.parametrize("holdout", ["every8", "blocks8", "1"])
def test_short_clips_hold_out_none_and_warn(holdout: str) -> None:
    split = split_frames(distinct(8), holdout)
    assert held_out_frames(8, holdout) == []
    assert split.train == list(range(8))
    assert split.held_out == []
    assert "fewer than 9" in split.warnings[0].text


def test_blocks8_warns_when_it_finds_no_block() -> None:
    split = split_frames(distinct(16), "blocks8")
    assert split.held_out == []
    assert "finds no frame" in split.warnings[0].text


@pytest.mark.parametrize(
    ("holdout", "problem"),
    [
        ("every7", "'every7' is not known"),
        ("", "'' is not known"),
        ("1,,2", "is not known"),
        ("-1", "is not known"),
        ("1,12", "frame 12 is not in a clip of 12 frames"),
        (",".join(str(index) for index in range(12)), "all 12 frames are held out"),
    ],
)
def test_rules_that_make_no_sense_are_refused(holdout: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        split_frames(distinct(12), holdout)
    assert caught.value.field == "options.holdout"


def test_a_training_frame_that_repeats_a_held_out_one_is_in_neither_list() -> None:
    rgb = distinct(18).rgb.copy()
    rgb[2] = rgb[1]
    rgb[14] = rgb[9]
    rgb[14, 0, 0] += 1  # one pixel of 80 differs by one level: far below the threshold
    rgb[6] = rgb[5]  # two training frames may repeat each other
    split = split_frames(clip_of(rgb), "every8")
    assert split.repeated == [2, 14]
    assert split.held_out == [1, 9, 17]
    assert split.train == [0, 3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 15, 16]
    assert [each.text for each in split.warnings] == ["frames that repeat a held-out frame are not used: 2"]


@pytest.mark.parametrize(("pause", "paused"), [(PAUSE_FRAMES, False), (PAUSE_FRAMES + 1, True), (30, True)])
def test_a_pause_is_trained_on_and_its_held_out_frames_are_in_neither_list(pause: int, paused: bool) -> None:
    rgb = distinct(60).rgb.copy()
    rgb[10 : 10 + pause] = rgb[10]
    within = range(10, 10 + pause)
    split = split_frames(clip_of(rgb), "every8")
    held_out = held_out_frames(60, "every8")
    if paused:
        assert split.repeated == [index for index in held_out if index in within]
        assert set(within) - set(held_out) <= set(split.train)
    else:
        assert split.repeated == [index for index in within if index not in held_out]
        assert not set(within) & set(split.train)
    assert sorted(split.train + split.held_out + split.repeated) == list(range(60))
    assert [each.code for each in split.warnings] == [NoticeCode.HELD_OUT_REPEATED]


def test_a_pause_that_is_held_out_as_a_whole_is_scored() -> None:
    rgb = distinct(60).rgb.copy()
    rgb[10:25] = rgb[10]
    split = split_frames(clip_of(rgb), ",".join(map(str, range(10, 25))))
    assert split.held_out == list(range(10, 25))
    assert split.repeated == []


def test_the_quick_bound_never_changes_the_answer() -> None:
    """Against the definition, on frames whose differences lie on both sides of the threshold."""
    random = np.random.default_rng(5)
    base = random.integers(20, 200, (16, 24, 3), dtype=np.uint8)
    rgb = np.stack([base] * 30)
    for index in range(30):
        changed = random.random(base.shape) < 0.02 * index
        rgb[index] += (changed * random.integers(0, 2, base.shape)).astype(np.uint8)
    held_out, train = [0, 11, 12], [index for index in range(30) if index not in (0, 11, 12)]
    difference = np.abs(rgb[train].astype(float)[:, None] - rgb[held_out].astype(float)).mean(axis=(2, 3, 4))
    expected = [index for index, row in zip(train, difference, strict=True) if (row < REPEAT_LEVELS).any()]
    assert 0 < len(expected) < len(train)
    assert find_repeats(rgb, train, held_out) == expected


def test_a_still_clip_keeps_its_frames_and_warns() -> None:
    split = split_frames(clip_of(np.full((20, 8, 10, 3), 90, dtype=np.uint8)))
    assert split.train == list(range(20))
    assert split.held_out == []
    assert "the picture does not change" in split.warnings[0].text


@pytest.mark.skipif(not (REAL_DATA / "d4d_endonerf").is_dir(), reason="needs INTRASPLAT_DATA")
def test_in_the_real_clip_frame_2_repeats_frame_1() -> None:
    clip = open_clip(REAL_DATA / "d4d_endonerf")
    assert isinstance(clip, DepthClip)
    assert split_frames(clip, "every8").repeated == [2]
    assert split_frames(clip, "blocks8").repeated == []
