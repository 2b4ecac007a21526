"""Clips with empty frames, a lost eye, masks that cover frames, and pictures with borders go through every stage."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import intrasplat as isp
from intrasplat.clip import DepthClip
from intrasplat.notices import NoticeCode
from lab.phantom import DrawnStereo, PhantomSettings, make_phantom
from lab.phantom.settings import CameraPath

WIDTH, HEIGHT, FRAMES = 96, 80, 12
Arrays = dict[str, NDArray[Any]]
Spoil = Callable[[Arrays], None]


@cache
def drawn(camera: CameraPath | None = None) -> DrawnStereo:
    settings = PhantomSettings(
        width=WIDTH, height=HEIGHT, frames=FRAMES, period_frames=12.0, camera=() if camera is None else (camera,)
    )
    return make_phantom(settings).stereo_recording()


def recorded(camera: CameraPath | None = None) -> Arrays:
    """Copies of left and right [T, H, W, 3] and of the instruments' masks [T, H, W]."""
    left, right = (np.stack(eye) for eye in zip(*drawn(camera).clip.pairs(), strict=True))
    return {"left": left, "right": right, "masks": ~drawn(camera).tissue}


def read(given: Arrays, *, masks: bool = True) -> isp.Clip:
    return isp.read_clip(
        given["left"],
        right=given["right"],
        calibration=drawn().calibration.model_dump(mode="json"),
        masks=given["masks"] if masks else None,
    )


def round_field(radius_px: float) -> NDArray[np.bool_]:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray(np.hypot(rows - HEIGHT / 2, columns - WIDTH / 2) < radius_px)


def black_first(given: Arrays) -> None:
    given["left"][0] = given["right"][0] = 0


def no_signal(given: Arrays) -> None:
    given["left"][5:8] = given["right"][5:8] = (10, 30, 180)


def right_eye_lost(given: Arrays) -> None:
    given["right"][6:9] = 0


def covered_by_masks(given: Arrays) -> None:
    given["masks"][[0, 4, 5]] = True


def black_at_the_end(given: Arrays) -> None:
    given["left"][-2:] = given["right"][-2:] = 0


def two_frames_left(given: Arrays) -> None:
    given["left"][2:] = given["right"][2:] = 0


EMPTY: dict[Spoil, set[int]] = {
    black_first: {0},
    no_signal: {5, 6, 7},
    right_eye_lost: {6, 7, 8},
    covered_by_masks: {0, 4, 5},
    black_at_the_end: {10, 11},
    two_frames_left: {*range(2, FRAMES)},
}


@pytest.mark.parametrize("camera", [None, "swing"])
@pytest.mark.parametrize("spoil", EMPTY, ids=lambda spoil: spoil.__name__)
def test_frames_that_show_nothing_are_left_out_and_the_clip_goes_on(spoil: Spoil, camera: CameraPath | None) -> None:
    given = recorded(camera)
    spoil(given)
    clip = read(given).with_depth()
    assert set(clip.skipped) >= EMPTY[spoil]
    assert not clip.depth_mm[sorted(EMPTY[spoil])].any()
    codes = [each.code for each in clip.warnings]
    covered = spoil is covered_by_masks
    assert (NoticeCode.FRAMES_WITHOUT_TISSUE if covered else NoticeCode.FRAMES_SHOW_NOTHING) in codes
    scene = isp.reconstruct(clip, method="fast", iterations=4, device="cpu")
    assert np.isfinite(scene.render(t=0.5).depth_mm).all()
    assert {each.frame for each in scene.report.frames}.isdisjoint(EMPTY[spoil])


@pytest.mark.parametrize("spoil", [black_first, no_signal])
def test_without_masks_and_poses_it_goes_on_too(spoil: Spoil) -> None:
    given = recorded("swing")
    spoil(given)
    scene = isp.reconstruct(read(given, masks=False), method="instant", iterations=4, poses="estimate", device="cpu")
    assert scene.report.gaussians > 0


@pytest.mark.parametrize("eyes", [("left", "right"), ("right",)])
def test_a_clip_that_shows_nothing_is_refused(eyes: tuple[str, ...]) -> None:
    given = recorded()
    for eye in eyes:
        given[eye][:] = 0
    with pytest.raises(isp.InputError, match="no frame that may be trained on shows the scene"):
        read(given).with_depth()


def one_eye(given: Arrays, **changed: NDArray[Any]) -> DepthClip:
    phantom = make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=FRAMES, period_frames=12.0))
    true = phantom.depth_clip()
    arrays = {"rgb": given["left"], "masks": given["masks"], "depth_mm": true.depth_mm.copy()} | changed
    clip = isp.read_clip(arrays["rgb"], depth_mm=arrays["depth_mm"], masks=arrays["masks"], intrinsics=true.intrinsics)
    return clip.with_depth()


@pytest.mark.parametrize("spoil", [black_first, no_signal, covered_by_masks, two_frames_left])
def test_a_clip_with_depth_leaves_the_same_frames_out(spoil: Spoil) -> None:
    given = recorded()
    spoil(given)
    clip = one_eye(given)
    assert set(clip.skipped) >= EMPTY[spoil]
    scene = isp.reconstruct(clip, method="fast", iterations=4, device="cpu")
    assert scene.report.gaussians > 0


@pytest.mark.parametrize("some", [slice(0, 1), slice(1, None), slice(0, None, 2)])
def test_frames_without_depth_are_learnt_by_colour(some: slice) -> None:
    given = recorded()
    depth_mm = np.full((FRAMES, HEIGHT, WIDTH), 70, np.float32)
    depth_mm[some] = 0
    scene = isp.reconstruct(one_eye(given, depth_mm=depth_mm), method="fast", iterations=4, device="cpu")
    assert scene.report.gaussians > 0


def test_outside_a_round_field_there_is_nothing() -> None:
    given, field = recorded(), round_field(36)
    for eye in ("left", "right"):
        given[eye][:, ~field] = 0
    clip = read(given).with_depth()
    assert clip.fov is not None
    assert clip.fov.shape == "round"
    for eye in clip.eyes:
        assert eye.tissue[:, ~field].mean() < 0.005
        assert (eye.depth_mm[:, ~field] > 0).mean() < 0.005
    scene = isp.reconstruct(clip, method="fast", iterations=60, device="cpu")
    view = scene.render(t=0.3)
    outside = ~round_field(41)  # a Gaussian of so small a picture is some pixels wide
    assert (view.confidence[outside] >= 0.5).mean() < 0.03
    assert view.unseen[outside].mean() > 0.9
    assert view.unseen[round_field(30)].mean() < 0.2
    whole = isp.reconstruct(read(given), method="fast", iterations=4, fov="all", device="cpu")
    assert whole.report.field_of_view is not None
    assert whole.report.field_of_view.source == "all"
