"""Fusion: what is published, what each hidden pixel gets, and what no mode may read."""

from __future__ import annotations

import dataclasses
import sys
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import unproject
from intrasplat.clip.types import DepthClip
from intrasplat.errors import InputError
from intrasplat.fusion import COMPLETED_CONFIDENCE, FusionSettings, PointCloud, fuse, motion_mask
from intrasplat.fusion.fill import MARGIN, fill
from intrasplat.motion.tracks import Moved
from intrasplat.report import Masks
from tests.intrasplat.clips import HEIGHT, WIDTH, plane_clip

TRAIN = [0, 2, 3, 4, 5, 6, 7, 8, 10, 11]
HELD_OUT = [1, 9]
MODES = [FusionSettings(mode="paper"), FusionSettings(mode="reference_only"), FusionSettings(mode="fill", stride=2)]


def pixels_of(clip: DepthClip, cloud: PointCloud, frame: int = 0) -> NDArray[np.floating]:
    """[N, 2] row and column, real, at which a frame sees the cloud."""
    pose = clip.world_from_camera[frame]
    x, y, z = ((cloud.points_mm - pose[:3, 3]) @ pose[:3, :3]).T
    camera = clip.intrinsics
    return np.stack([camera.fy * y / z + camera.cy, camera.fx * x / z + camera.cx], axis=1)


def same_bits(first: PointCloud, second: PointCloud) -> bool:
    return all(
        np.array_equal(getattr(first, name.name), getattr(second, name.name)) for name in dataclasses.fields(first)
    )


@pytest.mark.parametrize("settings", MODES, ids=lambda settings: settings.mode)
def test_held_out_frames_change_no_bit(settings: FusionSettings) -> None:
    clip = plane_clip()
    poisoned = plane_clip()
    random = np.random.default_rng(7)
    for index in HELD_OUT:
        poisoned.rgb[index] = random.integers(0, 256, poisoned.rgb[index].shape)
        poisoned.depth_mm[index] = np.nan
        poisoned.tissue[index] = random.random(poisoned.tissue[index].shape) > 0.5
        poisoned.depth_confidence[index] = 0
        poisoned.world_from_camera[index] = np.nan
    assert same_bits(fuse(clip, TRAIN, settings, seed=3), fuse(poisoned, TRAIN, settings, seed=3))


@pytest.mark.parametrize("settings", MODES, ids=lambda settings: settings.mode)
@pytest.mark.parametrize("step_mm", [0.0, 0.5])
def test_every_point_lies_on_the_surface_with_the_colour_of_its_pixel(settings: FusionSettings, step_mm: float) -> None:
    clip = plane_clip(step_mm=step_mm)
    cloud = fuse(clip, TRAIN, settings, seed=0)
    x, y, z = cloud.points_mm.T
    np.testing.assert_allclose(z, 60 + 0.2 * x + 0.1 * y, atol=1e-3)
    for index in np.unique(cloud.frame):
        assert index in TRAIN
        own = cloud.frame == index
        rows, columns = np.floor(pixels_of(clip, cloud, index)[own]).astype(int).T
        assert clip.tissue[index, rows, columns].all()
        np.testing.assert_allclose(cloud.rgb[own], clip.rgb[index, rows, columns] / 255, atol=1e-6)


def test_the_published_cloud_is_a_tenth_of_the_first_frame_and_a_hundredth_of_what_moves_or_was_hidden() -> None:
    clip = plane_clip()
    cloud = fuse(clip, TRAIN, FusionSettings(mode="paper"), seed=0)
    moving = motion_mask(clip, TRAIN, 95.0)
    first = int(clip.tissue[0].sum())
    later = sum(round(0.1 * int((clip.tissue[index] & moving).sum())) for index in TRAIN[1:])
    assert len(cloud) == round(0.1 * (first + later))
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    assert moving[rows, columns][cloud.frame > 0].all()


