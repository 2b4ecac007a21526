"""A follower of a small synthetic feed: what it shows, of now and of the past, and what it bears."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from intrasplat.clip.types import RgbFrame
from intrasplat.errors import InputError
from intrasplat.live.eyes import EyesSettings
from intrasplat.live.follow import Added, Follower, FollowSettings
from intrasplat.live.pair import FeedPair
from intrasplat.live.past_segment import PastSegment
from intrasplat.live.window import MAX_COLOUR
from intrasplat.names import SCENE
from intrasplat.scene.scene import TrainedScene, check
from intrasplat.splat.layout import COLOUR, LOG_SCALE, MEAN
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.view.render import render_frame
from lab.phantom import CameraPath, Motion, Phantom, PhantomSettings, make_phantom

WIDTH, HEIGHT, FPS = 128, 96, 5.0
SETTINGS = FollowSettings(EyesSettings(finds_instruments=False), segment_frames=3, points=3000, steps=8)


@cache
def _phantom(motion: Motion, camera: tuple[CameraPath, ...] = (), seed: int = 0) -> Phantom:
    settings = PhantomSettings(
        WIDTH, HEIGHT, 24, motion, seed, tools=(), camera=camera, period_frames=24, frame_rate_hz=FPS
    )
    return make_phantom(settings)


@cache
def _drawn(settings: PhantomSettings, index: int) -> tuple[RgbFrame, RgbFrame]:
    frame = _phantom(settings.motion, settings.camera, settings.seed).frame(index)
    return frame.left, frame.right


def _eyes(phantom: Phantom, index: int) -> tuple[RgbFrame, RgbFrame]:
    return _drawn(phantom.settings, index)


def _pair(phantom: Phantom, number: int, index: int | None = None) -> FeedPair:
    """Pair `number` of a feed, by default frame `number` of the phantom."""
    return FeedPair(*_eyes(phantom, number if index is None else index), number / FPS, 1e9 + number / FPS, number)


def _following(phantom: Phantom, pairs: int, settings: FollowSettings = SETTINGS) -> Follower:
    follower = Follower(phantom.settings.calibration, settings)
    for number in range(pairs):
        assert follower.add(_pair(phantom, number)) is (Added.FOLLOWED if number else Added.FIRST)
    return follower


def _psnr_db(shown: tuple[TrainedScene, float] | None, picture: RgbFrame) -> float:
    assert shown is not None
    rgb = render_frame(*shown, detail="off").rgb
    return psnr_tissue(rgb, picture, np.ones(rgb.shape[:2], np.bool_))


def test_it_shows_the_newest_moment_better_than_the_first_one_did() -> None:
    phantom = _phantom("breathing")
    follower = Follower(phantom.settings.calibration, SETTINGS)
    follower.add(_pair(phantom, 0))
    frozen = follower.scene_at()
    for number in range(1, 7):
        follower.add(_pair(phantom, number))
    last = _eyes(phantom, 6)[0]
    assert _psnr_db(follower.scene_at(), last) > _psnr_db(frozen, last) + 4
    assert follower.newest is not None
    assert follower.newest.arrived_at == 1e9 + 6 / FPS


def test_a_second_of_the_past_is_shown_as_it_was() -> None:
    phantom = _phantom("breathing")
    follower = _following(phantom, 12)
    assert len(follower.segments) == 2  # of frames 0 to 3 and 3 to 6
    for number in (1, 5, 9):
        own, other = (_psnr_db(follower.scene_at(number / FPS), _eyes(phantom, each)[0]) for each in (number, 11))
        assert own > 24
        assert own > other + 2
    scene, t = follower.scene_at(-5.0) or pytest.fail("there is a past")
    assert scene is follower.segments[0]
    assert t == 0.0


def test_a_stored_segment_has_half_the_bytes_and_the_same_views(tmp_path: Path) -> None:
    phantom, segments = _phantom("pull"), list[TrainedScene]()
    follower = Follower(phantom.settings.calibration, SETTINGS, on_segment=segments.append)
    for number in range(7):
        follower.add(_pair(phantom, number))
    stored = PastSegment.of(0, segments[0]).written(tmp_path, segments[0])
    assert stored.path is not None
    assert (stored.path / SCENE).stat().st_size < 0.6 * segments[0].byte_count
    for number in range(3):
        shown = (
            psnr_tissue(
                render_frame(each, (number + 0.5) / 4, detail="off").rgb,
                _eyes(phantom, number)[0],
                np.ones((HEIGHT, WIDTH), np.bool_),
            )
            for each in (segments[0], stored.load())
        )
        assert abs(next(shown) - next(shown)) < 0.05


def test_what_a_segment_gives_up_changes_no_other_frame_and_leaves_small_weights() -> None:
    window = _following(_phantom("pull"), 6)._window
    assert window is not None
    assert window.is_full
    window.weights()[:, MEAN] += 100.0  # as after long motion
    window.model.parameters()["canonical"][MEAN] -= 100.0
    before = [np.array(window.model.deformed_mean(slot)) for slot in range(3, 6)]
    window.give_up()
    for slot, mean in enumerate(before):
        assert np.allclose(window.model.deformed_mean(slot), mean, atol=2e-3)
    assert float(window.weights()[:3].mean(0).abs().max()) < 1e-3


def test_sizes_and_colours_do_not_run_away() -> None:
    window = _following(_phantom("still"), 2)._window
    assert window is not None
    canonical = window.model.parameters()["canonical"]
    usual = float(canonical[LOG_SCALE].median())
    canonical[LOG_SCALE][0, ::4] -= 6.0
    canonical[COLOUR, :9] = torch.tensor([9.0, -9.0, 1.0]).repeat(3)
    for _ in range(150):
        if window.is_full:
            window.give_up()
        window.append(window.newest)
    state = canonical + window.weights()[window.slot]
    assert float((state[LOG_SCALE] - usual).abs().max()) < 0.5
    assert torch.allclose(state[COLOUR, :9], torch.tensor([MAX_COLOUR, -MAX_COLOUR, 1.0]).repeat(3), atol=0.2)


def test_a_segment_does_not_change_and_can_be_stored() -> None:
    phantom, segments = _phantom("breathing"), list[TrainedScene]()
    follower = Follower(phantom.settings.calibration, SETTINGS, on_segment=segments.append)
    for number in range(7):
        follower.add(_pair(phantom, number))
    check(segments[0])
    pictures = len(segments[0].frame_times_s) * 2 * 4 * HEIGHT * WIDTH  # of both eyes: R G B, and where tissue is
    assert PastSegment.of(0, segments[0]).bytes == segments[0].byte_count + pictures
    before = render_frame(segments[0], 0.25).rgb
    for number in range(7, 13):
        follower.add(_pair(phantom, number))
    assert len(segments) == 3
    assert np.array_equal(render_frame(segments[0], 0.25).rgb, before)
    assert np.allclose(segments[0].frame_times_s, np.arange(4) / FPS)


def test_the_same_pairs_and_steps_give_the_same_bits() -> None:
    scenes = [_following(_phantom("breathing"), 8).scene_at() for _ in range(2)]
    first, second = (scene.tensors() for scene, _ in filter(None, scenes))
    assert all(bool((first[name] == second[name]).all()) for name in first)


def test_a_pair_may_be_read_while_the_one_before_is_learnt() -> None:
    phantom = _phantom("breathing")
    pairs = [_pair(phantom, number) for number in range(11)]  # more than two segments, which change the range
    plain, ahead = (Follower(phantom.settings.calibration, SETTINGS) for _ in range(2))
    unused = _pair(phantom, 12)
    for number, pair in enumerate(pairs):
        plain.add(pair)
        ahead.add(pair, coming=iter([unused if number in (1, 10) else pairs[number + 1]]).__next__)
    found, expected = (each.scene_at() or pytest.fail("there is a scene") for each in (ahead, plain))
    assert found[0].frame_times_s[-1] == pairs[-1].source_s
    tensors = expected[0].tensors()
    assert all(bool((each == tensors[name]).all()) for name, each in found[0].tensors().items())


def test_the_past_and_the_model_are_bounded() -> None:
    phantom = _phantom("breathing", ("pan",))
    follower = Follower(phantom.settings.calibration, replace(SETTINGS, steps=2, keep_s=3.0))
    counts, moments = set[int](), 0
    for number in range(60):
        follower.add(_pair(phantom, number, min(number % 46, 46 - number % 46) // 2))
        scene, _ = follower.scene_at() or pytest.fail("there is a scene")
        counts.add(len(scene.gaussians))
        moments = max(moments, scene.frame_count)
    assert len(counts) == 1
    assert moments == 2 * SETTINGS.segment_frames
    assert follower.segments[0].frame_times_s[-1] >= 59 / FPS - 3.0 - 2 * SETTINGS.segment_frames / FPS


def test_tissue_that_comes_into_view_gets_gaussians() -> None:
    phantom = _phantom("still", ("pan",))
    follower = _following(phantom, 14)  # by half of the view
    assert _psnr_db(follower.scene_at(), _eyes(phantom, 13)[0]) > 22


def test_a_moving_camera_is_placed_and_found_again() -> None:
    phantom = _phantom("still", ("pan",))
    follower = Follower(phantom.settings.calibration, replace(SETTINGS, camera="moving"))

    def off_mm(number: int, index: int) -> float:
        assert follower.add(_pair(phantom, number, index)) in (Added.FIRST, Added.FOLLOWED)
        assert follower.newest is not None
        found = follower.newest.clip.world_from_camera[0]
        return float(np.linalg.norm((found - phantom.world_from_camera(index))[:3, 3]))

    assert max(off_mm(index, index) for index in range(8)) < 1.0
    covered = replace(_pair(phantom, 8), left=_noise(0), right=_noise(1))
    assert follower.add(covered) in (Added.LOST, Added.NO_SCENE)
    assert off_mm(9, 2) < 1.0  # it has jumped meanwhile


def _noise(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


@pytest.mark.parametrize("level", [0, 255])
def test_an_empty_pair_is_not_used(level: int) -> None:
    phantom = _phantom("breathing")
    plain = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    empty = replace(_pair(phantom, 3), left=plain, right=plain)
    unbegun = Follower(phantom.settings.calibration, SETTINGS)
    assert unbegun.add(replace(empty, sequence=0)) is Added.NO_SCENE
    assert unbegun.scene_at() is None
    follower = _following(phantom, 3)
    used = follower.used
    assert follower.add(empty) is Added.NO_SCENE
    assert follower.used == used
    assert follower.add(_pair(phantom, 4)) is Added.FOLLOWED
    assert _psnr_db(follower.scene_at(), _eyes(phantom, 4)[0]) > 24


def test_a_feed_that_shows_something_else_begins_anew() -> None:
    phantom, other = _phantom("breathing"), _phantom("still", seed=5)
    follower = _following(phantom, 4)
    became = [follower.add(_pair(other, number, 0)) for number in range(4, 7)]
    assert _psnr_db(follower.scene_at(), _eyes(other, 0)[0]) > 24, became
    assert _psnr_db(follower.scene_at(2 / FPS), _eyes(phantom, 2)[0]) > 24  # the past is kept


def test_a_model_that_diverged_begins_anew() -> None:
    phantom = _phantom("breathing")
    follower = _following(phantom, 3)
    assert follower._window is not None
    follower._window.model.parameters()["canonical"][:] = float("nan")
    assert follower.add(_pair(phantom, 3)) is Added.RESTARTED
    assert _psnr_db(follower.scene_at(), _eyes(phantom, 3)[0]) > 24


def test_a_picture_of_another_size_is_refused() -> None:
    phantom = _phantom("breathing")
    follower = _following(phantom, 2)
    small = replace(_pair(phantom, 2), left=np.zeros((48, 64, 3), np.uint8), right=np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(InputError, match="64x48"):
        follower.add(small)


def test_a_smaller_model_follows_larger_pictures() -> None:
    phantom = _phantom("breathing")
    follower = _following(phantom, 3, replace(SETTINGS, eyes=replace(SETTINGS.eyes, width=96)))
    scene, _ = follower.scene_at() or pytest.fail("there is a scene")
    assert (scene.intrinsics.width, scene.intrinsics.height) == (96, 72)


def test_what_the_pictures_show_is_trusted_and_what_lies_beside_them_is_not() -> None:
    phantom = _phantom("breathing")
    follower = _following(phantom, 8)
    for scene, t in (follower.scene_at() or pytest.fail("no scene"), (follower.segments[0], 0.25)):
        view = render_frame(scene, t)
        solid = view.depth_mm > 0
        assert view.unseen_share < 0.1
        assert np.median(view.confidence[solid]) > 0.2
        assert not {"unseen", "hardly_seen"} & {each.code for each in view.warnings}
        aside = render_frame(scene, t, view_beside(scene))
        assert np.median(aside.confidence) < np.median(view.confidence[solid])


def view_beside(scene: TrainedScene) -> NDArray[np.float64]:
    """A pose far to the side of the endoscope's."""
    pose = scene.world_from_camera[0].copy()
    pose[0, 3] += 40.0
    return pose


def test_a_calibration_of_squeezed_pictures_fits_by_the_pixels_aspect() -> None:
    phantom = _phantom("breathing")
    pair = replace(_pair(phantom, 0), left=_squeezed(phantom, 0), right=_squeezed(phantom, 1))
    with pytest.raises(InputError, match="not one uniform scale"):
        Follower(phantom.settings.calibration, SETTINGS).add(pair)
    assert Follower(phantom.settings.calibration, SETTINGS).add(replace(pair, pixel_aspect=4 / 3)) is Added.FIRST


def _squeezed(phantom: Phantom, eye: int) -> RgbFrame:
    """The first frame of an eye with 3 columns for 4."""
    return np.asarray(cv2.resize(_eyes(phantom, 0)[eye], (WIDTH * 3 // 4, HEIGHT)), np.uint8)


def test_a_view_between_frames_is_trusted_less_the_more_the_tissue_moves() -> None:
    at_rest, moving = (_following(_phantom(motion), 8).segments[0] for motion in ("still", "pull"))
    assert 0 <= at_rest.motion_error < moving.motion_error
    for scene in (at_rest, moving):
        at_frame, between = (np.median(render_frame(scene, place / 4).confidence) for place in (1, 1.5))
        assert between < at_frame
