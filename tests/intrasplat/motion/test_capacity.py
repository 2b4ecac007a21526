"""A model is as large as its scene needs, and the report says why."""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from intrasplat.clip import DepthClip, split_frames
from intrasplat.methods.registry import PRESETS
from intrasplat.motion.capacity import (
    BASES,
    MAX_COARSENING,
    MIN_GAIN_DB,
    MIN_TRIAL_FRAMES,
    REST,
    BasisTrials,
    choose_bases,
    floor_error,
    try_bases,
)
from intrasplat.motion.tracks import Tracks, track
from intrasplat.motion.trials import FitError
from intrasplat.train.start import MIN_STRIDE, basis_values, fusion_for, resolve_preset
from lab.phantom import Motion
from tests.intrasplat.phantoms import phantom_clip, prepared_on

FAST = PRESETS["fast"]
FRAMES = 40


@cache
def followed(motion: Motion) -> tuple[DepthClip, list[int], list[Tracks]]:
    clip = phantom_clip(motion, frames=FRAMES)
    train = split_frames(clip).train
    return clip, train, [track(clip, train)]


def bases_for(motion: Motion) -> int:
    clip, train, tracks = followed(motion)
    bases = resolve_preset(FAST, tracks, clip, train)[0].bases
    assert bases is not None
    return bases


def motion_left(errors: dict[int, float]) -> BasisTrials:
    """The same errors, all of motion."""
    return BasisTrials({bases: FitError(motion=error, light=0.0) for bases, error in errors.items()})


def tried_bases(tracks: list[Tracks], clip: DepthClip, train: list[int], most: int | None = None) -> BasisTrials:
    return try_bases(tracks, clip, train, basis_values, most)


def faster(clip: DepthClip, every: int) -> DepthClip:
    """Every so many frames of the clip: the same tissue, moving so many times as fast."""
    per_frame = ("rgb", "tissue", "depth_mm", "depth_confidence", "world_from_camera", "frame_times_s")
    return dataclasses.replace(clip, **{name: getattr(clip, name)[::every] for name in per_frame})


def test_a_still_clip_gets_the_fewest_bases() -> None:
    assert bases_for("still") == REST


@pytest.mark.parametrize("motion", ["breathing", "pull", "cut"])
def test_a_clip_that_moves_gets_more(motion: Motion) -> None:
    assert bases_for(motion) > BASES[0]
    clip, train, tracks = followed(motion)
    assert not tried_bases(tracks, clip, train).resting


def test_displacements_that_the_pictures_do_not_confirm_ask_for_no_bases() -> None:
    clip, train, tracks = followed("still")
    drift_mm = np.random.default_rng(0).normal(0, 0.1, (len(train), 1, 1, 3)).cumsum(0).astype(np.float32)
    drifting = [dataclasses.replace(tracks[0], displacement_mm=tracks[0].displacement_mm + drift_mm)]
    tried = tried_bases(drifting, clip, train)
    assert resolve_preset(FAST, drifting, clip, train)[0].bases == REST
    assert choose_bases(dataclasses.replace(tried, resting={}), 0.1, len(train)).count > REST


def test_tissue_that_is_never_seen_in_place_is_not_said_to_rest() -> None:
    clip, train, tracks = followed("breathing")
    tissue = np.zeros_like(clip.tissue)
    tissue[train[0]] = clip.tissue[train[0]]
    tried = tried_bases(tracks, dataclasses.replace(clip, tissue=tissue), train)
    assert not tried.resting
    assert tried.tracked == tried_bases(tracks, clip, train).tracked


def test_light_that_changes_on_tissue_at_rest_gets_bases() -> None:
    clip, train, _ = followed("still")
    brightness = 1 + 0.3 * np.sin(np.linspace(0, 2 * np.pi, FRAMES))[:, None, None, None]
    fading = dataclasses.replace(clip, rgb=np.clip(clip.rgb * brightness, 0, 255).astype(np.uint8))
    assert (resolve_preset(FAST, [track(fading, train)], fading, train)[0].bases or 0) > REST