def test_with_a_moving_camera_the_published_fusion_projects_into_the_first_frame() -> None:
    clip = plane_clip(step_mm=1.0)
    cloud = fuse(clip, TRAIN, FusionSettings(mode="paper", frame_share=1.0, total_share=1.0), seed=0)
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    inside = (rows >= 0) & (rows < HEIGHT) & (columns >= 0) & (columns < WIDTH)
    later = cloud.frame > 0
    assert inside[later].all()
    # All but those that float32 points carry over a pixel's border.
    assert motion_mask(clip, TRAIN, 95.0)[rows[later], columns[later]].mean() > 0.98
    assert later.sum() > 1000


def test_a_pose_that_hardly_differs_chooses_the_same_pixels_as_the_same_pose() -> None:
    # The same pose takes a short cut; the general way has to agree with it.
    clip = plane_clip()
    nudged = plane_clip()
    nudged.world_from_camera[1:, 2, 3] = 1e-9
    settings = FusionSettings(mode="paper", frame_share=1.0)
    fast, general = fuse(clip, TRAIN, settings, seed=1), fuse(nudged, TRAIN, settings, seed=1)
    np.testing.assert_allclose(fast.points_mm, general.points_mm, atol=1e-5)
    assert np.array_equal(fast.frame, general.frame)


def test_tau_is_a_percentile_of_the_nonzero_differences_on_tissue_and_hidden_pixels_always_count() -> None:
    clip = plane_clip()
    mask = motion_mask(clip, TRAIN, 90.0)
    tissue = clip.tissue[0]
    assert mask[~tissue].all()
    difference = np.abs(clip.rgb[0].mean(2) - clip.rgb[TRAIN].astype(float).mean(axis=(0, 3)))
    moved = tissue & (difference > 1e-6)
    assert 0.05 < mask[moved].mean() < 0.11
    assert not mask[tissue & ~moved].any()


def test_a_clip_that_does_not_change_has_no_motion() -> None:
    clip = plane_clip()
    still = dataclasses.replace(clip, rgb=np.repeat(clip.rgb[:1], clip.frame_count, axis=0))
    assert np.array_equal(motion_mask(still, TRAIN, 95.0), ~clip.tissue[0])


def test_filling_covers_every_tissue_cell_once_and_nothing_else() -> None:
    clip = plane_clip()
    clip.tissue[:, :6, :6] = False  # a burnt-in label
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0)
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    hits = np.zeros((HEIGHT, WIDTH), int)
    np.add.at(hits, (rows, columns), 1)
    assert np.array_equal(hits == 1, clip.tissue[TRAIN].any(axis=0))
    assert hits.max() == 1
    assert np.array_equal(cloud.frame[clip.tissue[0, rows, columns]], np.zeros(int(clip.tissue[0].sum())))


def test_hidden_cells_are_filled_by_the_first_frame_that_sees_them_away_from_the_instrument() -> None:
    clip = plane_clip()
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0)
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    # Columns 4..15 are hidden in frame 0; the tool's left edge is at 4 + 4 i, and 5 pixels from it are unsure.
    at_8 = cloud.frame[(columns == 8) & (rows == 20)]
    assert at_8 == [3]  # frame 2 sees it 4 pixels from the tool, frame 3 sees it 8 pixels away


def test_where_depth_is_confident_later_it_is_taken_from_there() -> None:
    clip = plane_clip()
    clip.depth_confidence[:8] = 20
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0)
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    assert cloud.frame[(columns == 8) & (rows == 20)] == [8]


def test_a_moving_camera_fills_what_its_first_view_did_not_reach_without_doubling_the_rest() -> None:
    clip = plane_clip(step_mm=2.0)
    clip.tissue[:] = True
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=2), seed=0)
    right = pixels_of(clip, cloud, 11)[:, 1]
    assert right.max() > WIDTH - 4  # the last view is covered to its right border
    seen_by_first = pixels_of(clip, cloud)[:, 1] < WIDTH - 4
    assert (cloud.frame[seen_by_first] == 0).mean() > 0.95


