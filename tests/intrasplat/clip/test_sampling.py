"""Frames that show nothing new, in synthetic clips that repeat, pause, rest, hardly move, or move.

Symbols: T frames. A moment is a frame of the phantom, a real number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import held_out_frames, split_frames, training_frames
from intrasplat.clip.sampling import LEAST_FRAMES, MIN_USED_FRAMES, most_frames, sampled, skippable_frames
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions
from lab.phantom import Phantom, PhantomSettings, make_phantom
from lab.phantom.shading import add_noise
from tests.intrasplat.phantoms import phantom_clip

WIDTH, HEIGHT = 160, 128


@cache
def tissue() -> Phantom:
    """It breathes, 36 frames a breath."""
    return make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=400, tools=()))


@cache
def picture(moment: float) -> NDArray[np.float32]:
    return tissue().render(moment)[0]


def recorded(moments: list[float], noise: bool = True) -> NDArray[np.uint8]:
    """[T, H, W, 3]; with noise, each frame has its own."""
    frames = []
    for frame, moment in enumerate(moments):
        rgb = add_noise(picture(moment), np.random.default_rng(frame)) if noise else picture(moment)
        frames.append(np.clip(rgb * 255 + 0.5, 0, 255).astype(np.uint8))
    return np.stack(frames)


def nothing_new(rgb: NDArray[np.uint8], frames: Sequence[int]) -> tuple[int, ...]:
    return skippable_frames(rgb, frames).nothing_new


@pytest.mark.parametrize("noise", [False, True])
def test_of_a_clip_that_shows_each_frame_twice_half_is_left_out(noise: bool) -> None:
    rgb = recorded([float(frame // 2) for frame in range(2 * MIN_USED_FRAMES)], noise)
    assert nothing_new(rgb, range(len(rgb))) == tuple(range(1, len(rgb), 2))


@pytest.mark.parametrize("noise", [False, True])
def test_of_a_pause_every_nth_frame_is_used_and_all_of_what_moves(noise: bool) -> None:
    before, after = range(60), range(60 + 3 * MIN_USED_FRAMES, 120 + 3 * MIN_USED_FRAMES)
    moments = [*map(float, range(60)), *[59.0] * 3 * MIN_USED_FRAMES, *map(float, range(60, 120))]
    longest = len(moments) // MIN_USED_FRAMES
    unused = set(nothing_new(recorded(moments, noise), range(len(moments))))
    used = [frame for frame in range(len(moments)) if frame not in unused]
    assert not unused & {*before, *after}
    assert set(np.diff([frame for frame in used if 59 <= frame < after[0]])) == {longest}


def test_of_slow_tissue_frames_are_used_at_even_steps() -> None:
    moments = [frame / 80 for frame in range(4 * MIN_USED_FRAMES)]
    unused = nothing_new(recorded(moments), range(len(moments)))
    used = np.setdiff1d(range(len(moments)), unused)
    assert len(moments) / 4 <= len(used) < len(moments) / 1.8
    assert np.diff(used).std() < 1


def test_no_frame_of_moving_tissue_is_left_out() -> None:
    assert (
        nothing_new(recorded([float(frame) for frame in range(2 * MIN_USED_FRAMES)]), range(2 * MIN_USED_FRAMES)) == ()
    )


def test_no_frame_is_left_out_while_a_small_part_moves() -> None:
    rgb = recorded([0.0] * 2 * MIN_USED_FRAMES)
    moving = recorded([float(frame) for frame in range(2 * MIN_USED_FRAMES)])
    rgb[:, 40:72, 60:92] = moving[:, 40:72, 60:92]
    assert nothing_new(rgb, range(len(rgb))) == ()


def test_a_short_clip_keeps_every_frame() -> None:
    count = 2 * MIN_USED_FRAMES - 1
    assert nothing_new(recorded([0.0] * count), range(count)) == ()


@pytest.mark.parametrize("count", [150, 700, 1000])
def test_a_still_clip_keeps_a_number_of_frames(count: int) -> None:
    rgb = np.broadcast_to(recorded([0.0]), (count, HEIGHT, WIDTH, 3))
    used = count - len(nothing_new(rgb, range(count)))
    assert MIN_USED_FRAMES <= used < 1.6 * MIN_USED_FRAMES


@pytest.mark.parametrize("holdout", ["every8", "blocks8", "5,6,77"])
def test_held_out_frames_decide_nothing_and_are_not_left_out(holdout: str) -> None:
    rgb = recorded([min(float(frame), 30.0) for frame in range(2 * MIN_USED_FRAMES)])
    held_out, train = held_out_frames(len(rgb), holdout), training_frames(len(rgb), holdout)
    unused = nothing_new(rgb, train)
    assert len(unused) > 30
    assert not set(unused) & set(held_out)
    rgb[held_out] = 255 - rgb[held_out]
    assert nothing_new(rgb, train) == unused


@pytest.mark.parametrize("holdout", ["every8", "blocks8", "none"])
def test_a_split_trains_on_no_frame_that_is_left_out_and_times_stay(holdout: str) -> None:
    clip = phantom_clip(frames=48, width=WIDTH, height=HEIGHT, tools=False)
    index = np.minimum(np.arange(2 * MIN_USED_FRAMES), 47)
    arrays = ("rgb", "tissue", "depth_mm", "depth_confidence", "world_from_camera")
    long = dataclasses.replace(
        clip, **{name: getattr(clip, name)[index] for name in arrays}, frame_times_s=np.arange(len(index)) / 25
    )
    shorter = sampled(long, ReconstructionOptions(holdout=holdout, iterations=9))
    split, whole = split_frames(shorter, holdout), split_frames(long, holdout)
    assert len(shorter.skipped) > 20
    assert sorted(split.train + split.held_out + split.repeated) == list(range(len(index)))
    assert set(split.train) == set(whole.train) - set(shorter.skipped)
    assert split.held_out == whole.held_out
    assert np.array_equal(shorter.t, long.t)
    assert np.array_equal(shorter.frame_times_s, long.frame_times_s)
    assert [each.code for each in shorter.assumptions].count(NoticeCode.NOTHING_NEW) == 1


@pytest.mark.parametrize(
    ("options", "most"),
    [
        ({"preset": "instant"}, 32),
        ({"preset": "fast"}, 348),
        ({"preset": "instant", "budget_s": 60.0}, 348),
        ({"preset": "fast", "budget_s": 1.0}, LEAST_FRAMES),
        ({"preset": "instant", "use_frames": "all"}, None),
        ({"preset": "instant", "iterations": 100}, None),
        ({"preset": "paper", "budget_s": 6.0}, None),
    ],
)
def test_time_limits_the_frames_of_our_presets(options: dict[str, Any], most: int | None) -> None:
    assert most_frames(ReconstructionOptions(**options)) == most


def test_of_too_many_frames_half_are_spread_over_time_and_half_over_the_motion() -> None:
    rest, count = 40, 24
    rgb = recorded([*[0.0] * rest, *(float(frame) for frame in range(rest))])
    found = skippable_frames(rgb, range(len(rgb)), count)
    used = [frame for frame in range(len(rgb)) if frame not in found.frames]
    assert found.nothing_new == ()
    assert 0.8 * count <= len(used) <= count
    assert (used[0], used[-1]) == (0, len(rgb) - 1)
    assert sum(frame < rest for frame in used) == pytest.approx(count / 4, abs=1)
    assert skippable_frames(rgb, range(len(rgb)), len(rgb)).frames == ()


def test_the_report_says_how_many_frames_there_was_no_time_for() -> None:
    clip = phantom_clip(frames=48, width=WIDTH, height=HEIGHT, tools=False)
    shorter = sampled(clip, ReconstructionOptions(preset="instant"))
    (told,) = [each for each in shorter.assumptions if each.code is NoticeCode.NO_TIME]
    assert told.text.startswith(f"frames: {len(shorter.skipped)} of 48 were left out")
    again = sampled(shorter, ReconstructionOptions(preset="fast"))
    assert again.skipped == ()
    assert again.assumptions == clip.assumptions
