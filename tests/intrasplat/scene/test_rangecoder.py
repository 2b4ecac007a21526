"""Tables are decoded as they were encoded, from few bytes; any other code is refused."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.scene.rangecoder import (
    MAX_BIT_COST,
    MAX_MAGNITUDE,
    ONE,
    PARTS,
    _bound,
    _update_probability,
    decode,
    encode,
)
from tests.conftest import REPOSITORY

GOLDEN_TABLE = [[0, 3, -1, 700, 0], [1, 2, 0, -650, 0], [0, -4, 0, 723, 0], [-1, 5, 0, 0, 1], [0, 3, 0, -9, 0]]
GOLDEN_CODES = ("00666dc79cf1a99a00", "009fff8000", "00ffc5ad66a162abb6f63b3c1a00", "00137444e2")


def table_of(count: int, rows: int, spread: float, seed: int = 0) -> NDArray[np.int32]:
    """Laplacian numbers, each row twice as wide as the one before, up to eight times."""
    widths = spread * 2.0 ** (np.arange(rows) % 4)
    return np.rint(np.random.default_rng(seed).laplace(0, widths, (count, rows))).astype(np.int32)


@pytest.mark.parametrize("spread", [0.0, 0.1, 1.0, 30.0, 1e5])
@pytest.mark.parametrize(("count", "rows"), [(1, 1), (1, 9), (7, 3), (500, 13)])
def test_every_table_comes_back(count: int, rows: int, spread: float) -> None:
    table = table_of(count, rows, spread)
    np.testing.assert_array_equal(decode(encode(table), count, rows), table)


def test_the_largest_numbers_come_back_and_larger_ones_are_refused() -> None:
    table = np.array([[MAX_MAGNITUDE, -MAX_MAGNITUDE, 0, 1, -1]] * 40, np.int32)
    table[::3] = 0
    np.testing.assert_array_equal(decode(encode(table), *table.shape), table)
    with pytest.raises(ValueError, match=str(MAX_MAGNITUDE + 1)):
        encode(np.array([[MAX_MAGNITUDE + 1]], np.int32))


def test_the_code_is_nearly_as_short_as_the_numbers_distribution_allows() -> None:
    table = table_of(20_000, 4, 1.5)
    shares = [np.unique(table[:, row], return_counts=True)[1] / len(table) for row in range(4)]
    entropy_bytes = sum(-(share * np.log2(share)).sum() for share in shares) * len(table) / 8
    assert sum(map(len, encode(table))) < 1.03 * entropy_bytes + 200


def test_zeros_cost_next_to_nothing() -> None:
    assert sum(map(len, encode(np.zeros((5000, 20), np.int32)))) < 700


def test_where_numbers_are_large_together_they_cost_less() -> None:
    random = np.random.default_rng(0)
    calm = random.integers(0, 2, (3000, 1)) * 5.0
    together = np.rint(random.laplace(0, 0.1 + calm, (3000, 60))).astype(np.int32)
    apart = random.permuted(together, axis=0)
    assert sum(map(len, encode(together))) < 0.95 * sum(map(len, encode(apart)))


def test_the_same_table_has_the_same_code() -> None:
    table = table_of(300, 8, 3.0)
    assert encode(table) == encode(table.copy())


def test_a_code_that_ends_too_soon_or_too_late_is_refused() -> None:
    codes = encode(table_of(200, 8, 5.0))
    for part in range(PARTS):
        for broken in (codes[part][:-40], codes[part] + b"\0" * 40, b""):
            with pytest.raises(ValueError, match="does not end"):
                decode([*codes[:part], broken, *codes[part + 1 :]], 200, 8)
    with pytest.raises(ValueError, match="instead of 4"):
        decode(codes[:-1], 200, 8)


def test_noise_never_reads_beyond_its_end() -> None:
    random = np.random.default_rng(0)
    for size in (0, 1, 5, 300):
        noise = [random.bytes(size) for _ in range(PARTS)]
        with pytest.raises(ValueError, match="does not end"):
            decode(noise, 400, 12)
    with pytest.raises(ValueError, match="does not end"):
        decode([b"\xff" * 400] * PARTS, 400, 12)


def test_files_of_today_are_read_tomorrow() -> None:
    """Another constant of the coder would make other bytes, and every stored scene unreadable."""
    table = np.array(GOLDEN_TABLE, np.int32)
    assert tuple(code.hex() for code in encode(table)) == GOLDEN_CODES
    np.testing.assert_array_equal(decode([bytes.fromhex(code) for code in GOLDEN_CODES], *table.shape), table)


@pytest.mark.parametrize("bit", [0, 1])
@pytest.mark.parametrize("width", [1 << 24, (1 << 24) + 65535, (1 << 32) - 1])
def test_no_bit_costs_more_than_the_limit(bit: int, width: int) -> None:
    models = np.full((1, 2), ONE // 2, np.uint16)
    for _ in range(3000):
        _update_probability(models, 0, 1 - bit)
    below = int(_bound(np.uint64(width), models, 0))
    left = width - below if bit else below
    assert np.log2(width / left) < MAX_BIT_COST


def test_the_buffer_holds_numbers_that_are_never_as_expected() -> None:
    """Long rests teach that there are only zeros; then each number costs the most it can."""
    table = np.zeros((3000, 4), np.int32)
    table[2999] = [MAX_MAGNITUDE, -MAX_MAGNITUDE, 5, 2]
    np.testing.assert_array_equal(decode(encode(table), *table.shape), table)
    lone = np.full((1, 400), MAX_MAGNITUDE, np.int32)
    np.testing.assert_array_equal(decode(encode(lone), *lone.shape), lone)


def test_a_carry_runs_through_bytes_that_are_full() -> None:
    tables = [np.random.default_rng(seed).integers(-3, 4, (2000, 8), np.int32) for seed in range(8)]
    for table in tables:
        np.testing.assert_array_equal(decode(encode(table), *table.shape), table)


def test_the_coder_needs_no_rasteriser_and_complains_once_where_nothing_can_be_kept(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    program = (
        "import sys, intrasplat.scene.rangecoder; from intrasplat.machine.cache import use_kernel_cache as use; use(); "
    )
    program += "print('intrasplat.splat' in sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", program],
        cwd=REPOSITORY, env={**os.environ, "INTRASPLAT_CACHE": str(tmp_path / "file")},
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert result.stdout.split() == ["False"]
    assert result.stderr.count("compiled kernels cannot be kept") == 1
