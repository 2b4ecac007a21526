"""The scene of one moment looks like that moment, from the endoscope and beside it."""

from __future__ import annotations

import numpy as np
import pytest

from intrasplat.errors import InputError
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.first_picture import first_picture
from intrasplat.view.render import render_frame
from lab.phantom import PhantomSettings, make_phantom


def test_the_first_moment_is_shown_from_the_endoscope_and_beside_it() -> None:
    phantom = make_phantom(PhantomSettings(width=160, height=128, frames=9))
    clip = phantom.depth_clip()
    scene = first_picture(clip.moment(0))
    own = render_frame(scene, 0.0)
    assert psnr_tissue(own.rgb / np.float32(255), clip.rgb[0], clip.tissue[0]) > 22
    tissue = clip.tissue[0] & (clip.depth_mm[0] > 0)
    assert np.median(np.abs(own.depth_mm - clip.depth_mm[0])[tissue]) < 1.0
    pose = np.array(world_from_camera(OrbitPose(yaw_deg=10, pitch_deg=0, zoom=1), 60 / scene.units_per_mm))
    truth, _ = phantom.render(0, pose)
    beside = render_frame(scene, 0.0, pose)
    covered = beside.depth_mm > 0
    assert covered.mean() > 0.8
    assert psnr_tissue(beside.rgb / np.float32(255), (truth * 255).astype(np.uint8), covered) > 18


def test_a_moment_without_depth_is_refused() -> None:
    moment = make_phantom(PhantomSettings(width=96, height=80, frames=3)).depth_clip().moment(0)
    moment.depth_mm[:] = 0
    with pytest.raises(InputError, match="depth"):
        first_picture(moment)
