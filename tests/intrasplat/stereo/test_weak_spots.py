"""Stereo where there is little to match: dark, flat and burnt-out tissue, and depths that no endoscope sees."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.stats import spearmanr

from intrasplat.notices import NoticeCode
from intrasplat.options import MAX_DEPTH_MM
from intrasplat.stereo import estimate_depth
from tests.intrasplat.stereo.test_stereo import (
    BASELINE_MM,
    FX_PX,
    HEIGHT,
    OFFSET_PX,
    WIDTH,
    clip_of,
    depth_of,
    draw_pair,
    errors_px,
    slanted,
)


def test_flat_black_and_burnt_out_regions_are_trusted_less_than_texture() -> None:
    left, right = draw_pair(slanted())
    for eye in (left, right):
        eye[:40] = 2
        eye[104:] = 255
    right[40:104, 160:] = left[40:104, 160:] = 120
    confidence = estimate_depth(clip_of([(left, right)])).depth_confidence[0]
    textured = confidence[50:94, 30:140].mean()
    assert confidence[:36].max() == 0
    assert confidence[110:].mean() < 0.3 * textured
    assert confidence[50:94, 175:].mean() < 0.3 * textured
    assert textured > 200


def test_nothing_outside_the_depths_that_are_asked_for_becomes_depth() -> None:
    disparity = slanted(40.0, 4.0)
    farthest_mm = 60.0
    clip = estimate_depth(clip_of([draw_pair(disparity)]), depth_range_mm=(30.0, farthest_mm))
    depth_mm = clip.depth_mm[0]
    assert depth_mm[depth_mm > 0].min() >= 30.0
    assert depth_mm.max() <= farthest_mm
    inside = (depth_of(disparity) > 31.0) & (depth_of(disparity) < 58.0) & (np.arange(WIDTH) - disparity > 0)
    assert (depth_mm > 0)[inside].mean() > 0.9
    beyond = (depth_of(disparity) < 28.0) | (depth_of(disparity) > 65.0)
    assert (clip.depth_confidence[0] >= 128)[beyond].mean() < 0.02
    assert clip.measurements["min_disparity_px"] >= OFFSET_PX + FX_PX * BASELINE_MM / farthest_mm
    assert NoticeCode.DEPTH_OUT_OF_RANGE in [each.code for each in clip.warnings]


def test_depths_that_no_endoscope_sees_are_not_searched() -> None:
    disparity = slanted(8.0, -4.0)  # some of it behind the cameras
    clip = estimate_depth(clip_of([draw_pair(disparity)]))
    assert clip.measurements["min_disparity_px"] >= OFFSET_PX + FX_PX * BASELINE_MM / MAX_DEPTH_MM
    assert clip.depth_mm.max() <= MAX_DEPTH_MM
    assert (clip.depth_confidence[0] >= 128)[disparity < 2.0].mean() < 0.02
    assert NoticeCode.DEPTH_OUT_OF_RANGE in [each.code for each in clip.warnings]


def test_a_dark_border_that_stays_in_place_does_not_become_far_tissue() -> None:
    disparity = slanted(30.0, 24.0, 320, 192)
    y, x = np.mgrid[:192, :320]
    light = np.clip(1.6 - 1.8 * np.hypot((x - 160) / 160, (y - 96) / 96), 0, 1)[..., None]
    left, right = ((eye * light).astype(np.uint8) for eye in draw_pair(disparity))
    clip = estimate_depth(clip_of([(left, right)]))
    sure = clip.depth_confidence[0] >= 128
    error_px = np.abs(FX_PX * BASELINE_MM / np.maximum(clip.depth_mm[0], 1) + OFFSET_PX - disparity)
    assert np.percentile(error_px[sure], 99) < 1.0
    assert (error_px[clip.depth_mm[0] > 0] < 3).mean() > 0.97


def test_textureless_tissue_gets_a_smooth_surface_at_low_confidence() -> None:
    disparity = slanted()
    left, right = draw_pair(disparity, noise=0.0)
    flat = np.zeros((HEIGHT, WIDTH), np.bool_)
    flat[50:94, 90:150] = True
    left[flat] = (200, 140, 120)
    right[50:94, 90 - 12 : 150 - 12] = (200, 140, 120)
    clip = estimate_depth(clip_of([(left, right)]))
    inner = slice(58, 86), slice(100, 140)
    depth_mm = clip.depth_mm[0][inner]
    assert (depth_mm > 0).mean() > 0.95
    assert np.abs(FX_PX * BASELINE_MM / depth_mm[depth_mm > 0] + OFFSET_PX - disparity[inner][depth_mm > 0]).max() < 2.0
    assert np.median(clip.depth_confidence[0][inner]) < 64


def test_confidence_ranks_the_error() -> None:
    rng = np.random.default_rng(0)
    left, right = draw_pair(slanted(width=320, height=256))
    burnt = cv2.GaussianBlur(rng.standard_normal((256, 320)).astype(np.float32), (0, 0), 12) > 0.02
    left[burnt] = 255
    right[np.roll(burnt, -4, axis=1)] = 255
    clip = estimate_depth(clip_of([(left, right)]))
    disparity = slanted(width=320, height=256)
    valid = clip.depth_mm[0] > 0
    rank = spearmanr(clip.depth_confidence[0][valid], np.abs(errors_px(clip, disparity))).statistic
    assert rank < -0.4


def test_tissue_at_the_same_pixels_in_both_eyes_is_no_label() -> None:
    offset_px = OFFSET_PX - 12
    disparity = slanted(width=240, height=144) - np.float32(12)
    assert np.abs(disparity).min() < 0.5
    clip = estimate_depth(clip_of([draw_pair(disparity)] * 10, offset_px=offset_px), fov="auto")
    assert clip.field_of_view is None
    assert np.median(np.abs(errors_px(clip, disparity, offset_px=offset_px))) < 0.1
