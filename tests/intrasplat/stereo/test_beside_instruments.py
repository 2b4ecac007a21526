"""Beside an instrument, whose edge matching windows reach over, tissue takes no depth from it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from intrasplat.clip.calibration import rectify
from intrasplat.stereo import estimate_depth
from intrasplat.stereo.frames import BESIDE_PX
from lab.phantom import PhantomSettings, make_phantom
from tests.intrasplat.stereo.test_stereo import BASELINE_MM, FX_PX, OFFSET_PX, clip_of, draw_pair


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


NEAR_MM, FAR_MM = 25.0, 45.0
START, END = 75, 110
"""Columns of the instrument."""


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_tissue_that_an_instrument_hides_from_the_right_eye_never_gets_the_instruments_depth(device: str) -> None:
    if device == "cuda":
        pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")
    height, width = 28, 136  # the interpreter's time grows with both
    near_px, far_px = (OFFSET_PX + FX_PX * BASELINE_MM / depth_mm for depth_mm in (NEAR_MM, FAR_MM))
    far_left, far_right = draw_pair(np.full((height, width), far_px, np.float32), seed=0)
    near_left, near_right = draw_pair(np.full((height, width), near_px, np.float32), seed=5)
    columns = np.arange(width)
    instrument = (columns >= START) & (columns < END)
    left = np.where(instrument[:, None], near_left, far_left)
    moved = (columns + near_px >= START) & (columns + near_px < END)
    right = np.where(moved[:, None], near_right, far_right)
    tissue = np.broadcast_to(~instrument, (1, height, width))
    clip = estimate_depth(clip_of([(left, right)], tissue=tissue), device=device)  # type: ignore[arg-type]
    hidden_px = int(near_px - far_px)
    assert hidden_px > 2 * BESIDE_PX
    strip, beyond = (clip.depth_mm[0, 4:-4, START - end : START - start] for start, end in ((0, hidden_px), (20, 45)))
    assert (strip[strip > 0] < 0.9 * FAR_MM).mean() < 0.02
    assert (np.abs(beyond - FAR_MM) < 2.0).mean() > 0.95
