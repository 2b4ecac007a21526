"""The vectors' own arithmetic against numpy, and what is not vector memory."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numpy.typing import NDArray

from intrasplat.splat.cpu import simd, update
from intrasplat.splat.cpu.vectors import LANES


@njit
def exp2_of(values, powers):  # type: ignore[no-untyped-def]
    for i in range(0, values.shape[0], LANES):
        simd.store(powers, i, simd.exp2(simd.load(values, i)))


@njit
def log2_of(high, low):  # type: ignore[no-untyped-def]
    """A number is the sum of two float32 here: more digits than the error has; its logarithm takes its place."""
    for i in range(0, high.shape[0], LANES):
        logarithm = simd.log2(simd.widen(simd.load(high, i)) + simd.widen(simd.load(low, i)))
        rounded = simd.narrow(logarithm)
        simd.store(high, i, rounded)
        simd.store(low, i, simd.narrow(logarithm - simd.widen(rounded)))


@njit
def bytes_of(array, out):  # type: ignore[no-untyped-def]
    simd.store(out, 0, simd.load_bytes(array, 0))


@njit
def claimed(counter):  # type: ignore[no-untyped-def]
    return simd.claim(counter)


def exp2(values: NDArray[np.float32]) -> NDArray[np.float64]:
    powers = np.zeros_like(values)
    exp2_of(values, powers)
    return powers.astype(np.float64)


def test_exp2_is_as_exact_as_its_table_says() -> None:
    halves = np.arange(-120, 126.25, 0.5, dtype=np.float32)  # where the remainder is largest
    spread = np.random.default_rng(0).uniform(-120, 126, 1 << 16).astype(np.float32)
    values = np.concatenate([halves, spread])
    values = np.concatenate([values, np.zeros(-len(values) % LANES, np.float32)])
    expected = np.exp2(values.astype(np.float64))
    assert np.abs(exp2(values) / expected - 1).max() < 2.2e-7


def test_exp2_of_anything_below_minus_120_is_that_of_minus_120() -> None:
    values = np.array([-120, -120.5, -126, -127, -150, -1e4, -3e38, -np.inf], np.float32)
    assert exp2(values) == pytest.approx(np.full(8, 2.0**-120), rel=2.2e-7)


def test_exp2_of_no_number_is_no_number() -> None:
    assert bool(np.isnan(exp2(np.full(LANES, np.nan, np.float32))).all())


def test_log2_is_as_exact_as_its_table_says() -> None:
    half_root = np.sqrt(0.5) * (1 + 1e-12)  # where the series is longest
    spread = np.exp2(np.linspace(-120, 120, (1 << 14) - 4) + 0.1)
    values = np.concatenate([[half_root, 2 * half_root, 1, 1 + 1e-9], spread])
    high = values.astype(np.float32)
    low = (values - high).astype(np.float32)
    values = high.astype(np.float64) + low
    log2_of(high, low)
    assert np.abs(high.astype(np.float64) + low - np.log2(values)).max() < 1e-9


@pytest.mark.parametrize(
    "no_memory",
    [np.zeros((16, 2), np.float32)[:, 0], np.zeros(16), np.zeros(16, np.int32), np.zeros((2, 8), np.float32)],
    ids=["strided", "float64", "int32", "2-D"],
)
def test_only_dense_rows_of_float32_are_vector_memory(no_memory: np.ndarray) -> None:
    dense = np.zeros(16, np.float32)
    with pytest.raises(TypingError, match="1-D C-contiguous arrays of float32"):
        update.adam(0, 1, no_memory, dense, dense, dense, *[np.float32(1)] * 4)
    with pytest.raises(TypingError, match="1-D C-contiguous arrays of float32"):
        update.adam(0, 1, dense, no_memory, dense, dense, *[np.float32(1)] * 4)


def test_bytes_are_loaded_from_bytes_and_numbers_claimed_from_int64_alone() -> None:
    out = np.zeros(LANES, np.float32)
    bytes_of(np.arange(248, 256, dtype=np.uint8), out)
    assert out.tolist() == list(range(248, 256))
    with pytest.raises(TypingError, match="arrays of uint8"):
        bytes_of(np.zeros(LANES, np.float32), out)
    counter = np.array([3], np.int64)
    assert (claimed(counter), claimed(counter), counter[0]) == (3, 4, 5)
    with pytest.raises(TypingError, match="arrays of int64"):
        claimed(np.zeros(1, np.int32))
