"""Least squares with bases that are local in time: only near bases overlap, so the normal equations are banded.

Symbols: K times, N series, C channels, B bases, W neighbours that overlap a basis on each side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

STEADINESS = 0.02
"""Weight of the differences between neighbouring bases; a fully trusted frame has 1. It bridges gaps in tracks."""
RIDGE = 1e-3
"""Weight of the squared basis weights: it keeps the system solvable."""
NO_OVERLAP = 1e-9
"""Bases whose product never exceeds this do not overlap; it is negligible against RIDGE."""


def fit_series(series: NDArray[np.floating], confidence: NDArray[np.floating], basis: Reals) -> Reals:
    """Weights [N, B, C] of the bases [K, B] that minimise, for each series [K, N, C] and channel,

    sum_k confidence_k |basis_k . w - series_k|^2 + STEADINESS sum_j |w_{j+1} - w_j|^2 + RIDGE |w|^2

    confidence is [K, N]. Time and memory grow as B W, not as B squared.
    """
    _, points, channels = series.shape
    bases = basis.shape[1]
    band = _normal(np.asarray(confidence.T, np.float64), basis)
    trusted = (series * confidence[..., None]).reshape(len(basis), -1)
    right = (basis.T @ trusted).reshape(bases, points, channels)
    _solve(band, right)
    return right.transpose(1, 0, 2)


def _normal(confidence: Reals, basis: Reals) -> list[Reals]:
    """The diagonals of the normal matrix: the d-th, [B - d, N], couples each basis with the d-th after it."""
    bases = basis.shape[1]
    band = []
    for apart in range(bases):
        overlap = basis[:, : bases - apart] * basis[:, apart:]
        if apart > 1 and not (overlap > NO_OVERLAP).any():
            break
        band.append(overlap.T @ confidence.T)
    band[0] += RIDGE
    if bases > 1:
        band[0][:-1] += STEADINESS
        band[0][1:] += STEADINESS
        band[1] -= STEADINESS
    return band


def _solve(band: list[Reals], right: Reals) -> None:
    """Solve N banded systems at once by L D L' (Golub and Van Loan 4.3), in place: right [B, N, C] gets the solutions.

    The systems are positive definite, so no pivoting is needed.
    """
    bases = len(right)
    for j in range(bases):
        below = [band[d][j] / band[0][j] for d in range(1, min(len(band), bases - j))]
        for d, factor in enumerate(below, start=1):
            for e in range(d, len(below) + 1):
                band[e - d][j + d] -= factor * band[e][j]
            right[j + d] -= factor[:, None] * right[j]
        right[j] /= band[0][j][:, None]
        for d, factor in enumerate(below, start=1):
            band[d][j] = factor
    for j in reversed(range(bases)):
        for d in range(1, min(len(band), bases - j)):
            right[j] -= band[d][j][:, None] * right[j + d]
