"""The rank correlation and the reliability diagram say what they should of made-up errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr

from lab.evaluate.ranking import (
    PixelErrors,
    pixel_errors,
    rank_correlation,
    rank_scores,
    reliability,
    squares_of,
    together,
)

RNG = np.random.default_rng(0)


def test_a_perfect_ranking_is_one_the_reverse_is_minus_one_and_chance_is_nothing() -> None:
    error = RNG.random(1000)
    assert rank_correlation(-error, error) == pytest.approx(1)
    assert rank_correlation(error, error) == pytest.approx(-1)
    assert abs(rank_correlation(RNG.random(1000), error)) < 0.1


def test_ties_and_infinite_errors_are_ranked_as_elsewhere() -> None:
    confidence = np.round(RNG.random(200), 1)
    error = np.where(confidence < 0.2, np.inf, RNG.random(200))
    expected = -spearmanr(confidence, np.where(np.isinf(error), 9, error)).statistic
    assert rank_correlation(confidence, error) == pytest.approx(expected)


def test_a_confidence_that_is_the_same_everywhere_ranks_nothing() -> None:
    assert np.isnan(rank_correlation(np.ones(5), np.arange(5.0)))
    assert np.isnan(rank_correlation(np.empty(0), np.empty(0)))


def test_errors_are_those_of_the_judged_pixels_and_what_is_not_drawn_is_infinitely_wrong() -> None:
    true_mm, shown_mm = np.full((1, 3), 50, np.float32), np.array([[51, 0, 50]], np.float32)
    true = np.full((1, 3, 3), 0.5, np.float32)
    shown = true + np.array([0.03, 0, -0.03], np.float32)
    judged = np.array([[True, True, False]])
    errors = pixel_errors(np.array([[0.9, 0.1, 0.5]], np.float32), (shown, true), (shown_mm, true_mm), judged)
    assert errors.colour == pytest.approx([0.02, 0.02])
    assert errors.depth == pytest.approx([0.02, np.inf])
    assert together([errors, errors]).confidence == pytest.approx([0.9, 0.1, 0.9, 0.1])


def test_a_square_has_the_means_of_its_pixels_and_needs_half_of_them() -> None:
    judged = np.ones((16, 24), np.bool_)
    judged[:8, 8:12] = False
    judged[:8, 16:21] = False
    confidence = np.kron([[0.9, 0.5, 0.1], [0.7, 0.3, 0.2]], np.ones((8, 8))).astype(np.float32)
    true, true_mm = np.full((16, 24, 3), 0.5, np.float32), np.full((16, 24), 50, np.float32)
    shown_mm = true_mm.copy()
    shown_mm[:4, :8] = 0
    view = pixel_errors(confidence, (true + confidence[..., None] / 10, true), (shown_mm, true_mm), judged)
    squares = squares_of(together([view, view]))
    assert squares.confidence == pytest.approx([0.9, 0.5, 0.7, 0.3, 0.2] * 2)
    assert squares.colour == pytest.approx(squares.confidence / 10)
    assert squares.depth == pytest.approx([0.5, 0, 0, 0, 0] * 2), "what is not drawn is wrong by its whole length"
    scores = rank_scores(view, "rank")
    assert scores["rank_colour_8px"] == scores["rank_colour"] == pytest.approx(-1)
    assert set(scores) == {"rank_colour", "rank_depth", "rank_colour_8px", "rank_depth_8px"}


def test_a_calibrated_confidence_lies_on_the_diagonal() -> None:
    confidence = RNG.random(20_000).astype(np.float32)
    wrong = (RNG.random(20_000) > confidence).astype(np.float32)
    bins = reliability(PixelErrors(confidence, wrong, wrong, np.zeros(20_000, np.int64)))
    assert sum(each.pixels for each in bins) == 20_000
    for each in bins:
        assert each.low <= each.confidence <= each.high
        assert each.depth_right == each.colour_right == each.right == pytest.approx(each.confidence, abs=0.05)


def test_a_bin_without_pixels_has_no_shares() -> None:
    ones, zeros = np.ones(1, np.float32), np.zeros(1, np.float32)
    one = reliability(PixelErrors(ones, zeros, zeros, np.zeros(1, np.int64)))
    assert one[-1].pixels == 1
    assert np.isnan(one[0].depth_right)
