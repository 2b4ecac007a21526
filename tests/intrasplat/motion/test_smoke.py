"""Smoke that drifts before the tissue is found in both eyes, removed from training, and drawn on request."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, Eye, split_frames
from intrasplat.motion.keyframes import track_keyframes
from intrasplat.motion.smoke import find_veils
from intrasplat.motion.tracks import Tracks
from intrasplat.motion.veil import MIN_TRANSMISSION, Veil, warnings_of, without_veils
from intrasplat.notices import Notice, NoticeCode
from intrasplat.outcome import snapshot_of, training_of
from intrasplat.quality.report import first_report
from intrasplat.train.scoring import frame_renderer
from intrasplat.view.render import render_frame
from lab.conditions.lens import with_splash
from lab.phantom import PhantomSettings
from tests.intrasplat.motion.test_exposure import drifting
from tests.intrasplat.phantoms import keep, kept, matched_stereo, phantom_clip, prepared, trained

FRAMES, GREY = 24, 200.0


@cache
def clear_clip() -> DepthClip:
    return matched_stereo(PhantomSettings(width=160, height=128, frames=FRAMES, period_frames=12.0, tools=()))[0]


def veil_over(clip: DepthClip, share: float, cloud_px: float = 24.0) -> Veil:
    """Smoke that takes about this share of the light, in clouds of this size that drift to the left."""
    frames, height, width = clip.tissue.shape
    noise = np.random.default_rng(0).standard_normal((height, width + 6 * frames))
    cloud = cv2.GaussianBlur(noise, (0, 0), cloud_px)
    even = -np.log(1 - share) * np.clip(1 + 0.4 * cloud / cloud.std(), 0, None)
    thickness = np.stack([even[:, 6 * frame : 6 * frame + width] for frame in range(frames)]).astype(np.float32)
    return Veil(thickness, np.full(3, GREY / 255, np.float32), float(np.median(clip.depth_mm[clip.depth_mm > 0])))


def veil_in(clip: DepthClip, by_frame: NDArray[np.floating], picture: NDArray[np.floating]) -> Veil:
    """Smoke that takes by_frame [T] times picture [H, W] of the light."""
    thickness = -np.log(1 - by_frame[:, None, None] * picture).astype(np.float32)
    return Veil(thickness, np.full(3, GREY / 255, np.float32), float(np.median(clip.depth_mm[clip.depth_mm > 0])))


def spoilt(eye: Any, veil: Veil) -> Any:
    depth_mm = np.where(eye.depth_mm > 0, eye.depth_mm, np.float32(veil.depth_mm))
    through = [veil.transmission(index, depth_mm[index])[..., None] for index in range(len(depth_mm))]
    rgb = [share * picture + (1 - share) * GREY for share, picture in zip(through, eye.rgb, strict=True)]
    return dataclasses.replace(eye, rgb=np.rint(rgb).astype(np.uint8))


def behind(clip: DepthClip, veil: Veil) -> DepthClip:
    return dataclasses.replace(spoilt(clip, veil), right=clip.right and spoilt(clip.right, veil))


def smoky(clip: DepthClip, share: float) -> DepthClip:
    return behind(clip, veil_over(clip, share))


def found_in(clip: DepthClip) -> tuple[Veil, ...]:
    train = split_frames(clip).train
    return find_veils(clip, train, track_keyframes(clip, train), clip)


@cache
def found(share: float) -> tuple[DepthClip, tuple[Veil, ...]]:
    clip = smoky(clear_clip(), share)
    return clip, found_in(clip)


def error_after_a_fit(eye: Eye, true: Eye) -> float:
    """RMS in levels of the training frames' tissue, after one fit of gain and offset by channel."""
    frames = split_frames(clear_clip()).train
    tissue = true.tissue[frames]
    errors = []
    for channel in range(3):
        given, wanted = (each.rgb[frames][..., channel][tissue].astype(np.float64) for each in (eye, true))
        errors.append(np.polyval(np.polyfit(given, wanted, 1), given) - wanted)
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("share", [0.25, 0.4])
def test_smoke_that_drifts_is_removed_from_both_eyes(share: float) -> None:
    clip, veils = found(share)
    clear, true = without_veils(clip, veils), clear_clip()
    assert clear.right is not None
    assert clip.right is not None
    assert true.right is not None
    assert error_after_a_fit(clear, true) < 0.7 * error_after_a_fit(clip, true)
    assert error_after_a_fit(clear.right, true.right) < 0.7 * error_after_a_fit(clip.right, true.right)
    assert np.abs(veils[0].airlight * 255 - GREY).max() < 40


