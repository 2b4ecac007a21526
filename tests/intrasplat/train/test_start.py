"""A model before its first step stands where its points are, and moves as the tracks say or not at all."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.fusion import PointCloud, fuse
from intrasplat.fusion.points import cells_of
from intrasplat.methods.method import Preset
from intrasplat.methods.registry import PRESETS
from intrasplat.motion.keyframes import track_keyframes
from intrasplat.motion.lifted import cell_means
from intrasplat.motion.tracks import moved_along
from intrasplat.notices import NoticeCode
from intrasplat.scene.compact import MAX_WEIGHTS
from intrasplat.splat.layout import ROWS
from intrasplat.splat.model import Model
from intrasplat.train.start import MIN_STRIDE, bounded, fusion_for, resolve_preset, start_model
from intrasplat.train.targets import units_per_mm
from lab.phantom import Phantom, PhantomSettings, make_phantom
from tests.helpers import assert_close
from tests.intrasplat.phantoms import phantom_clip

TIMES = (0.0, 0.31, 11 / 12)


def camera(width: int, height: int) -> Intrinsics:
    return Intrinsics(width=width, height=height, fx=width, fy=width, cx=width / 2, cy=height / 2)


def started(clip: DepthClip, preset: Preset, train: list[int] | None = None) -> tuple[Model, PointCloud, float]:
    frames = train or list(range(clip.frame_count))
    scale = units_per_mm(clip, frames)
    tracks = track_keyframes(clip, frames) if preset.tracks and len(frames) > 1 else []
    preset, _, _ = resolve_preset(preset, tracks, clip, frames)
    moved = {frames[each.reference]: moved_along(each, frames, clip.intrinsics.width) for each in tracks}
    cloud = fuse(clip, frames, fusion_for(preset, clip.intrinsics), seed=0, moved=moved)
    return start_model(cloud, tracks, clip, frames, preset, scale, seed=0), cloud, scale


@pytest.mark.parametrize("size", [(640, 512), (1280, 1024), (333, 777), (64, 48)])
def test_the_grid_of_points_is_the_one_nearest_to_what_was_asked_for(size: tuple[int, int]) -> None:
    preset = PRESETS["fast"]
    assert preset.points_per_image is not None
    stride = fusion_for(preset, camera(*size)).stride
    exact = math.sqrt(size[0] * size[1] / preset.points_per_image)
    others = [other for other in (stride - 1, stride + 1) if other >= MIN_STRIDE]
    assert stride >= MIN_STRIDE
    assert all(abs(stride - exact) <= abs(other - exact) for other in others)


def test_many_gaussians_get_as_many_bases_as_their_scene_can_be_stored_with() -> None:
    preset = dataclasses.replace(PRESETS["fast"], bases=193)
    assert bounded(preset, 80_000) == (preset, ())
    fewer, (notice,) = bounded(preset, 120_000)
    assert fewer.bases is not None
    assert 120_000 * ROWS * fewer.bases <= MAX_WEIGHTS < 120_000 * ROWS * (fewer.bases + 1)
    assert notice.code is NoticeCode.BASES
    assert bounded(PRESETS["paper"], 10**9) == (PRESETS["paper"], ())


def test_the_published_fusion_is_left_as_it_is() -> None:
    assert fusion_for(PRESETS["paper"], camera(640, 512)) == PRESETS["paper"].fusion


@pytest.mark.parametrize("name", PRESETS)
def test_without_tracks_the_model_is_at_rest_on_its_points(name: str) -> None:
    preset = dataclasses.replace(PRESETS[name], tracks=False)
    model, cloud, scale = started(phantom_clip(), preset)
    assert model.count == len(cloud.points_mm)
    for t in TIMES:
        assert_close(model.deformed_mean(t).T, cloud.points_mm * scale, relative=1e-5, name=f"means at {t}")


@pytest.mark.parametrize("name", ["fast", "paper"])
def test_gaussians_start_as_the_preset_says(name: str) -> None:
    preset = PRESETS[name]
    gaussians, _ = started(phantom_clip(), preset)[0].export()
    assert gaussians.sh_degree == preset.sh_degree
    assert gaussians.opacity_logit.sigmoid().median().item() == pytest.approx(preset.opacity, rel=1e-4)
    wider, _ = started(phantom_clip(), dataclasses.replace(preset, spread=2 * preset.spread))[0].export()
    assert_close(wider.log_scale - gaussians.log_scale, np.full(gaussians.log_scale.shape, math.log(2)))


def test_with_tracks_each_gaussian_passes_through_its_point_at_the_time_it_was_seen() -> None:
    clip = phantom_clip()
    model, cloud, scale = started(clip, PRESETS["fast"])
    moved = np.zeros(model.count)
    for index in np.unique(cloud.frame):
        chosen = cloud.frame == index
        placed = model.deformed_mean(float(clip.t[index])).T
        # bases below a thousandth are left out of a step
        assert_close(placed[chosen], cloud.points_mm[chosen] * scale, relative=1e-4, name=f"points of frame {index}")
        moved = np.maximum(moved, np.linalg.norm(placed - model.deformed_mean(0.0).T, axis=1))
    assert len(np.unique(cloud.frame)) > 1
    assert np.linalg.norm(model.deformed_mean(0.4) - model.deformed_mean(0.0), axis=0).mean() / scale > 0.2  # mm


def test_what_the_instrument_hides_at_first_moves_like_the_tissue_about_it() -> None:
    clip = phantom_clip()
    model, cloud, _ = started(clip, PRESETS["fast"])
    k, (x, y, z) = clip.intrinsics, cloud.reference_mm.T
    in_view = (abs(k.fx * x / z) < k.width / 2) & (abs(k.fy * y / z) < k.height / 2)
    later = (cloud.frame > 0) & in_view
    at_first, at_end = (model.deformed_mean(t).T for t in (0.0, float(clip.t[-1])))
    moved = at_end - at_first
    seen = cloud.frame == 0
    nearest = np.linalg.norm(at_first[later][:, None] - at_first[seen][None], axis=-1).argmin(axis=1)
    apart = np.linalg.norm(moved[later] - moved[seen][nearest], axis=1)
    assert later.sum() > 20
    assert np.median(np.linalg.norm(moved[seen][nearest], axis=1)) > 1
    assert np.median(apart) < 0.3 * np.median(np.linalg.norm(moved[later], axis=1))


@dataclasses.dataclass(frozen=True)
class Pan:
    """A phantom whose camera pans, its clip, and a model before its first step on it."""

    phantom: Phantom
    clip: DepthClip
    model: Model
    cloud: PointCloud
    units_per_mm: float


@pytest.fixture(scope="module")
def pan() -> Pan:
    phantom = make_phantom(PhantomSettings(160, 128, 40, camera=("pan",)))
    clip = phantom.depth_clip()
    return Pan(phantom, clip, *started(clip, PRESETS["fast"]))


def test_tissue_that_comes_into_view_later_starts_with_its_own_motion(pan: Pan) -> None:
    phantom, clip, cloud = pan.phantom, pan.clip, pan.cloud
    later = np.flatnonzero(cloud.frame > 20)
    assert len(later) > 0.3 * len(cloud)
    nearest, off_mm = np.zeros(len(later), np.intp), np.zeros((len(later), 3))
    for frame in np.unique(cloud.frame[later]):
        there = cloud.frame[later] == frame
        points_mm, vertices_mm = cloud.points_mm[later[there]], phantom.surface.vertices_mm(frame)
        nearest[there] = cKDTree(vertices_mm).query(points_mm)[1]
        off_mm[there] = points_mm - vertices_mm[nearest[there]]
    k, errors_mm, moved_mm = clip.intrinsics, [], []
    for frame in range(0, 40, 4):
        true_mm = phantom.surface.vertices_mm(frame)[nearest] + off_mm
        seen = cells_of(true_mm, k, clip.world_from_camera[frame], stride=1)[1]
        shown_mm = pan.model.deformed_mean(float(clip.t[frame])).T[later] / pan.units_per_mm
        errors_mm.append(np.linalg.norm(shown_mm - true_mm, axis=1)[seen])
        moved_mm.append(np.linalg.norm(cloud.points_mm[later] - true_mm, axis=1)[seen])
    assert np.median(np.concatenate(moved_mm)) > 1
    assert np.median(np.concatenate(errors_mm)) < 0.5 * np.median(np.concatenate(moved_mm))


def test_points_cover_what_every_frame_of_a_pan_shows(pan: Pan) -> None:
    clip = pan.clip
    for frame in range(0, 40, 3):
        shown_mm = pan.model.deformed_mean(float(clip.t[frame])).T / pan.units_per_mm
        cells, _ = cells_of(shown_mm, clip.intrinsics, clip.world_from_camera[frame], stride=4)
        tissue = cell_means(clip.tissue[frame].astype(np.float32), 4).ravel() == 1
        assert np.isin(np.flatnonzero(tissue), cells).mean() > 0.98


def test_gaussians_start_as_wide_as_their_neighbours_of_the_first_frame_are_apart() -> None:
    clip = phantom_clip()
    model, cloud, scale = started(clip, PRESETS["fast"])
    width_mm = model.export()[0].log_scale.exp().numpy()[:, 0] / PRESETS["fast"].spread / scale
    apart_mm = np.linalg.norm(cloud.reference_mm[:, None] - cloud.reference_mm[None], axis=-1)
    nearest_mm = np.sqrt((np.sort(apart_mm, axis=1)[:, 1:4] ** 2).mean(axis=1))
    assert (cloud.frame > 0).sum() > 50
    np.testing.assert_allclose(width_mm, nearest_mm, rtol=1e-3)


@pytest.mark.parametrize("frames", [1, 2, 4, 12])
def test_a_short_clip_has_no_more_bases_than_frames(frames: int) -> None:
    model, _, _ = started(phantom_clip(frames=frames), PRESETS["fast"])
    _, deformation = model.export()
    assert 1 <= deformation.bases <= frames


def test_a_deformation_without_bases_has_zero() -> None:
    assert started(phantom_clip(), PRESETS["paper"])[0].export()[1].bases == PRESETS["paper"].bases
    assert started(phantom_clip(), PRESETS["hexplane"])[0].export()[1].bases == 0
