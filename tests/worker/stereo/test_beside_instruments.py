"""Tissue beside an instrument gets no depth from stereo, whose windows reach over the edge."""

from __future__ import annotations

import cv2
import numpy as np

from worker.input.calibration import rectify
from worker.phantom import PhantomSettings, make_phantom
from worker.stereo import estimate_depth
from worker.stereo.depth import BESIDE_PX


def test_tissue_beside_an_instrument_has_no_depth_and_the_rest_keeps_its_own() -> None:
    drawn = make_phantom(PhantomSettings(width=160, height=128, frames=2, motion="still")).stereo_recording()
    clip = estimate_depth(rectify(drawn.clip, drawn.calibration))
    for eye in clip.eyes:
        for tissue, depth_mm, confidence in zip(eye.tissue, eye.depth_mm, eye.depth_confidence, strict=True):
            apart_px = cv2.distanceTransform(tissue.astype(np.uint8), cv2.DIST_C, 3)
            beside = tissue & (apart_px <= BESIDE_PX)
            assert beside.sum() > 200
            assert not depth_mm[beside].any()
            assert not confidence[beside].any()
            assert (depth_mm[apart_px > 2 * BESIDE_PX] > 0).mean() > 0.8
