"""The conditions of the stability atlas do what their table says, the same each time, and keep the truth."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.clip.types import Eye
from lab.conditions import CONDITIONS, SEVERITIES, CleanClip, Given, Recording, clean_clip, write_recording
from lab.conditions.exposure import TONE_POWER
from lab.conditions.lens import BLOOD_FROM
from lab.conditions.smoke import AIRLIGHT, CLOUD_AT, smoke_before, with_haze, with_smoke
from lab.phantom import PhantomSettings

pytestmark = pytest.mark.usefixtures("each_phantom_once")

CLEAN_FRAMES = 12
OF_THE_SAME_CLIP = [name for name in CONDITIONS if not name.startswith(("tiny", "large", "cutting", "fast_pull"))]
SLOW = ("large", "tiny")  # a phantom of its own for each severity


@cache
def clean() -> CleanClip:
    return clean_clip(PhantomSettings(width=96, height=80, frames=CLEAN_FRAMES))


def spoilt_anew(name: str, severity: int) -> Given:
    return CONDITIONS[name].apply(clean(), severity, 0)


@cache
def spoilt(name: str, severity: int) -> Given:
    """The same, shared by the tests: some conditions draw a phantom of their own."""
    return spoilt_anew(name, severity)


def clip_of(given: Given) -> DepthClip:
    assert isinstance(given.clip, DepthClip)
    return given.clip


def pictures(given: Given) -> NDArray[np.uint8]:
    """All the frames, or of a recording the first pair."""
    if isinstance(given.clip, DepthClip):
        return given.clip.rgb
    frame = given.clip.frame(0)
    return np.stack([frame.left, frame.right])


@pytest.mark.parametrize("name", [name for name in CONDITIONS if name not in SLOW])
def test_the_same_severity_and_seed_give_the_same_clip_and_leave_the_clean_one_alone(name: str) -> None:
    before = clean().clip.rgb.copy(), clean().clip.depth_mm.copy(), clean().clip.tissue.copy()
    first, again = spoilt_anew(name, 5), spoilt(name, 5)
    np.testing.assert_array_equal(pictures(first), pictures(again))
    if isinstance(first.clip, DepthClip):
        np.testing.assert_array_equal(clip_of(first).depth_mm, clip_of(again).depth_mm)
        np.testing.assert_array_equal(clip_of(first).world_from_camera, clip_of(again).world_from_camera)
    for value, kept in zip((clean().clip.rgb, clean().clip.depth_mm, clean().clip.tissue), before, strict=True):
        np.testing.assert_array_equal(value, kept)


@pytest.mark.parametrize("name", [name for name in CONDITIONS if name not in SLOW])
def test_what_is_given_fits_its_truth(name: str) -> None:
    given = spoilt(name, 5)
    height, width = given.depth_mm.shape[1:]
    assert given.rgb.shape == (CLEAN_FRAMES, height, width, 3)
    assert given.scored.shape == (CLEAN_FRAMES, height, width)
    assert given.scored.any(axis=(1, 2)).all()
    assert (given.depth_mm[given.scored] > 0).all()
    assert max(given.source) < CLEAN_FRAMES
    if isinstance(given.clip, DepthClip):
        assert len(given.source) == given.clip.frame_count
        assert given.clip.rgb.shape[1:3] == (height, width)
        assert given.clip.rgb.dtype == np.uint8
        assert given.clip.depth_mm.dtype == np.float32


def test_every_condition_has_five_levels_that_grow_worse_in_order() -> None:
    for condition in CONDITIONS.values():
        assert len(condition.levels) == len(SEVERITIES)
        assert list(condition.levels) in (sorted(condition.levels), sorted(condition.levels, reverse=True))


@pytest.mark.parametrize(
    "name", ["smoke", "splash", "blood", "defocus", "motion_blur", "exposure_drift", "auto_exposure", "white_balance"]
)
def test_a_higher_severity_is_farther_from_the_clean_pictures(name: str) -> None:
    distances = [
        float(np.abs(clip_of(spoilt(name, severity)).rgb.astype(float) - clean().clip.rgb).mean())
        for severity in SEVERITIES
    ]
    assert distances == sorted(distances)
    assert distances[0] > 0


@pytest.mark.parametrize("severity", SEVERITIES)
def test_shares_are_what_the_table_says(severity: int) -> None:
    def level(name: str) -> float:
        return CONDITIONS[name].levels[severity - 1]

    pixels = clean().clip.tissue.size
    covered = (clip_of(spoilt("tools", severity)).depth_mm == 45).sum() / pixels
    assert covered == pytest.approx(level("tools"), abs=0.01)
    holes = (clip_of(spoilt("depth_holes", severity)).depth_mm == 0).mean()
    assert holes == pytest.approx(level("depth_holes"), abs=0.02)
    ratio = clip_of(spoilt("depth_outliers", severity)).depth_mm / clean().clip.depth_mm
    assert (ratio != 1).mean() == pytest.approx(level("depth_outliers"), abs=0.02)
    border = (clip_of(spoilt("black_border", severity)).rgb.sum(axis=-1) == 0).mean()
    assert border == pytest.approx(level("black_border"), abs=0.02)
    unmasked = clip_of(spoilt("masks_missing", severity)).tissue.all(axis=(1, 2)).mean()
    assert unmasked == pytest.approx(level("masks_missing"), abs=0.05)


@pytest.mark.parametrize("name", ["fast_pull", "cutting"])
def test_a_motion_of_its_own_is_compared_with_itself_when_it_is_calm(name: str) -> None:
    def way(severity: int) -> float:
        return float(np.abs(np.diff(spoilt(name, severity).depth_mm, axis=0)).mean())

    assert way(0) < way(1) < way(5)
    assert CONDITIONS[name].clean_name == name


def test_depth_noise_has_the_deviation_of_its_level() -> None:
    error = clip_of(spoilt("depth_noise", 3)).depth_mm / clean().clip.depth_mm - 1
    assert error.std() == pytest.approx(0.05, rel=0.05)


def test_frames_that_are_lost_or_few_say_where_they_come_from() -> None:
    for name in ("few_frames", "dropped_frames"):
        given = spoilt(name, 3)
        assert list(given.source) == sorted(set(given.source))
        np.testing.assert_array_equal(clip_of(given).rgb, clean().clip.rgb[list(given.source)])
    assert clip_of(spoilt("few_frames", 5)).frame_count == 1


def test_repeated_frames_are_judged_by_what_should_have_been_there() -> None:
    given = spoilt("duplicated_frames", 4)
    assert given.source == tuple(range(CLEAN_FRAMES))
    repeats = [np.array_equal(*pair) for pair in zip(clip_of(given).rgb[1:], clip_of(given).rgb[:-1], strict=True)]
    assert sum(repeats) == round(0.55 * CLEAN_FRAMES)


def test_grey_and_flooded_pictures_are_judged_against_grey_and_flooded_tissue() -> None:
    grey = spoilt("grey_scale", 5)
    assert np.ptp(grey.rgb, axis=-1).max() < 1e-6
    flooded = spoilt("blood", 5)
    assert flooded.rgb[-1, -1].mean(axis=0)[0] > 3 * flooded.rgb[-1, -1].mean(axis=0)[1]
    np.testing.assert_array_equal(spoilt("smoke", 5).rgb, clean().rgb)


def test_wrong_poses_are_right_in_the_first_frame_and_the_pictures_show_the_right_ones() -> None:
    right, wrong = spoilt("moving_camera", 2), spoilt("noisy_poses", 3)
    np.testing.assert_array_equal(clip_of(right).rgb, clip_of(wrong).rgb)
    np.testing.assert_array_equal(clip_of(wrong).world_from_camera[0], np.eye(4))
    error_mm = (clip_of(wrong).world_from_camera - clip_of(right).world_from_camera)[1:, :3, 3]
    assert 0.2 < error_mm.std() < 1.0
    rotations = clip_of(wrong).world_from_camera[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (12, 3, 3)), atol=1e-9
    )


def test_a_recording_is_written_as_files_with_what_the_user_believes(tmp_path: Path) -> None:
    given = spoilt("wrong_baseline", 5)
    assert isinstance(given.clip, Recording)
    request = write_recording(given.clip, tmp_path)
    assert (tmp_path / "000011r.png").exists()
    assert request.calibration is not None
    told_mm = 1.5 * clean().phantom.settings.baseline_mm
    assert f"T_0={-told_mm:.9g}" in request.calibration.read_text()
    np.testing.assert_array_equal(given.clip.frame(2).right, clean().phantom.frame(2).right)


def test_misrectified_and_inverted_recordings_are_just_that() -> None:
    low = spoilt("misrectified", 3).clip
    assert isinstance(low, Recording)
    np.testing.assert_array_equal(low.frame(0).right[4:], clean().phantom.frame(0).right[:-4])
    np.testing.assert_array_equal(low.frame(0).left, clean().phantom.frame(0).left)
    inverted = spoilt("inverted_masks", 2).clip
    assert isinstance(inverted, Recording)
    assert inverted.frame(0).tissue.mean() == pytest.approx(1 - clean().phantom.frame(0).tissue.mean() + 0.2, abs=0.1)


def test_other_sizes_show_the_same_tissue() -> None:
    given = spoilt("tiny", 5)
    assert clip_of(given).rgb.shape == (CLEAN_FRAMES, 51, 64, 3)


def on_a_wall(depth_mm: float = 80.0) -> DepthClip:
    """Three black frames of both eyes, 4 mm apart, before a wall; a corner has no depth."""
    depths = np.full((3, 64, 160), depth_mm, np.float32)
    depths[:, :8, :8] = 0
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    black, tissue = np.zeros((3, 64, 160, 3), np.uint8), np.ones((3, 64, 160), np.bool_)
    camera = clean().clip.intrinsics
    right = Eye(black, tissue, depths, np.full_like(tissue, 255, np.uint8), camera, poses + 4.0 * np.eye(4, k=3))
    left = (black, tissue, depths, right.depth_confidence, camera, poses)
    return DepthClip(*left, frame_times_s=np.arange(3) / 25, right=right)


@pytest.mark.parametrize("severity", SEVERITIES)
def test_smoke_takes_its_share_of_the_light_and_grows_with_depth(severity: int) -> None:
    level, depth_mm = CONDITIONS["smoke"].level(severity), clean().clip.depth_mm
    smoke = smoke_before(depth_mm, level, np.random.default_rng(0))
    passing = np.stack([smoke.passes(index, each) for index, each in enumerate(depth_mm)])
    assert 1 - passing.mean() == pytest.approx(level, abs=0.005)
    np.testing.assert_allclose(smoke.passes(0, 2 * depth_mm[0]), passing[0] ** 2, rtol=1e-4)
    assert np.abs(passing[0] - passing[-1]).max() > 0.02  # it drifts


def test_both_eyes_of_any_clip_see_one_cloud() -> None:
    clip = on_a_wall()
    veiled = with_smoke(clip, 0.4, np.random.default_rng(0))
    assert veiled.right is not None
    nearer_px = round(clip.intrinsics.fx * 4.0 / (CLOUD_AT * 80.0))
    np.testing.assert_array_equal(veiled.right.rgb[:, :, :-nearer_px], veiled.rgb[:, :, nearer_px:])
    assert veiled.rgb.mean() == pytest.approx(0.4 * AIRLIGHT, rel=0.02)
    assert veiled.rgb[:, :8, :8].min() > 0  # also where depth is not known
    np.testing.assert_array_equal(veiled.depth_mm, clip.depth_mm)


def test_haze_is_even_in_both_eyes_and_clear_for_half_of_the_time() -> None:
    hazy = with_haze(on_a_wall(), 0.4, np.random.default_rng(0))
    assert hazy.right is not None
    np.testing.assert_array_equal(hazy.right.rgb, hazy.rgb)
    assert 0 < hazy.rgb.max() <= round(0.4 * AIRLIGHT)
    assert np.ptp(hazy.rgb, axis=(1, 2, 3)).max() == 0
    seen = with_haze(clean().clip, 0.4, np.random.default_rng(0)).rgb
    assert (seen == clean().clip.rgb).all(axis=(1, 2, 3)).mean() == pytest.approx(0.5, abs=0.1)


def test_exposure_follows_a_bright_and_a_dark_instrument_by_the_stops_of_the_level() -> None:
    given = spoilt("auto_exposure", 3)
    both = clip_of(given).tissue & (clean().clip.rgb.min(axis=-1) > 40) & (clean().clip.rgb.max(axis=-1) < 200)
    ratios = clip_of(given).rgb[..., 0] / np.maximum(clean().clip.rgb[..., 0], 1)
    stops = np.array([TONE_POWER * np.log2(np.median(each[here])) for each, here in zip(ratios, both, strict=True)])
    assert np.ptp(stops) == pytest.approx(CONDITIONS["auto_exposure"].level(3), abs=0.1)
    most_covered = int(clip_of(given).tissue[: CLEAN_FRAMES // 2].mean(axis=(1, 2)).argmin())
    assert stops[0] == 0
    assert (
        most_covered < stops.argmin() < CLEAN_FRAMES - 1
    )  # it lags behind the bright one, and rises with the dark one


def test_exposure_follows_an_advancing_lamp_with_a_lag_and_the_truth_is_without() -> None:
    given = spoilt("advancing_lamp", 5)
    nearest_mm = clip_of(given).world_from_camera[:, 2, 3]
    assert 0.95 * 40 < nearest_mm.max() <= 40  # where light is two stops stronger
    steady, recorded = given.rgb.mean(axis=(1, 2, 3)), clip_of(given).rgb.mean(axis=(1, 2, 3)) / 255
    assert recorded[0] == pytest.approx(steady[0], rel=0.1)
    assert recorded[CLEAN_FRAMES // 2] > 1.2 * steady[CLEAN_FRAMES // 2]
    assert recorded[-1] < 0.95 * steady[-1]


@pytest.mark.parametrize("severity", SEVERITIES)
def test_drops_appear_at_some_moment_and_stay_where_they_are(severity: int) -> None:
    changes = np.abs(clip_of(spoilt("splash", severity)).rgb.astype(int) - clean().clip.rgb).max(axis=-1)
    assert not changes[: int(BLOOD_FROM * CLEAN_FRAMES)].any()
    share = (changes[-2:].max(axis=0) > 30).mean()
    assert share == pytest.approx(CONDITIONS["splash"].level(severity), rel=0.5)
    assert not changes[-1][changes[-2:].max(axis=0) == 0].any()
    files = spoilt("splash_stereo", severity).clip
    assert isinstance(files, Recording)
    frame, before = files.frame(CLEAN_FRAMES - 1), clean().phantom.frame(CLEAN_FRAMES - 1)
    left, right = (np.abs(a.astype(int) - b) for a, b in ((frame.left, before.left), (frame.right, before.right)))
    assert left.max() > 30 < right.max()
    assert ((left > 0).any(axis=-1) != (right > 0).any(axis=-1)).any()