def test_tissue_without_depth_is_modelled_on_the_surface_around_it_with_low_confidence() -> None:
    clip = plane_clip()
    clip.depth_mm[:, 34:44, 20:40] = 0
    clip.depth_confidence[:, 34:44, 20:40] = 0
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0)
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    hole = (rows >= 34) & (rows < 44) & (columns >= 20) & (columns < 40)
    assert hole.sum() == 200
    assert np.array_equal(cloud.confidence == np.float32(COMPLETED_CONFIDENCE), hole)
    x, y, z = cloud.points_mm.T
    np.testing.assert_allclose(z, 60 + 0.2 * x + 0.1 * y, atol=0.1)


def test_tissue_first_seen_later_and_never_measured_is_modelled_too() -> None:
    clip = plane_clip()
    clip.depth_mm[:, 12:20, 6:12] = 0  # hidden by the tool in frame 0
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0)
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    hole = (rows >= 12) & (rows < 20) & (columns >= 6) & (columns < 12)
    assert hole.sum() == 48
    assert np.allclose(cloud.confidence[hole], COMPLETED_CONFIDENCE)


@pytest.mark.parametrize("settings", MODES, ids=lambda settings: settings.mode)
def test_a_first_frame_without_depth_gives_way_to_the_first_that_has_some(settings: FusionSettings) -> None:
    clip = plane_clip()
    clip.depth_mm[0] = 0
    cloud = fuse(clip, TRAIN, settings, seed=0)
    assert (cloud.frame == 2).mean() > 0.4
    assert 0 not in cloud.frame[cloud.confidence > COMPLETED_CONFIDENCE]
    assert np.isfinite(cloud.points_mm).all()


@pytest.mark.parametrize("settings", MODES, ids=lambda settings: settings.mode)
def test_no_valid_depth_on_tissue_is_said(settings: FusionSettings) -> None:
    clip = plane_clip()
    clip.depth_mm[clip.tissue] = 0
    with pytest.raises(InputError, match="no valid depth on tissue in its 10 training frames"):
        fuse(clip, TRAIN, settings, seed=0)


def test_the_seed_decides_the_sample() -> None:
    clip = plane_clip()
    settings = FusionSettings(mode="paper")
    assert same_bits(fuse(clip, TRAIN, settings, seed=1), fuse(clip, TRAIN, settings, seed=1))
    assert not same_bits(fuse(clip, TRAIN, settings, seed=1), fuse(clip, TRAIN, settings, seed=2))


def test_one_frame_is_enough_for_every_mode() -> None:
    clip = plane_clip(frames=1)
    for settings in MODES:
        assert len(fuse(clip, [0], settings, seed=0)) > 0


def test_unprojection_goes_through_pixel_centres() -> None:
    clip = plane_clip()
    camera = clip.intrinsics
    pixel = np.array([3 * WIDTH + 5])
    point = unproject(pixel, np.array([80.0], np.float32), camera, np.eye(4))[0]
    np.testing.assert_allclose(point, [5.5 - camera.cx, 3.5 - camera.cy, 80.0])


@pytest.mark.parametrize(
    "wrong",
    [{"mode": "all"}, {"stride": 0}, {"frame_share": 0.0}, {"total_share": 1.5}],
    ids=lambda each: next(iter(each)),
)
def test_settings_that_mean_nothing_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"must"):
        FusionSettings(**wrong)  # type: ignore[arg-type]


STEP_PX = 2
"""By how much the tissue of drifting_clip moves to the right from frame to frame."""


