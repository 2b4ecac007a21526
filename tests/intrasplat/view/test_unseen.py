"""What no training frame saw: behind an instrument that never moves, past a depth edge, outside every frame."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.notices import NoticeCode
from intrasplat.outcome import scene_of, snapshot_of
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.view.render import render_frame
from intrasplat.view.unseen import NEVER_SEEN, blended_values, hatched, missing_pixels, unseen_pixels
from tests.intrasplat.clips import HEIGHT, WIDTH, plane_clip
from tests.intrasplat.phantoms import phantom_clip, prepared, trained

SCENES_OF_0_3 = Path(__file__).resolve().parents[2] / "data" / "scene_0_3"
ITERATIONS = 60
NEAR_MM, FAR_MM, EDGE = 45.0, 90.0, WIDTH // 2
"""Of the clip with a depth edge: tissue left of column EDGE is near, the rest far."""


def scene_from(clip: DepthClip, *, iterations: int = ITERATIONS) -> TrainedScene:
    run, _ = prepared(clip, "fast", iterations=iterations, holdout="none")
    return scene_of(trained(run))


@pytest.fixture(scope="module")
def covered() -> tuple[NDArray[np.bool_], TrainedScene]:
    """A phantom on which an instrument lies and never moves: where it lies, and the scene."""
    clip = phantom_clip(tools=False)
    height, width = clip.tissue.shape[1:]
    instrument = np.zeros((height, width), np.bool_)
    instrument[height // 2 :, width // 2 : width // 2 + 24] = True
    tissue, rgb = clip.tissue & ~instrument, clip.rgb.copy()
    rgb[:, instrument] = 120
    depth_mm = np.where(tissue, clip.depth_mm, 0).astype(np.float32)
    return instrument, scene_from(dataclasses.replace(clip, tissue=tissue, rgb=rgb, depth_mm=depth_mm))


def test_what_an_instrument_hides_throughout_is_unseen_and_nothing_else_is(
    covered: tuple[NDArray[np.bool_], TrainedScene],
) -> None:
    instrument, scene = covered
    frame = render_frame(scene, 0.5)
    rows, columns = np.nonzero(instrument)
    inner = frame.unseen[rows.min() + 4 :, columns.min() + 4 : columns.max() - 3]
    assert inner.mean() > 0.8
    assert frame.unseen[~instrument].mean() < 0.01
    assert frame.unseen_share == pytest.approx(instrument.mean(), rel=0.4)
    assert (NoticeCode.UNSEEN in [each.code for each in frame.warnings]) == (frame.unseen_share > 0.05)


def test_what_hides_for_a_part_of_the_clip_is_filled_and_not_marked() -> None:
    clip = phantom_clip()
    scene, shown = scene_from(clip), clip.tissue.any(0)
    for index in (2, 5, 8):
        hidden_for_now = shown & ~clip.tissue[index]
        assert hidden_for_now.sum() > 100
        assert render_frame(scene, float(clip.t[index])).unseen[hidden_for_now].mean() < 0.1


def stepped_clip() -> DepthClip:
    clip = plane_clip(12)
    depth_mm = np.full_like(clip.depth_mm, FAR_MM)
    depth_mm[:, :, :EDGE] = NEAR_MM
    tissue = np.ones_like(clip.tissue)
    return dataclasses.replace(clip, depth_mm=depth_mm, tissue=tissue)


def test_a_pose_that_looks_past_a_depth_edge_sees_the_gap_as_unseen() -> None:
    clip, right_mm = stepped_clip(), 10.0
    scene = scene_from(clip, iterations=150)
    pose = np.eye(4)
    pose[0, 3] = right_mm
    frame = render_frame(scene, 0.5, pose)
    focal_px = clip.intrinsics.fx
    near_edge, far_edge = (round(EDGE - focal_px * right_mm / depth_mm) for depth_mm in (NEAR_MM, FAR_MM))
    assert frame.unseen[4:-4, near_edge + 2 : far_edge - 2].mean() > 0.8
    assert frame.unseen[:, : near_edge - 3].mean() < 0.02
    assert frame.unseen[:, far_edge + 3 : WIDTH - round(focal_px * right_mm / FAR_MM) - 3].mean() < 0.02
    assert render_frame(scene, 0.5).unseen_share < 0.01


def test_of_a_snapshot_only_what_nothing_covers_is_unseen(covered: tuple[NDArray[np.bool_], TrainedScene]) -> None:
    _, scene = covered
    never_seen = dataclasses.replace(scene, seen=torch.where(torch.arange(len(scene.seen)) == 0, 1.0, 0.0))
    unknown = dataclasses.replace(scene, seen=torch.zeros_like(scene.seen))
    frame = render_frame(unknown, 0.5)
    assert render_frame(never_seen, 0.5).unseen_share > 0.95
    assert frame.unseen_share < 0.15  # the hole behind the instrument
    assert not frame.confidence.any()
    run, _ = prepared(phantom_clip(), "fast", iterations=2)
    assert render_frame(snapshot_of(trained(run)), 0.5).unseen_share < 0.01


def test_what_was_hardly_seen_is_not_unseen() -> None:
    seen = np.array([0, 0.001, 0.5, 1], np.float32)
    blended = blended_values(seen)
    assert blended is not None
    np.testing.assert_array_equal(blended, np.array([NEVER_SEEN, 0.001, 0.5, 1], np.float32))
    assert blended_values(np.zeros(3, np.float32)) is None


def test_specks_and_holes_of_a_pixel_do_not_show_and_straight_edges_stay() -> None:
    solid = np.ones((256, 640), np.bool_)
    solid[100:, :300] = False
    expected = ~solid
    solid[20:220:10, 20:620:10] ^= True
    np.testing.assert_array_equal(unseen_pixels(~solid)[:90], expected[:90])
    found = unseen_pixels(~solid)
    assert (found != expected).mean() < 1e-3  # the corner is rounded


def test_a_number_that_is_none_is_unseen() -> None:
    solid, blended = np.ones((64, 64), np.bool_), np.ones((64, 64), np.float32)
    blended[20:40, 20:40] = np.nan
    assert unseen_pixels(missing_pixels(solid, blended))[25:35, 25:35].all()


@pytest.mark.parametrize("size", [(8, 8), (80, 96), (540, 674), (1080, 1920)])
def test_a_hatch_is_striped_dark_and_neutral_at_every_size(size: tuple[int, int]) -> None:
    tissue = np.full((*size, 3), (200, 90, 80), np.uint8)
    picture = hatched(tissue, np.ones(size, np.bool_))
    assert (picture == picture[..., :1]).all()
    shades, counts = np.unique(picture, return_counts=True)
    assert len(shades) == 2
    assert counts.min() > 0.3 * counts.sum()
    assert (tissue == (200, 90, 80)).all()


@pytest.mark.parametrize("coding", ["exact", "compact"])
def test_a_scene_of_an_earlier_version_is_marked_too(coding: str) -> None:
    scene = load_scene(SCENES_OF_0_3 / coding)
    assert (scene.seen == 0).any()
    frame = render_frame(scene, 0.5)
    assert frame.unseen.shape == (HEIGHT, WIDTH)
    assert 0 < frame.unseen_share <= 1
