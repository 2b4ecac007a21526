"""Store differences from the mean of two neighbours, in the columns where they are smaller than the numbers.

Symbols: N Gaussians in an order in which neighbours are near, K columns, G groups of columns.

Gaussian i is predicted from i - s and i + s, where s is the largest power of two that divides i: every second Gaussian
from the two beside it, then every second of the rest, and so on. Where there is no right neighbour, the left one counts
twice. The table is coded from the coarsest level to the finest, and decoded in the same order.

The value of a number is the number times 2**-power, with its Gaussian's power in the column's group. All arithmetic is
on integers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from intrasplat.machine.cache import kernel

Table = NDArray[np.int32]
Powers = NDArray[np.int64]

MAX_POWER = 4
MAX_STORED = 2**28
"""Largest magnitude of a number or a difference; the range coder allows four times as much."""


def coding_order(count: int) -> NDArray[np.int64]:
    """[N] Gaussians in the order in which they are coded: the first, then level after level from the coarsest."""
    levels = [1 << level for level in reversed(range((count - 1).bit_length()))]
    return np.concatenate([np.zeros(1, np.int64), *(np.arange(step, count, 2 * step) for step in levels)])


def take_differences(table: Table, power: Powers, group: NDArray[np.int64]) -> tuple[Table, NDArray[np.bool_]]:
    """The table in coding order, and which columns [K] contain differences: those whose sum of magnitudes falls by it.

    Args:
        table: [N, K], magnitudes up to MAX_STORED.
        power: [N, G] up to MAX_POWER; group: [K] in [0, G).
    """
    order = coding_order(len(table))
    stored: Table = np.empty(table.shape, np.int32)
    before, after, largest = np.zeros((3, table.shape[1]), np.int64)
    _subtract(table, power, group, _runs(group), order, stored, before, after, largest)
    differenced = (after < before) & (largest <= MAX_STORED)
    _copy_columns(table, order, ~differenced, stored)
    return stored, differenced


def add_differences(table: Table, power: Powers, group: NDArray[np.int64], differenced: NDArray[np.bool_]) -> None:
    """Turn differences back into numbers, in place, in the differenced columns [K] of a table [N, K] in Gaussian order.

    Raises:
        ValueError: a number exceeds MAX_STORED.
    """
    if not _add(table, power, group, _runs(group), coding_order(len(table)), differenced):
        raise ValueError(f"a number exceeds {MAX_STORED}")


def _runs(group: NDArray[np.int64]) -> NDArray[np.intp]:
    """First column of each run of columns of one group, and K."""
    return np.flatnonzero(np.diff(group, prepend=-1, append=-1))


@kernel
def _neighbours(count, i, power, g):  # type: ignore[no-untyped-def]
    """Both neighbours of Gaussian i in group g; by how many bits to shift their numbers up, and their sum down."""
    left, right = i - (i & -i), i + (i & -i)
    if right >= count:
        right = left
    return left, right, MAX_POWER - power[left, g], MAX_POWER - power[right, g], MAX_POWER + 1 - power[i, g]


@kernel
def _mean(first, second, up, also_up, down):  # type: ignore[no-untyped-def]
    """Rounded mean of two neighbours' numbers, in the unit of the Gaussian between them."""
    half = np.int64(1) << (down - 1)
    return ((np.int64(first) << up) + (np.int64(second) << also_up) + half) >> down


@kernel
def _subtract(table, power, group, runs, order, stored, before, after, largest):  # type: ignore[no-untyped-def]
    """Write differences to stored [N, K]; count each column's magnitudes before and after, and the largest after."""
    for place, i in enumerate(order):
        for run in range(len(runs) - 1):
            left, right, up, also_up, down = _neighbours(len(table), i, power, group[runs[run]])
            for k in range(runs[run], runs[run + 1]):
                number = np.int64(table[i, k])
                difference = number - (_mean(table[left, k], table[right, k], up, also_up, down) if i else 0)
                stored[place, k] = difference  # may overflow int32; then the column keeps its numbers
                before[k] += abs(number)
                after[k] += abs(difference)
                largest[k] = max(largest[k], abs(difference))


@kernel
def _copy_columns(table, order, copied, stored):  # type: ignore[no-untyped-def]
    for place, i in enumerate(order):
        for k in range(table.shape[1]):
            if copied[k]:
                stored[place, k] = table[i, k]


@kernel
def _add(table, power, group, runs, order, differenced):  # type: ignore[no-untyped-def]
    """Add the means back, level after level; return whether all numbers are within MAX_STORED."""
    largest = np.int64(0)
    for i in order[1:]:
        for run in range(len(runs) - 1):
            left, right, up, also_up, down = _neighbours(len(table), i, power, group[runs[run]])
            for k in range(runs[run], runs[run + 1]):
                if differenced[k]:
                    number = table[i, k] + _mean(table[left, k], table[right, k], up, also_up, down)
                    largest = max(largest, abs(number))
                    table[i, k] = number
        if largest > MAX_STORED:
            return False
    return True