def test_faster_motion_never_gets_fewer_bases_for_as_many_frames() -> None:
    clip = phantom_clip("breathing", frames=2 * FRAMES)
    chosen = []
    for every in (1, 2):
        quicker = faster(clip, every)
        frames = list(range(FRAMES))
        chosen.append(resolve_preset(FAST, [track(quicker, frames)], quicker, frames)[0].bases or 0)
    assert chosen[0] <= chosen[1]


def test_held_out_frames_are_never_read() -> None:
    clip, train, tracks = followed("breathing")
    held_out = sorted(set(range(clip.frame_count)) - set(train))
    poisoned = dataclasses.replace(clip, rgb=clip.rgb.copy(), tissue=clip.tissue.copy(), depth_mm=clip.depth_mm.copy())
    poisoned.rgb[held_out], poisoned.tissue[held_out], poisoned.depth_mm[held_out] = 255, False, np.nan
    assert tried_bases([track(poisoned, train)], poisoned, train) == tried_bases(tracks, clip, train)
    assert resolve_preset(FAST, tracks, poisoned, train) == resolve_preset(FAST, tracks, clip, train)


def test_the_choice_is_the_fewest_within_the_tolerance_of_the_best() -> None:
    errors = {3: 100.0, 5: 30.0, 9: 20.4, 17: 20.0, 33: 21.0}
    assert choose_bases(motion_left(errors), 0.0, 60).count == 9
    errors[9] = 20.0 * 10 ** (MIN_GAIN_DB / 10) + 0.1
    assert choose_bases(motion_left(errors), 0.0, 60).count == 17


