"""A lattice of pixels is pixels of the clip, seen along the same rays, and judged as the whole pictures are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from intrasplat.clip import DepthClip
from lab.evaluate.thinned import lattice, thinned, thinned_camera
from lab.evaluate.truth import ShownView, Truth
from lab.phantom import Phantom, PhantomSettings, make_phantom
from lab.rivals.endonerf import EndoNerf
from lab.rivals.rival import Seen
from tests.lab.rivals.cases import frame_of, small_clip
from tests.lab.rivals.test_endonerf import TINY


@pytest.mark.parametrize("step_px", [1, 3, 4])
def test_a_thinned_picture_holds_the_pixels_of_the_whole_one(step_px: int) -> None:
    clip = small_clip(2)
    rival = EndoNerf(Seen.of(clip, [1]), 0, TINY)
    thin = thinned(clip, step_px)
    whole, part = (frame_of(rival, each, 1) for each in (clip, thin))
    rows, columns = lattice(step_px)
    np.testing.assert_array_equal(thin.rgb[1], clip.rgb[1, rows, columns])
    # a point on the border of two pixels may guide the rays of either
    assert np.mean(np.abs(part.rgb - whole.rgb[rows, columns]) < 1e-3) > 0.99
    assert np.mean(np.abs(part.depth_mm - whole.depth_mm[rows, columns]) < 1e-2) > 0.99


def test_the_thinned_camera_sends_the_rays_of_its_pixels() -> None:
    camera = small_clip(2).intrinsics
    thin = thinned_camera(camera, 4)
    rows, columns = lattice(4)
    whole_x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    whole_y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    np.testing.assert_allclose((np.arange(thin.width) + 0.5 - thin.cx) / thin.fx, whole_x[columns])
    np.testing.assert_allclose((np.arange(thin.height) + 0.5 - thin.cy) / thin.fy, whole_y[rows])


class Blurred:
    """The phantom's own pictures, each moved by a little: no method is perfect."""

    def __init__(self, phantom: Phantom, step_px: int) -> None:
        self._phantom, self._at = phantom, lattice(step_px)

    def view(self, frame: int, pose: np.ndarray) -> ShownView:
        rgb, depth_mm = self._phantom.render(frame, pose)
        noise = np.random.default_rng(frame).normal(0, 0.05, rgb.shape).astype(np.float32)
        shown = ShownView(rgb + noise, depth_mm + np.float32(0.3), np.full_like(depth_mm, np.nan))
        return ShownView(*(getattr(shown, each.name)[self._at] for each in dataclasses.fields(shown)))

    def motion_mm(self, frame: int) -> np.ndarray:
        return np.full((*self._phantom.depth_clip().tissue.shape[1:], 3), np.nan, np.float32)


def test_the_truth_of_a_lattice_agrees_with_that_of_all_pixels() -> None:
    phantom = make_phantom(PhantomSettings(motion="pull", width=96, height=80, frames=9))
    clip: DepthClip = phantom.depth_clip()
    whole, part = (
        Truth(phantom, clip.tissue, [0, 2, 4, 6, 8], [1, 5], step_px=step_px).score(Blurred(phantom, step_px))
        for step_px in (1, 3)
    )
    assert part.psnr_view10_db == pytest.approx(whole.psnr_view10_db, abs=0.2)
    assert part.psnr_hidden_db == pytest.approx(whole.psnr_hidden_db, abs=0.5)
    assert part.depth_error_mm == pytest.approx(0.3, abs=0.01)
    assert part.empty_ok == pytest.approx(whole.empty_ok, abs=0.02)
    assert part.seen_ok == whole.seen_ok == 1
    assert whole.bound10_db == pytest.approx(part.bound10_db, abs=1.5)
