"""Scores after one fit of gain and offset."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.evaluate.fitted import Views, fitted_db, plain_db

TISSUE = np.ones((8, 9), np.bool_)


def views(*gains: float, offset: float = 0.0) -> Views:
    """A view a gain: the truth's colours, made darker by it."""
    random = np.random.default_rng(0)
    truths = [random.uniform(0.2, 0.8, (8, 9, 3)).astype(np.float32) for _ in gains]
    return [(truth * gain + offset, truth, TISSUE) for truth, gain in zip(truths, gains, strict=True)]


def test_a_fit_undoes_one_gain_and_offset_of_each_channel_but_not_one_of_each_view() -> None:
    tinted = [(shown * np.array([1.1, 1.0, 0.8]), truth, seen) for shown, truth, seen in views(0.6, 0.6, offset=0.1)]
    assert plain_db(tinted) < 20
    assert fitted_db(tinted) > 90
    assert plain_db(views(0.6, 0.8)) < fitted_db(views(0.6, 0.8)) < 30


def test_levels_of_255_and_pixels_that_are_not_judged() -> None:
    (shown, truth, _), half = views(0.5)[0], TISSUE.copy()
    half[:4] = False
    levels = np.rint(255 * shown).astype(np.uint8)
    levels[:4] = 255
    assert fitted_db([(levels, truth, half)]) > 45


def test_one_colour_is_fitted_by_the_offset_and_nothing_has_no_score() -> None:
    _, truth, _ = views(1.0)[0]
    grey = np.full_like(truth, 0.9)
    expected = -10 * math.log10(np.square(truth - truth.mean(axis=(0, 1))).mean())
    assert fitted_db([(grey, truth, TISSUE)]) == pytest.approx(expected, abs=1e-3)
    assert math.isnan(fitted_db([(grey, truth, ~TISSUE)]))
