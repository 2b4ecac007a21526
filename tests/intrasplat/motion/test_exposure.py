"""Exposure and white balance that change are measured along tracks, trained without, and shown on request."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, split_frames
from intrasplat.motion.exposure import MIN_CELLS, MIN_SHARE, Exposure, find_exposure, in_steady_light
from intrasplat.motion.keyframes import track_keyframes
from intrasplat.motion.light import RecordedLight
from intrasplat.motion.tracks import Tracks, without_gains
from intrasplat.notices import NoticeCode
from intrasplat.outcome import snapshot_of, training_of
from intrasplat.train.scoring import frame_renderer
from intrasplat.view.render import render_frame
from tests.intrasplat.phantoms import FRAMES, keep, kept, phantom_clip, prepared, trained

STOPS, TINT = 1.5, 1.3


def drifting(stops: float, tint: float = 1.0) -> tuple[DepthClip, NDArray[np.float64]]:
    """A clip whose exposure and white balance change, and its log gains [T, 3]."""
    clip, share = phantom_clip(tools=False), np.arange(FRAMES) / FRAMES
    stop = stops / 2 * np.sin(2 * np.pi * share) * np.log(2) / 2.2
    red = np.log(tint) * share
    logs = stop[:, None] + red[:, None] * np.array([1.0, 0.0, -1.0])
    rgb = np.clip(clip.rgb * np.exp(logs)[:, None, None] + 0.5, 0, 255).astype(np.uint8)
    return dataclasses.replace(clip, rgb=rgb), logs


@cache
def found(stops: float, tint: float = 1.0) -> tuple[DepthClip, Exposure | None, NDArray[np.float64]]:
    clip, logs = drifting(stops, tint)
    train = split_frames(clip).train
    return clip, find_exposure(clip, train, track_keyframes(clip, train)), logs


@pytest.mark.parametrize(("stops", "tint"), [(STOPS, 1.0), (0.0, TINT), (STOPS, TINT)])
def test_gains_that_change_are_measured_to_a_few_per_cent(stops: float, tint: float) -> None:
    clip, exposure, logs = found(stops, tint)
    assert exposure is not None
    train = split_frames(clip).train
    true = (logs - logs[exposure.reference])[train]
    assert np.abs(exposure.log_gains[train] - true).max() < 0.08
    assert not exposure.log_gains[exposure.reference].any()


def test_light_that_hardly_changes_is_left_alone() -> None:
    assert found(0.0)[1] is None
    assert found(0.3)[1] is None
    assert "log_gains" not in snapshot_of(prepared(phantom_clip())[0]).settings


def grey_clip(log_gains: NDArray[np.float64]) -> DepthClip:
    """A clip of even pictures with these log gains [T]."""
    clip = phantom_clip(width=160, height=128, tools=False)
    levels = np.clip(100 * np.exp(log_gains) + 0.5, 0, 255).astype(np.uint8)
    return dataclasses.replace(clip, rgb=np.broadcast_to(levels[:, None, None, None], clip.rgb.shape).copy())


def still(clip: DepthClip, reference: int, frames: Sequence[int]) -> Tracks:
    """Tracks of a clip in which nothing moves."""
    step_px = 4
    shape = (len(frames), *(side // step_px for side in clip.rgb.shape[1:3]))
    levels = clip.rgb[:, 0, 0].astype(np.float32) / 255
    colour = np.broadcast_to((levels[frames] - levels[reference])[:, None, None], (*shape, 3)).copy()
    return Tracks(
        np.zeros((*shape, 3), np.float32), colour, np.ones(shape, np.float32), step_px, reference, list(frames)
    )


def test_frames_that_no_track_joins_have_the_gain_of_their_neighbours() -> None:
    log_gains = np.minimum(np.arange(FRAMES) * 0.05, 0.05 * (FRAMES // 2))
    clip, train, half = grey_clip(log_gains), range(FRAMES), FRAMES // 2
    exposure = find_exposure(clip, train, [still(clip, 0, range(half)), still(clip, half, range(half, FRAMES))])
    assert exposure is not None
    true = log_gains - log_gains[exposure.reference]
    assert np.abs(exposure.log_gains - true[:, None]).max() < 0.08


@pytest.mark.parametrize(
    ("log_gains", "flickers"),
    [
        (0.1 * (np.arange(FRAMES) % 3 == 0), True),
        (0.4 * (np.arange(FRAMES) % 5 == 0), True),
        (0.05 * np.arange(FRAMES), False),
        (0.4 * (np.arange(FRAMES) >= FRAMES - 1), False),
    ],
    ids=["small", "large", "drift", "once"],
)
def test_light_that_changes_faster_than_frames_show_is_corrected_and_named(
    log_gains: NDArray[np.float64], flickers: bool
) -> None:
    clip, train = grey_clip(log_gains), range(FRAMES)
    exposure = find_exposure(clip, train, [still(clip, 0, train)])
    assert exposure is not None
    assert np.abs(exposure.log_gains - (log_gains - log_gains[exposure.reference])[:, None]).max() < 0.02
    codes = [each.code for each in RecordedLight(exposure).warnings(clip, train)]
    assert codes == [NoticeCode.LIGHT_FLICKERS] * flickers


def test_the_notice_says_when_it_is_darkest_and_brightest() -> None:
    logs = np.array([0.0, 0.1, 0.4, -0.3, 0.0])[:, None].repeat(3, axis=1)
    assert (
        "from frame 3 (0.3 s), the darkest, to frame 2 (0.2 s), the brightest"
        in Exposure(logs, 0).notice(np.arange(5) * 0.1).text
    )


def test_a_few_cells_do_not_tell_a_frames_gain() -> None:
    clip = grey_clip(np.zeros(FRAMES))
    tracks = still(clip, 0, range(FRAMES))
    tracks.confidence[7] = 0
    tracks.confidence[7].ravel()[:40] = 1
    tracks.colour[7] = -0.2
    assert MIN_CELLS < 40 < MIN_SHARE * tracks.confidence[7].size
    assert find_exposure(clip, range(FRAMES), [tracks]) is None


def test_held_out_frames_are_not_read() -> None:
    clip, exposure, _ = found(STOPS)
    split = split_frames(clip)
    poisoned = dataclasses.replace(clip, rgb=clip.rgb.copy())
    poisoned.rgb[split.held_out] = 255
    again = find_exposure(poisoned, split.train, track_keyframes(poisoned, split.train))
    assert exposure is not None
    assert again is not None
    np.testing.assert_array_equal(again.log_gains, exposure.log_gains)


def test_a_clip_in_steady_light_has_the_light_of_the_reference() -> None:
    clip, exposure, _ = found(STOPS, TINT)
    assert exposure is not None
    steady = in_steady_light(clip, exposure)
    np.testing.assert_array_equal(steady.rgb[exposure.reference], clip.rgb[exposure.reference])
    before, after = (each.rgb[split_frames(clip).train].mean(axis=(1, 2)).std(axis=0) for each in (clip, steady))
    assert (after < 0.4 * before)[[0, 2]].all()


def test_tracks_without_gains_have_the_colours_of_steady_light() -> None:
    (clip, logs), train = drifting(0.9), split_frames(phantom_clip(tools=False)).train
    recorded, steady = (track_keyframes(each, train)[0] for each in (clip, phantom_clip(tools=False)))
    corrected = without_gains(recorded, clip, train, logs)
    trusted = (recorded.confidence > 0.5) & (steady.confidence > 0.5)
    off, off_before = (np.abs(each.colour - steady.colour)[trusted].mean() for each in (corrected, recorded))
    assert off < 0.2 * off_before
    assert off < 0.004
    assert corrected.displacement_mm is recorded.displacement_mm


def test_a_scene_shows_steady_light_or_the_recorded_one_and_resumes_with_its_gains(tmp_path: Path) -> None:
    clip, _ = drifting(STOPS)
    run = prepared(clip)[0]
    assert run.light.exposure is not None
    keep(tmp_path, run)
    again = kept(tmp_path, prepared(clip)[0])
    assert again.light.exposure is not None
    np.testing.assert_array_equal(again.light.exposure.log_gains, run.light.exposure.log_gains)
    trained(run)
    scene = snapshot_of(run)
    frame = int(np.abs(run.light.exposure.log_gains.mean(axis=1)).argmax())
    t = frame / FRAMES
    steady, recorded = (render_frame(scene, t, light=light, detail="off").rgb for light in ("steady", "recorded"))
    gains = np.exp(run.light.exposure.log_gains[frame])
    inner = (steady > 40) & (steady < 180)
    assert np.median((recorded / np.maximum(steady, 1) / gains)[inner]) == pytest.approx(1, abs=0.02)
    np.testing.assert_allclose(
        np.clip(frame_renderer(run)(frame).rgb, 0, 1) * 255, recorded, atol=1.1
    )  # held-out scores are in the recorded light
    training = training_of(run, scene, None)
    assert NoticeCode.EXPOSURE in {each.code for each in training.assumptions}
    assert training.light is not None
    assert training.light.smoke_share is training.light.vignetting is None
    stops = run.light.exposure.log_gains.mean(axis=1) / (np.log(2) / 2.2)
    assert training.light.stops == pytest.approx(stops, abs=5.1e-4)
    assert training.light.stops[training.light.reference or 0] == 0


def test_the_report_has_white_balance_as_factors_of_red_and_blue_against_green() -> None:
    logs = np.log([[1.0, 1.0, 1.0], [2.4, 2.0, 1.8], [0.5, 0.5, 0.5]])
    changes = RecordedLight(Exposure(logs, 0)).changes(phantom_clip())
    assert changes is not None
    assert (changes.reference, changes.red, changes.blue) == (0, (1, 1.2, 1), (1, 0.9, 1))
    assert RecordedLight().changes(phantom_clip()) is None


@pytest.mark.parametrize(
    "wrong", [[[0.0] * 3], [[0.0] * 2] * FRAMES, [[9.0] * 3] * FRAMES, [[float("nan")] * 3] * FRAMES]
)
def test_gains_that_are_none_are_refused(wrong: list[list[float]]) -> None:
    scene = snapshot_of(prepared(phantom_clip())[0])
    with pytest.raises(ValueError, match="log_gains"):
        _ = dataclasses.replace(scene, settings={"log_gains": wrong}).log_gains
