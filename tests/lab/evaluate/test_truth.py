"""The truth scores itself as perfect, and a model by how far it is from it."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.gaussians import initial_gaussians
from intrasplat.splat.metrics import BEST_PSNR_DB
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from lab.evaluate.truth import MOVING_MM, SceneCandidate, ShownView, Truth
from lab.phantom import Phantom, PhantomSettings, make_phantom

FRAMES = 12
HELD_OUT = [1, 5, 9]
TRAIN = [frame for frame in range(FRAMES) if frame not in HELD_OUT]


class PhantomShown:
    """The phantom in place of a model of it."""

    def __init__(self, phantom: Phantom) -> None:
        self._phantom = phantom

    def view(self, frame: int, pose: NDArray[np.float64]) -> ShownView:
        rgb, depth_mm = self._phantom.render(frame, pose)
        return ShownView(rgb, depth_mm, (depth_mm > 0).astype(np.float32))

    def motion_mm(self, frame: int) -> NDArray[np.floating]:
        tracks = self._phantom.trajectories(stride_px=1)
        camera = self._phantom.settings.intrinsics
        moved = np.full((camera.height, camera.width, 3), np.nan)
        moved[tuple(tracks.pixels.T)] = tracks.points_mm[frame] - tracks.points_mm[0]
        return moved


class BakedPhantom(PhantomShown):
    """The phantom with its highlights where the endoscope sees them, whoever looks."""

    def view(self, frame: int, pose: NDArray[np.float64]) -> ShownView:
        eye_mm = self._phantom.world_from_camera(frame)[:3, 3]
        rgb, depth_mm = self._phantom.render(frame, pose, eye_mm=eye_mm)
        return ShownView(rgb, depth_mm, (depth_mm > 0).astype(np.float32))


@cache
def made() -> tuple[Phantom, DepthClip, Truth]:
    phantom = make_phantom(PhantomSettings(width=96, height=80, frames=FRAMES, motion="pull", period_frames=12.0))
    clip = phantom.depth_clip()
    return phantom, clip, Truth(phantom, clip.tissue, TRAIN, HELD_OUT)


def painted_scene(phantom: Phantom, clip: DepthClip, follows: bool) -> TrainedScene:
    """A Gaussian a pixel of frame 0, in its colour, which follows the truth as well as its bases can, or stays."""
    tracks = phantom.trajectories(stride_px=1)
    scale = MEDIAN_DEPTH_UNITS / float(np.median(clip.depth_mm[0]))
    rgb, _ = phantom.render(0)
    start = torch.from_numpy((tracks.points_mm[0] * scale).astype(np.float32))
    gaussians = initial_gaussians(start.numpy(), rgb[tuple(tracks.pixels.T)], sh_degree=0, opacity=0.95)
    gaussians = dataclasses.replace(gaussians, log_scale=gaussians.log_scale - 0.5)
    motion = SharedBasis.initial(len(gaussians), bases=FRAMES, times=[float(t) for t in clip.t])
    if follows:
        basis = np.stack([motion.basis(float(t)).numpy() for t in clip.t]).astype(np.float64)
        moved = (tracks.points_mm - tracks.points_mm[0]) * scale
        weights = np.linalg.lstsq(basis, moved.reshape(FRAMES, -1), rcond=None)[0].reshape(FRAMES, -1, 3)
        motion.weight[:, :3] = torch.from_numpy(weights.transpose(1, 2, 0).astype(np.float32))
    return TrainedScene(
        gaussians, motion, clip.intrinsics, clip.world_from_camera, clip.frame_times_s, scale, "fast",
        tuple(float(clip.t[frame]) for frame in TRAIN), torch.zeros(len(gaussians)),
    )  # fmt: skip


def test_the_truth_scores_itself_as_perfect() -> None:
    phantom, _, truth = made()
    scores = truth.score(PhantomShown(phantom))
    assert (scores.psnr_view10_db, scores.psnr_view15_db, scores.psnr_hidden_db) == (BEST_PSNR_DB,) * 3
    assert scores.depth_error_mm == 0
    assert (scores.psnr_baked10_db, scores.psnr_baked15_db) == (scores.bound10_db, scores.bound15_db)
    assert scores.motion_error_mm == scores.moving_error_mm == pytest.approx(0, abs=1e-9)
    assert scores.moving_mm > MOVING_MM
    assert (scores.empty_ok, scores.seen_ok) == (1.0, 1.0)


class FinnedPhantom(PhantomShown):
    """The phantom with a fin before the left half, a hole in the lower half, and a confidence that knows of both."""

    def view(self, frame: int, pose: NDArray[np.float64]) -> ShownView:
        shown = super().view(frame, pose)
        rgb, depth_mm, confidence = shown.rgb.copy(), shown.depth_mm.copy(), shown.confidence.copy()
        height, width = depth_mm.shape
        depth_mm[:, : width // 2] *= 0.9
        depth_mm[height // 2 :] = 0
        rgb[:, : width // 2] = 0
        confidence[:, : width // 2] = 0.4
        confidence[height // 2 :] = 0.1
        return ShownView(rgb, depth_mm, confidence)


def test_a_fin_hangs_in_empty_space_and_a_hole_misses_what_was_seen() -> None:
    phantom, _, truth = made()
    scores = truth.score(FinnedPhantom(phantom))
    assert scores.empty_ok == pytest.approx(0.75, abs=0.01), "a hole is empty: the upper left quarter alone hangs"
    assert scores.seen_ok == pytest.approx(0.5, abs=0.05)


def test_what_a_render_marks_as_unseen_is_not_solid() -> None:
    phantom, clip, truth = made()
    scene = painted_scene(phantom, clip, follows=True)
    left = torch.from_numpy(phantom.trajectories(stride_px=1).pixels[:, 1] < 48)
    half_seen = dataclasses.replace(scene, seen=left.float())
    assert truth.score(SceneCandidate(scene)).seen_ok > 0.9
    assert truth.score(SceneCandidate(half_seen)).seen_ok == pytest.approx(0.5, abs=0.1)


def test_a_confidence_that_knows_where_the_model_errs_ranks_the_errors() -> None:
    phantom, _, truth = made()
    scores = truth.score(FinnedPhantom(phantom))
    assert min(scores.rank_depth, scores.rank_right_depth) > 0.98
    assert 0.2 < scores.rank_colour < 0.9, "the hole's right half shows the right colours"
    perfect = truth.score(PhantomShown(phantom))
    assert np.isnan(perfect.rank_depth), "there is nothing to rank"


def test_the_right_eye_of_a_stereo_clip_shows_what_the_left_eye_does_not() -> None:
    phantom, clip, _ = made()
    blind = np.zeros_like(clip.tissue)
    blind[0, :, :48] = True
    nothing = np.zeros_like(clip.tissue)
    one, both = (Truth(phantom, blind, [0], HELD_OUT, right) for right in (nothing, ~nothing))
    judged = [sum(int(view.judged.sum()) for view in truth._views[10.0]) for truth in (one, both)]
    assert judged[1] > 1.5 * judged[0] > 0


def test_highlights_alone_keep_a_perfect_shape_below_perfection() -> None:
    phantom, _, truth = made()
    scores = truth.score(BakedPhantom(phantom))
    assert (scores.psnr_view10_db, scores.psnr_view15_db) == (scores.bound10_db, scores.bound15_db)
    assert (scores.psnr_baked10_db, scores.psnr_baked15_db) == (BEST_PSNR_DB, BEST_PSNR_DB)
    assert 20 < scores.bound15_db < scores.bound10_db < 40


def test_a_model_that_follows_the_truth_has_hardly_an_error_of_motion() -> None:
    phantom, clip, truth = made()
    scores = truth.score(SceneCandidate(painted_scene(phantom, clip, follows=True)))
    assert scores.moving_error_mm < 0.1 * scores.moving_mm
    assert scores.motion_error_mm < 0.1
    assert scores.depth_error_mm < 1.0, "a pixel is as wide"


def test_a_model_that_stays_errs_by_the_motion_itself() -> None:
    phantom, clip, truth = made()
    scores = truth.score(SceneCandidate(painted_scene(phantom, clip, follows=False)))
    assert scores.moving_error_mm == pytest.approx(scores.moving_mm)
    assert scores.psnr_view10_db < BEST_PSNR_DB


def test_only_what_a_training_frame_showed_is_judged() -> None:
    phantom, clip, _ = made()
    blind = np.zeros_like(clip.tissue)
    blind[0] = True  # else there is no depth to turn about
    hidden = Truth(phantom, blind, [0], HELD_OUT).score(PhantomShown(phantom))
    assert hidden.psnr_view10_db == BEST_PSNR_DB
    blind[0, :, 48:] = False
    half = Truth(phantom, blind, [0], HELD_OUT)
    assert (
        0
        < sum(view.judged.sum() for view in half._views[10.0])
        < sum(view.judged.sum() for view in Truth(phantom, clip.tissue, TRAIN, HELD_OUT)._views[10.0])
    )


def test_the_same_material_point_has_the_same_place_on_the_atlas_wherever_it_is_seen_from() -> None:
    phantom, _, _ = made()
    tracks = phantom.trajectories(stride_px=8)
    first = phantom.surface_pixels(0).atlas_xy[tuple(tracks.pixels.T)]
    camera, frame = phantom.settings.intrinsics, 5
    x, y, z = tracks.points_mm[frame].T
    column = np.floor(camera.fx * x / z + camera.cx).astype(int)
    row = np.floor(camera.fy * y / z + camera.cy).astype(int)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    later = phantom.surface_pixels(frame).atlas_xy[row[inside], column[inside]]
    apart = np.linalg.norm(later - first[inside], axis=1)
    assert np.median(apart) < 1.5, "texels; a pixel is about one and a quarter"