EVERYWHERE = np.ones((128, 160))
LATER, AT_FIRST = np.clip((np.arange(FRAMES) - 10) / 3, 0, 1), np.clip((12 - np.arange(FRAMES)) / 3, 0, 1)
CORNER = np.exp(-((np.indices((128, 160)) - np.array([28, 116]).reshape(2, 1, 1)) ** 2).sum(0) / (2 * 16**2))


@pytest.mark.parametrize(
    ("by_frame", "picture", "share", "left"),
    [
        (LATER, EVERYWHERE, 0.35, 0.4),
        (LATER, EVERYWHERE, 0.2, 0.4),
        (AT_FIRST, EVERYWHERE, 0.35, 0.4),
        (LATER, CORNER, 0.5, 0.6),
    ],
    ids=["later", "thin", "at first", "in a corner"],
)
def test_smoke_in_a_part_of_the_frames_is_removed_and_leaves_the_others_alone(
    by_frame: NDArray[np.floating], picture: NDArray[np.floating], share: float, left: float
) -> None:
    true = clear_clip()
    veil = veil_in(true, share * by_frame, picture)
    clip = behind(true, veil)
    veils = found_in(clip)
    assert veils
    clear, tissue = without_veils(clip, veils), true.tissue
    with_smoke, without = by_frame == 1, by_frame == 0
    before, after = (np.abs(each.rgb.astype(float) - true.rgb).mean(-1) for each in (clip, clear))
    assert after[with_smoke][tissue[with_smoke]].mean() < left * before[with_smoke][tissue[with_smoke]].mean()
    assert after[without][tissue[without]].mean() < 2.5
    assert veils[0].share_taken()[without].max() < 0.04
    assert veils[0].share_taken()[with_smoke].mean() > 0.6 * veil.share_taken()[with_smoke].mean()


def test_dark_tissue_stays_as_it_is_in_clear_frames() -> None:
    true = clear_clip()
    dim = np.exp(-2 * (np.linspace(-1, 1, 160) ** 4))[:, None]
    true = dataclasses.replace(true, rgb=np.rint(true.rgb * dim).astype(np.uint8), right=None)
    clip = behind(true, veil_in(true, 0.35 * LATER, EVERYWHERE))
    clear, frame = without_veils(clip, found_in(clip)), 4
    dark = true.tissue[frame] & (true.rgb[frame].max(-1) < 50)
    assert dark.sum() > 500
    assert np.abs(clear.rgb[frame][dark].astype(float) - true.rgb[frame][dark]).mean() < 3


def test_clear_clips_and_changing_light_have_no_smoke() -> None:
    steady = clear_clip()
    blurred = np.stack([cv2.GaussianBlur(each, (0, 0), 1 + index % 2) for index, each in enumerate(steady.rgb)])
    splashed = with_splash(steady, 0.1, np.random.default_rng(0))
    for clip in (steady, drifting(1.5)[0], drifting(0.0, 1.8)[0], dataclasses.replace(steady, rgb=blurred), splashed):
        assert found_in(clip) == ()


def test_a_keyframe_that_no_track_leaves_says_nothing() -> None:
    clip = behind(clear_clip(), veil_in(clear_clip(), 0.35 * LATER, EVERYWHERE))
    train = split_frames(clip).train
    (tracks,) = track_keyframes(clip, train)
    lost = Tracks.empty(tracks.followed.tolist(), tracks.confidence.shape[1:], tracks.step_px, reference=3)
    alone, with_lost = (find_veils(clip, train, each, clip)[0] for each in ([tracks], [tracks, lost]))
    np.testing.assert_allclose(with_lost.share_taken(), alone.share_taken(), atol=0.02)