def test_the_less_the_gaussians_can_show_the_fewer_bases_are_worth_it() -> None:
    errors = {3: 100.0, 5: 30.0, 9: 20.4, 17: 20.0, 33: 21.0}
    counts = [choose_bases(motion_left(errors), floor, 60).count for floor in (0.0, 100.0, 300.0, 3000.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 3


def test_motion_too_fast_for_any_number_gets_the_most() -> None:
    errors = motion_left({3: 670.0, 5: 665.0, 9: 790.0, 17: 860.0})
    choice = choose_bases(errors, 5.0, 40)
    assert choice.count == 17
    assert "none that was tried follows the motion" in choice.reason
    assert choice.motion_error == 860.0
    hidden = choose_bases(errors, 1000.0, 40)  # motion does not show beside what the Gaussians leave
    assert (hidden.count, hidden.motion_error) == (3, None)


def test_between_stills_bases_that_miss_the_motion_by_far_more_are_not_taken() -> None:
    errors = motion_left({1: 2267.0, 3: 2161.0, 5: 2937.0, 9: 3214.0})
    choice = choose_bases(errors, 12.0, 22)
    assert choice.count == 5
    assert "more lose over 1.5 dB" in choice.reason


def test_light_that_no_number_follows_gets_no_more_bases() -> None:
    clip, train, _ = followed("still")
    brightness = 1 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (FRAMES, 1, 1, 1))
    flickering = dataclasses.replace(clip, rgb=np.clip(clip.rgb * brightness, 0, 255).astype(np.uint8))
    tried = tried_bases([track(flickering, train)], flickering, train)
    floor = floor_error(flickering, train[0], MIN_STRIDE)
    assert min(each.light for each in tried.tracked.values()) > max(floor, tried.tracked[REST].light / 2)
    choice = choose_bases(tried, floor, len(train))
    assert choice.count <= BASES[0]
    assert "follows the motion" not in choice.reason


def test_where_one_number_alone_could_be_tried_nothing_is_said_of_the_motion() -> None:
    choice = choose_bases(motion_left({3: 1000.0}), 1.0, 10)
    assert choice.count == 3
    assert choice.reason == "the most that 10 training frames bear"


@pytest.mark.parametrize(
    ("frames", "most", "tried", "cap"),
    [
        (40, None, 17, "the most that 40 training frames bear"),
        (40, 17, 17, "the most that the preset allows"),
        (40, 25, 17, "the most that 40 training frames bear"),
        (200, 17, 17, "the most that the preset allows"),
        (135, None, 33, "the most that 135 training frames bear"),
        (1750, None, 193, "the most there are to choose from"),
    ],
)
def test_the_most_is_called_by_what_limits_it(frames: int, most: int | None, tried: int, cap: str) -> None:
    errors = motion_left({bases: 1000.0 for bases in BASES if bases <= tried})
    choice = choose_bases(errors, 1.0, frames, most)
    assert choice.count == tried
    assert choice.reason.startswith(cap + ",")


@pytest.mark.parametrize("frames", [10, 21, 40])
def test_there_are_more_than_two_training_frames_for_each_basis(frames: int) -> None:
    clip = phantom_clip("pull", frames=frames)
    train = list(range(frames))
    tried = tried_bases([track(clip, train)], clip, train)
    assert frames / max(tried.tracked) > 2


def test_gaussians_farther_apart_leave_more_of_the_picture() -> None:
    clip, train, _ = followed("still")
    left = [floor_error(clip, train[0], stride) for stride in (1, 2, 3, 4, 6)]
    assert left == sorted(left)
    assert left[0] == pytest.approx(0, abs=1e-3)


def test_a_flat_picture_gets_points_farther_apart() -> None:
    clip, train, tracks = followed("still")
    open_grid = dataclasses.replace(FAST, points_per_image=None)
    flat = dataclasses.replace(clip, rgb=np.full_like(clip.rgb, 130))
    detailed, smooth = (resolve_preset(open_grid, tracks, each, train)[0].fusion.stride for each in (clip, flat))
    assert detailed == MIN_STRIDE
    assert smooth == MAX_COARSENING * MIN_STRIDE


@pytest.mark.parametrize("points", [100, 500, 2000])
def test_a_fixed_number_of_points_is_kept_to(points: int) -> None:
    clip, train, tracks = followed("still")
    fixed, _, _ = resolve_preset(dataclasses.replace(FAST, points_per_image=points), tracks, clip, train)
    assert fixed.points_per_image == points
    assert fusion_for(fixed, clip.intrinsics).stride == max(MIN_STRIDE, round(math.sqrt(96 * 80 / points)))


@pytest.mark.parametrize("frames", [1, 2, MIN_TRIAL_FRAMES - 1])
def test_too_short_a_clip_gets_no_more_bases_than_frames_and_is_told_so(frames: int) -> None:
    clip = phantom_clip(frames=frames)
    train = list(range(frames))
    preset, notices, _ = resolve_preset(FAST, [track(clip, train)] if frames > 1 else [], clip, train)
    assert preset.bases is not None
    assert 1 <= preset.bases <= frames
    assert any("too little could be followed" in each.text for each in notices)


@pytest.mark.parametrize(("frames", "bases"), [(1, 1), (2, 2), (12, 4), (105, 33), (875, 193)])
def test_where_nothing_could_be_followed_bases_come_by_the_frames_up_to_the_most(frames: int, bases: int) -> None:
    assert choose_bases(BasisTrials({}), 10.0, frames).count == bases


@pytest.mark.parametrize("most", [2, 5, 12, 1000])
def test_a_preset_may_allow_fewer_bases_than_the_scene_would_get(most: int) -> None:
    clip, train, tracks = followed("breathing")
    limited, notices, _ = resolve_preset(dataclasses.replace(FAST, max_bases=most), tracks, clip, train)
    assert limited.bases is not None
    assert limited.bases <= most
    assert limited.bases == bases_for("breathing") or most < bases_for("breathing")
    assert notices[-1].text.startswith(f"Motion has {limited.bases} bases: ")
    assert max(tried_bases(tracks, clip, train, most).tracked) <= most


@pytest.mark.parametrize("most", [1, 2, 17])
def test_where_nothing_could_be_followed_a_preset_gets_no_more_bases_than_it_allows(most: int) -> None:
    assert choose_bases(BasisTrials({}), 10.0, 1000, most).count == most


@pytest.mark.parametrize("bases", [3, 9, 33])
def test_a_fixed_number_is_kept_to(bases: int) -> None:
    clip, train, tracks = followed("breathing")
    fixed = dataclasses.replace(FAST, bases=bases)
    assert resolve_preset(fixed, tracks, clip, train)[0] == fixed


def test_the_report_is_told_what_was_chosen() -> None:
    clip = phantom_clip()
    run = prepared_on(clip, split_frames(clip))
    bases = run.model.export()[1].bases
    assert any(each.text.startswith(f"Motion has {bases} bas") for each in run.chosen)
    assert prepared_on(clip, split_frames(clip)).chosen == run.chosen
