"""Pictures that darken towards their border are measured along tracks, trained evenly lit, and shown on request."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import DepthClip, split_frames
from intrasplat.motion.keyframes import track_keyframes
from intrasplat.motion.vignetting import Vignetting, evenly_lit, find_vignetting
from intrasplat.notices import NoticeCode
from intrasplat.outcome import snapshot_of, training_of
from intrasplat.scene.imported import _settings
from intrasplat.train.scoring import frame_renderer
from intrasplat.view.render import render_frame
from lab.phantom import PhantomSettings, make_phantom
from tests.intrasplat.phantoms import keep, kept, phantom_clip, prepared, trained

POWER = 6.0


@cache
def panned() -> DepthClip:
    """A clip whose endoscope moves sideways; its lamp alone darkens the border as a power of about 2 does."""
    settings = PhantomSettings(width=160, height=128, frames=16, camera=("pan",), tools=())
    return make_phantom(settings).depth_clip()


@cache
def darkened(stops: float = 0.0) -> DepthClip:
    """The same clip, darker towards the border, with an exposure that changes."""
    clip = panned()
    gains = np.exp(stops * np.log(2) / 2.2 * np.linspace(-0.5, 0.5, clip.frame_count))[:, None, None, None]
    factor = Vignetting(POWER, 1.0).picture(clip.intrinsics)[..., None] * gains
    return dataclasses.replace(clip, rgb=np.clip(clip.rgb * factor + 0.5, 0, 255).astype(np.uint8))


def found(clip: DepthClip) -> Vignetting | None:
    train = split_frames(clip).train
    return find_vignetting(clip, train, track_keyframes(clip, train))


@pytest.mark.parametrize("stops", [0.0, 1.5])
def test_the_power_is_measured_whatever_the_exposure(stops: float) -> None:
    vignetting = found(darkened(stops))
    assert vignetting is not None
    assert vignetting.power == pytest.approx(POWER + 2, abs=1.5)


def test_a_camera_at_rest_and_a_lamp_that_hardly_darkens_the_border_leave_the_clip_as_it_is() -> None:
    assert found(panned()) is None
    still = phantom_clip()
    assert found(still) is None
    assert "vignetting" not in snapshot_of(prepared(still)[0]).settings


def test_a_picture_that_is_no_multiple_of_the_grid_is_measured() -> None:
    settings = PhantomSettings(width=645, height=163, frames=3, camera=("pan",), tools=())
    assert found(make_phantom(settings).depth_clip()) is None


def test_held_out_frames_are_not_read() -> None:
    clip = darkened()
    poisoned = dataclasses.replace(clip, rgb=clip.rgb.copy())
    poisoned.rgb[split_frames(clip).held_out] = 255
    assert found(poisoned) == found(clip)


def test_an_evenly_lit_clip_keeps_the_brightness_of_its_middle() -> None:
    clip = darkened()
    vignetting = found(clip)
    assert vignetting is not None
    even = evenly_lit(clip, vignetting)
    assert np.median(even.rgb) == pytest.approx(np.median(clip.rgb), rel=0.1)
    border, middle = np.s_[:, :16, :24], np.s_[:, 48:80, 60:100]
    before, after = (each.rgb[border].mean() / each.rgb[middle].mean() for each in (clip, even))
    assert before < 0.6
    assert after > 1.4 * before


def test_a_scene_is_evenly_lit_or_as_recorded_from_every_pose_and_resumes(tmp_path: Path) -> None:
    clip = darkened()
    run = prepared(clip)[0]
    assert run.light.vignetting is not None
    keep(tmp_path, run)
    assert kept(tmp_path, prepared(clip)[0]).light.vignetting == run.light.vignetting
    trained(run)
    scene, frame = snapshot_of(run), split_frames(clip).train[2]
    t = frame / clip.frame_count
    steady, recorded = (render_frame(scene, t, light=light, detail="off") for light in ("steady", "recorded"))
    shown = run.light.vignetting.picture(clip.intrinsics)
    inner = (steady.rgb > 40) & (steady.rgb < 180)
    np.testing.assert_allclose(recorded.rgb[inner], (steady.rgb * shown[..., None])[inner], atol=1.5)
    np.testing.assert_allclose(np.clip(frame_renderer(run)(frame).rgb, 0, 1) * 255, recorded.rgb, atol=1.1)
    aside = scene.world_from_camera[frame].copy()
    aside[:3, 3] += 30 * aside[:3, 0]  # the endoscope's middle lies to the left now, and is bright there
    steady, recorded = (render_frame(scene, t, aside, light=light) for light in ("steady", "recorded"))
    ratio = recorded.rgb.mean(-1) / np.maximum(steady.rgb.mean(-1), 1)
    ratio[(steady.depth_mm == 0) | (steady.rgb.max(-1) > 180)] = np.nan
    assert np.nanmedian(ratio[:, :40]) > 1.5 * np.nanmedian(ratio[:, -40:])
    training = training_of(run, scene, None)
    assert NoticeCode.VIGNETTING in {each.code for each in training.assumptions}
    seen = shown[clip.tissue.any(axis=0)]
    assert training.light is not None
    assert training.light.vignetting == pytest.approx(seen.min() / seen.max(), abs=5.1e-4)
    assert _settings(scene)["vignetting"] == [run.light.vignetting.power, run.light.vignetting.level]


@pytest.mark.parametrize("wrong", [[1.0], [-1.0, 0.5], [2.0, 0.0], [float("nan"), 0.5], [1e9, 0.5]])
def test_numbers_that_are_no_vignetting_are_refused(wrong: list[float]) -> None:
    scene = snapshot_of(prepared(phantom_clip())[0])
    with pytest.raises(ValueError, match=r"vignetting|unpack"):
        _ = dataclasses.replace(scene, settings={"vignetting": wrong}).vignetting