def drifting_clip() -> tuple[DepthClip, NDArray[np.uint8]]:
    """A plane facing a camera at rest, drifting right under a tool that wanders faster; and its texture, of which frame
    0 shows the columns from STEP_PX * frames on."""
    clip = plane_clip()
    beyond = STEP_PX * clip.frame_count
    texture = np.random.default_rng(1).integers(60, 200, (HEIGHT, WIDTH + beyond, 3)).astype(np.uint8)
    clip.depth_mm[:] = 60
    for index in range(clip.frame_count):
        left = beyond - STEP_PX * index
        clip.rgb[index] = np.where(clip.tissue[index][..., None], texture[:, left : left + WIDTH], 230)
    return clip, texture


def drift(clip: DepthClip) -> Moved:
    """The truth about drifting_clip."""

    def moved(index: int, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        step_mm = STEP_PX * index * 60 / clip.intrinsics.fx
        return np.tile(np.array([step_mm, 0, 0], np.float32), (len(pixels), 1))

    return moved


def at_first(clip: DepthClip, cloud: PointCloud) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of the first frame, or beside it, in which each point's tissue lay then."""
    x, y, z = cloud.reference_mm.T
    k = clip.intrinsics
    row, column = (np.floor(place + 1e-3).astype(np.intp) for place in (k.fy * y / z + k.cy, k.fx * x / z + k.cx))
    return row, column


def test_hidden_tissue_is_taken_from_where_it_has_moved_to() -> None:
    clip, texture = drifting_clip()
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0, moved={0: drift(clip)})
    row, column = at_first(clip, cloud)
    hits = np.zeros((HEIGHT, WIDTH), int)
    in_view = (column >= 0) & (column < WIDTH)
    np.add.at(hits, (row[in_view], column[in_view]), 1)
    assert (hits == 1).all(), "every cell of the first frame once, those under the tool too"
    expected = texture[row, column + STEP_PX * clip.frame_count] / np.float32(255)
    np.testing.assert_array_equal(cloud.rgb, expected)
    hidden = ~clip.tissue[0, row[in_view], column[in_view]]
    assert (cloud.frame[in_view] > 0).tolist() == hidden.tolist()
    step_mm = cloud.points_mm - cloud.reference_mm
    np.testing.assert_allclose(step_mm[:, 0], STEP_PX * cloud.frame * 60 / clip.intrinsics.fx, atol=1e-4)


def test_tissue_that_comes_into_view_later_gets_points_beside_the_first_frame() -> None:
    clip, _ = drifting_clip()
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0, moved={0: drift(clip)})
    _, column = at_first(clip, cloud)
    margin = int(WIDTH * MARGIN)
    assert set(column[column < 0]) == set(range(-margin, 0)), "all that came in from the left, as far as is looked"
    assert column.max() == WIDTH - 1, "nothing came in from the right"


def at_rest(index: int, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
    return np.zeros((len(pixels), 3), np.float32)


@pytest.mark.parametrize("stride", [1, 2, 3, 7, 10])
def test_where_nothing_moves_the_first_frame_is_filled_as_without_tracks(stride: int) -> None:
    clip = plane_clip()
    clip.tissue[0, 30:, 50:] = False  # also at the border, where the last cells may be smaller
    settings = FusionSettings(mode="fill", stride=stride)
    bare, followed = (fuse(clip, TRAIN, settings, seed=0, moved=moved) for moved in ({}, {0: at_rest}))
    order = [np.lexsort(np.floor(pixels_of(clip, each)).T) for each in (bare, followed)]
    np.testing.assert_array_equal(bare.frame[order[0]], followed.frame[order[1]])
    np.testing.assert_array_equal(bare.points_mm[order[0]], followed.points_mm[order[1]])


def test_what_a_wrong_guess_never_brings_into_sight_gets_a_colour_from_its_place_and_no_depth() -> None:
    clip = plane_clip()
    reach_mm = WIDTH * 60 / clip.intrinsics.fx

    def out_of_sight(index: int, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        return np.tile(np.array([2 * reach_mm, 0, 0], np.float32), (len(pixels), 1))

    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=1), seed=0, moved={0: out_of_sight})
    rows, columns = np.floor(pixels_of(clip, cloud)).astype(int).T
    hidden = ~clip.tissue[0, rows, columns]
    assert hidden.sum() == (~clip.tissue[0]).sum(), "every cell that is seen in place at some time, once"
    assert (cloud.frame == 0).all()
    assert np.array_equal(cloud.confidence == np.float32(COMPLETED_CONFIDENCE), hidden)
    np.testing.assert_array_equal(cloud.points_mm, cloud.reference_mm)
    colours = clip.rgb[:, rows[hidden], columns[hidden]] / np.float32(255)  # [T, M, 3]
    shown = (np.abs(colours - cloud.rgb[hidden]).max(-1) == 0) & clip.tissue[:, rows[hidden], columns[hidden]]
    assert shown[TRAIN].any(axis=0).all(), "as some training frame shows it there, on tissue"


