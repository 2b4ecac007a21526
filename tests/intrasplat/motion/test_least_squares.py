"""The banded least squares are those of the full normal equations."""

from __future__ import annotations

import numpy as np
import pytest

from intrasplat.motion.least_squares import RIDGE, STEADINESS, fit_series
from intrasplat.train.start import basis_values


@pytest.mark.parametrize(("frames", "bases"), [(5, 1), (5, 2), (20, 7), (87, 33), (300, 97)])
@pytest.mark.parametrize("gap", [False, True])
def test_a_fit_solves_the_full_normal_equations(frames: int, bases: int, *, gap: bool) -> None:
    random = np.random.default_rng(0)
    times = np.linspace(0, 0.99, frames) ** (3 if gap else 1)
    basis = basis_values(bases, times.tolist(), times.tolist())
    series = random.normal(size=(frames, 9, 6))
    confidence = random.random((frames, 9)) * (random.random((frames, 9)) < 0.7)
    differences = np.diff(np.eye(bases), axis=0)
    prior = STEADINESS * differences.T @ differences + RIDGE * np.eye(bases)
    normal = np.einsum("kn,ki,kj->nij", confidence, basis, basis) + prior
    wanted = np.linalg.solve(normal, np.einsum("ki,knc->nic", basis, series * confidence[..., None]))
    np.testing.assert_allclose(fit_series(series, confidence, basis), wanted, atol=1e-6)
