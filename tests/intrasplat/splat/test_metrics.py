"""Scores by their definitions, and SSIM against another implementation of it."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.splat.metrics import (
    BEST_PSNR_DB,
    coverage,
    depth_agreement_mm,
    depth_errors_mm,
    psnr_paper,
    psnr_tissue,
    ssim,
    ssim_map,
)

H, W = 40, 52
BEFORE_NO_PAGE = """
import ctypes, mmap
import numpy as np
from intrasplat.splat.metrics import psnr_tissue
page, count = mmap.PAGESIZE, 64 * 64
memory = np.frombuffer(mmap.mmap(-1, count + page), np.uint8)
assert not ctypes.CDLL(None).mprotect(ctypes.c_void_p(memory.ctypes.data + count), page, 0)  # PROT_NONE
tissue = memory[:count].view(np.bool_).reshape(64, 64)
tissue[:] = True
print(psnr_tissue(np.zeros((64, 64, 3), np.float32), np.full((64, 64, 3), 255, np.uint8), tissue))
"""
"""A mask that ends where the next byte belongs to no page: reading past it is a segmentation fault."""


def pictures(seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]:
    random = np.random.default_rng(seed)
    truth = random.integers(0, 256, (H, W, 3)).astype(np.uint8)
    rendered = (truth / 255 + random.normal(0, 0.05, truth.shape)).astype(np.float32)
    tissue = np.ones((H, W), dtype=np.bool_)
    tissue[10:20, :26] = False
    return rendered, truth, tissue


def test_psnr_tissue_is_the_mean_squared_error_of_tissue_alone_after_clamping() -> None:
    rendered, truth, tissue = pictures()
    rendered[~tissue] = 7.0
    squared = (np.clip(rendered, 0, 1) - truth / 255)[tissue] ** 2
    assert psnr_tissue(rendered, truth, tissue) == pytest.approx(-10 * math.log10(squared.mean()), abs=1e-4)


@pytest.mark.skipif(sys.platform != "linux", reason="protects a page as Linux does")
def test_nothing_behind_a_mask_is_read() -> None:
    run = subprocess.run([sys.executable, "-c", BEFORE_NO_PAGE], capture_output=True, text=True, check=False)
    assert (run.returncode, float(run.stdout or "nan")) == (0, 0.0), run.stderr


def test_psnr_paper_counts_the_zeroed_instrument_as_right() -> None:
    rendered, truth, tissue = pictures()
    share = float(tissue.mean())
    inflated = psnr_tissue(np.rint(np.clip(rendered, 0, 1) * 255) / 255, truth, tissue) - 10 * math.log10(share)
    assert psnr_paper(rendered, truth, tissue) == pytest.approx(inflated, abs=1e-4)


def test_psnr_paper_rounds_to_eight_bit() -> None:
    truth = np.full((H, W, 3), 100, np.uint8)
    rendered = np.full((H, W, 3), 100.4 / 255, np.float32)
    everywhere = np.ones((H, W), dtype=np.bool_)
    assert psnr_paper(rendered, truth, everywhere) == BEST_PSNR_DB
    assert psnr_tissue(rendered, truth, everywhere) == pytest.approx(-20 * math.log10(0.4 / 255), abs=1e-2)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_ssim_agrees_with_scikit_image() -> None:
    structural_similarity = pytest.importorskip("skimage.metrics").structural_similarity
    rendered, truth, _ = pictures()
    first, second = np.clip(rendered, 0, 1).astype(np.float64), truth / 255
    _, expected = structural_similarity(
        first, second, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=2, full=True,
    )  # fmt: skip
    np.testing.assert_allclose(ssim_map(first, second), expected, atol=1e-5)
    assert ssim(rendered, truth, np.ones((H, W), dtype=np.bool_)) == pytest.approx(expected.mean(), abs=1e-6)


def test_psnr_agrees_with_scikit_image() -> None:
    peak_signal_noise_ratio = pytest.importorskip("skimage.metrics").peak_signal_noise_ratio
    rendered, truth, tissue = pictures()
    first, second = np.clip(rendered, 0, 1).astype(np.float64), truth / 255
    assert psnr_tissue(rendered, truth, tissue) == pytest.approx(
        peak_signal_noise_ratio(second[tissue], first[tissue], data_range=1.0), abs=1e-4
    )
    shown = (np.rint(first * 255).astype(np.uint8), truth)
    zeroed = [np.where(tissue[..., None], picture, 0).astype(np.uint8) for picture in shown]
    assert psnr_paper(rendered, truth, tissue) == pytest.approx(peak_signal_noise_ratio(zeroed[1], zeroed[0]), abs=1e-4)


def test_equal_pictures_score_best_whatever_the_instrument_shows() -> None:
    _, truth, tissue = pictures()
    rendered = truth.copy()
    rendered[~tissue] = 255 - rendered[~tissue]
    assert psnr_tissue(rendered, truth, tissue) == BEST_PSNR_DB
    assert psnr_paper(rendered, truth, tissue) == BEST_PSNR_DB
    assert ssim(rendered, truth, tissue) == pytest.approx(1.0)


@pytest.mark.parametrize("score", [psnr_tissue, psnr_paper, ssim], ids=lambda each: each.__name__)
def test_nothing_to_judge_is_not_a_score(score: object) -> None:
    rendered, truth, tissue = pictures()
    assert math.isnan(score(rendered, truth, np.zeros_like(tissue)))  # type: ignore[operator]
    with pytest.raises(ValueError, match="shapes"):
        score(rendered[:-1], truth, tissue)  # type: ignore[operator]


@pytest.mark.parametrize("score", [psnr_tissue, psnr_paper, ssim], ids=lambda each: each.__name__)
def test_a_picture_that_is_no_number_has_no_score(score: object) -> None:
    rendered, truth, tissue = pictures()
    rendered[~tissue] = math.nan
    assert not math.isnan(score(rendered, truth, tissue))  # type: ignore[operator]
    rendered[30, 30, 1] = math.nan
    assert math.isnan(score(rendered, truth, tissue))  # type: ignore[operator]


def test_depth_that_is_no_number_does_not_agree() -> None:
    tissue = np.ones((1, 3), dtype=np.bool_)
    errors = depth_errors_mm(np.array([[51.0, math.nan, 0.0]], np.float32), np.full((1, 3), 50, np.float32), tissue)
    assert errors.tolist() == pytest.approx([1.0, math.nan], nan_ok=True)
    assert math.isnan(depth_agreement_mm([errors]))
    assert coverage(np.array([[0.9, math.nan, 0.9]]), tissue) == pytest.approx(2 / 3)


def test_depth_agreement_is_the_median_over_all_frames_where_both_are_valid() -> None:
    tissue = np.ones((1, 4), dtype=np.bool_)
    tissue[0, 3] = False
    stereo = np.array([[50.0, 0.0, 60.0, 70.0]], np.float32)
    near = depth_errors_mm(np.array([[51.0, 55.0, 0.0, 99.0]], np.float32), stereo, tissue)
    far = depth_errors_mm(np.array([[53.0, 0.0, 62.0, 0.0]], np.float32), stereo, tissue)
    assert near.tolist() == [1.0]
    assert far.tolist() == [3.0, 2.0]
    assert depth_agreement_mm([near, far]) == 2.0
    assert math.isnan(depth_agreement_mm([]))


def test_coverage_is_the_share_of_tissue_with_half_its_weight() -> None:
    alpha = np.array([[0.5, 0.49, 1.0, 0.0]])
    tissue = np.array([[True, True, True, False]])
    assert coverage(alpha, tissue) == pytest.approx(2 / 3)
    assert math.isnan(coverage(alpha, np.zeros_like(tissue)))
