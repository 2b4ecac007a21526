"""A picture of fewer pixels and Gaussians shows what the whole one does."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.worker.phantoms import phantom_clip, prepared, trained
from worker.machine.parts import whole
from worker.model.metrics import psnr_tissue
from worker.outcome import snapshot_of
from worker.render.detail import LEVELS, thinned
from worker.render.view import View, frame_in_parts, render_frame
from worker.scene.scene import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    run, _ = prepared(phantom_clip(width=192, height=160), iterations=30)
    return snapshot_of(trained(run), as_it_lies=True)


@pytest.mark.parametrize(("level", "least_db"), [(1, 26.0), (2, 22.0)])
def test_a_coarse_picture_resembles_the_whole_one_and_leaves_no_gaps(scene: Scene, level: int, least_db: float) -> None:
    detail, clip = LEVELS[level], scene.intrinsics
    sharp = render_frame(scene, 0.4)
    camera = clip.resized(clip.width // detail.pixels, clip.height // detail.pixels)
    view = View(thinned(scene, detail.gaussians), 0.4, None, camera, is_coarse=True)
    coarse = whole(frame_in_parts(view)).enlarged(clip.width, clip.height)
    solid = sharp.depth_mm > 0
    assert psnr_tissue(coarse.rgb, sharp.rgb, solid) > least_db
    assert (coarse.depth_mm[solid] > 0).mean() > 0.98


def test_a_thinned_scene_is_made_once_and_moves_as_all_do(scene: Scene) -> None:
    few = thinned(scene, 4)
    assert thinned(scene, 4) is few
    assert thinned(scene, 1) is scene
    assert len(few.gaussians) == -(-len(scene.gaussians) // 4)
    moved, all_moved = (each.deformation.deform(each.gaussians, 0.7) for each in (few, scene))
    torch.testing.assert_close(moved.mean, all_moved.mean[::4])
    assert np.all(few.gaussians.log_scale.numpy() > scene.gaussians.log_scale[::4].numpy())