def test_tracks_of_other_tissue_show_no_smoke() -> None:
    clip = clear_clip()
    train = split_frames(clip).train
    tracks = track_keyframes(clip, train)
    noise = np.random.default_rng(0).integers(60, 200, clip.rgb.shape).astype(np.uint8)
    assert find_veils(dataclasses.replace(clip, rgb=noise), train, tracks, clip) == ()


def test_held_out_frames_are_not_read() -> None:
    clip, veils = found(0.4)
    split = split_frames(clip)
    poisoned = dataclasses.replace(clip, rgb=clip.rgb.copy())
    poisoned.rgb[split.held_out] = 255
    again = find_veils(poisoned, split.train, track_keyframes(poisoned, split.train), poisoned)
    np.testing.assert_array_equal(again[0].thickness, veils[0].thickness)


def test_what_hardly_any_light_reaches_is_no_tissue() -> None:
    clip = clear_clip()
    thick = veil_over(clip, 0.3)
    thick.thickness[:, :64] = -2 * np.log(MIN_TRANSMISSION)
    clear = without_veils(clip, (thick,))
    assert not clear.tissue[:, :48].any()
    np.testing.assert_array_equal(clear.tissue[:, 80:], clip.tissue[:, 80:])
    assert [each.code for each in warnings_of(thick)] == [NoticeCode.VEILED]
    assert warnings_of(veil_over(clip, 0.3)) == ()


def test_a_stored_veil_is_read_back() -> None:
    veil = found(0.4)[1][0]
    again = Veil.read(veil.stored(), FRAMES)
    np.testing.assert_array_equal(again.thickness, veil.thickness)
    np.testing.assert_array_equal(again.airlight, veil.airlight)
    assert again.depth_mm == veil.depth_mm


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [FRAMES + 1, 4, 4]},
        {"shape": [FRAMES, 4]},
        {"airlight": [0.5, 0.5]},
        {"airlight": [0.5, 0.5, 2.0]},
        {"depth_mm": 0.0},
        {"thickness": "AAAA"},
        {"thickness": "not base64"},
        {"thickness": None},
    ],
)
def test_a_veil_that_is_none_is_refused(change: dict[str, Any]) -> None:
    stored = found(0.4)[1][0].stored() | change
    with pytest.raises(ValueError, match=r"veil|base64"):
        Veil.read(stored, FRAMES)


def test_a_scene_is_clear_or_shows_its_smoke_and_resumes_with_it(tmp_path: Path) -> None:
    clip = smoky(phantom_clip(frames=FRAMES, tools=False), 0.25)
    run, _ = prepared(clip)
    assert run.light.veils
    keep(tmp_path, run)
    again = kept(tmp_path, prepared(clip)[0])
    np.testing.assert_array_equal(again.light.veils[0].thickness, run.light.veils[0].thickness)
    trained(run)
    scene = snapshot_of(run)
    t = 5 / FRAMES
    clear, shown = (render_frame(scene, t, smoke=smoke, detail="off") for smoke in ("remove", "show"))
    share = clear.smoke[..., None]
    assert 0.1 < share.mean() < 0.7
    airlight = 255 * run.light.veils[0].airlight
    np.testing.assert_allclose(shown.rgb, (1 - share) * clear.rgb + share * airlight, atol=1.1)
    seen = frame_renderer(run)(5).rgb  # held-out scores are taken through the smoke
    np.testing.assert_allclose(np.clip(seen, 0, 1) * 255, shown.rgb, atol=2.1)
    training = training_of(run, scene, None)
    assert NoticeCode.SMOKE in {each.code for each in training.assumptions}
    report = first_report(clip, run.setup.split, training, [Notice.warning(NoticeCode.BRIGHTNESS_CHANGES, "")])
    assert NoticeCode.BRIGHTNESS_CHANGES not in {each.code for each in report.warnings}
    assert report.light is not None
    assert report.light.smoke_share == pytest.approx(run.light.veils[0].share_taken(), abs=5.1e-4)


def test_a_scene_without_smoke_has_an_empty_layer() -> None:
    scene = snapshot_of(prepared(phantom_clip())[0])
    assert not render_frame(scene, 0.5).smoke.any()
    assert "veil" not in scene.settings