@pytest.mark.parametrize("step_mm", [0.0, 1.0])
def test_along_tracks_too_held_out_frames_change_no_bit(step_mm: float) -> None:
    clip, poisoned = plane_clip(step_mm=step_mm), plane_clip(step_mm=step_mm)
    for index in HELD_OUT:
        poisoned.rgb[index] = 0
        poisoned.depth_mm[index] = np.nan
        poisoned.tissue[index] = ~poisoned.tissue[index]
        poisoned.world_from_camera[index] = np.nan

    def moved(index: int, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        assert index in TRAIN
        return np.tile(np.array([0.2 * index, 0, 0], np.float32), (len(pixels), 1))

    settings = FusionSettings(mode="fill", stride=2)
    assert same_bits(*(fuse(each, TRAIN, settings, seed=3, moved={0: moved}) for each in (clip, poisoned)))


@pytest.mark.parametrize(("source", "is_filled"), [("given", False), ("found", True), ("segmenter", True)])
def test_the_rim_of_masks_that_were_found_gets_the_colour_beside_it(
    source: Literal["given", "found", "segmenter"], is_filled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[fill.__module__], "RIM_SHARE", 4 / WIDTH)
    clip = dataclasses.replace(plane_clip(), masks=Masks(source=source))
    clip.tissue[:, 6:30, 36:60] = False  # an instrument that rests
    clip.rgb[:, 6:30, 36:60] = 230
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=2), seed=0, moved={0: at_rest})
    row, column = pixels_of(clip, cloud).T
    inside = np.minimum(np.minimum(row - 6, 30 - row), np.minimum(column - 36, 60 - column))
    assert (inside > 0).any() == is_filled
    assert not (inside > 4.5).any()
    assert (cloud.rgb[inside > 0] < 220 / 255).all()
    x, y, z = cloud.points_mm.T
    np.testing.assert_allclose(z, 60 + 0.2 * x + 0.1 * y, atol=0.2)


def test_a_first_frame_without_depth_gives_way_along_tracks_too() -> None:
    clip = plane_clip()
    clip.depth_mm[0] = 0
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=2), seed=0, moved={0: at_rest})
    assert (cloud.frame == 2).mean() > 0.4
    x, y, z = cloud.points_mm.T
    np.testing.assert_allclose(z, 60 + 0.2 * x + 0.1 * y, atol=0.1)


def test_a_moving_camera_still_fills_what_lies_beyond_the_margin() -> None:
    clip = plane_clip(step_mm=2.0)
    cloud = fuse(clip, TRAIN, FusionSettings(mode="fill", stride=2), seed=0, moved={0: at_rest})
    assert pixels_of(clip, cloud, 11)[:, 1].max() > WIDTH - 4
    x, y, z = cloud.points_mm.T
    np.testing.assert_allclose(z, 60 + 0.2 * x + 0.1 * y, atol=0.1)
    beside = np.linalg.norm(cloud.points_mm[:, None] - cloud.points_mm[None], axis=-1)
    np.fill_diagonal(beside, np.inf)
    assert (beside.min(axis=1) < 0.5 * np.median(beside.min(axis=1))).mean() < 0.05, "hardly anything twice"
