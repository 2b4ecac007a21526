"""A table's numbers as differences from the mean of the two beside them, where neighbours are alike.

Symbols: N Gaussians in an order in which neighbours are near, K columns, G groups of columns.

Every second Gaussian lies between two others; of those others every second one does, and so on: Gaussian i lies
between i - s and i + s, s being the largest power of two that divides i, and the last ones, right of which nothing is,
between one and the same. So a table is told from the coarsest level to the finest, and undone in that order.

A number stands for itself times 2**-power, the power being its Gaussian's in the column's group. Everything is integer
arithmetic.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worker.machine.cache import kernel

Table = NDArray[np.int32]
Powers = NDArray[np.int64]

FINEST = 4
"""The largest power there may be."""
LARGEST_STORED = 2**28
"""Of a number's magnitude, and of a difference's. The coder takes four times that."""


def told_order(count: int) -> NDArray[np.int64]:
    """[N] Gaussians in the order in which they are told: the first, then those between, coarse levels first."""
    levels = [1 << level for level in reversed(range((count - 1).bit_length()))]
    return np.concatenate([np.zeros(1, np.int64), *(np.arange(step, count, 2 * step) for step in levels)])


def take_differences(table: Table, power: Powers, group: NDArray[np.int64]) -> tuple[Table, NDArray[np.bool_]]:
    """The table in the order in which it is told, and which columns [K] hold differences: those that get smaller by it.

    Args:
        table: [N, K], magnitudes up to LARGEST_STORED.
        power: [N, G] up to FINEST; group: [K] in [0, G).
    """
    told = told_order(len(table))
    stored: Table = np.empty(table.shape, np.int32)
    before, after, largest = np.zeros((3, table.shape[1]), np.int64)
    _subtract(table, power, group, _runs(group), told, stored, before, after, largest)
    helped = (after < before) & (largest <= LARGEST_STORED)
    _put_back(table, told, ~helped, stored)
    return stored, helped


def add_differences(table: Table, power: Powers, group: NDArray[np.int64], wanted: NDArray[np.bool_]) -> None:
    """Numbers instead of differences in the wanted columns [K] of a table [N, K] in the Gaussians' order, in place.

    Raises:
        ValueError: a number exceeds LARGEST_STORED.
    """
    if not _add(table, power, group, _runs(group), told_order(len(table)), wanted):
        raise ValueError(f"a number exceeds {LARGEST_STORED}")


def _runs(group: NDArray[np.int64]) -> NDArray[np.intp]:
    """Where runs of columns of one group begin, and K: what their columns have in common is looked up once."""
    return np.flatnonzero(np.diff(group, prepend=-1, append=-1))


@kernel
def _beside(count, i, power, g):  # type: ignore[no-untyped-def]
    """Of Gaussian i, in a group: the two it lies between, how far their numbers go up, and how far their sum down."""
    left, right = i - (i & -i), i + (i & -i)
    if right >= count:
        right = left
    return left, right, FINEST - power[left, g], FINEST - power[right, g], FINEST + 1 - power[i, g]


@kernel
def _mean(first, second, up, also_up, down):  # type: ignore[no-untyped-def]
    """Of two numbers, as a multiple of the unit of the one between them, rounded."""
    half = np.int64(1) << (down - 1)
    return ((np.int64(first) << up) + (np.int64(second) << also_up) + half) >> down


@kernel
def _subtract(table, power, group, runs, told, stored, before, after, largest):  # type: ignore[no-untyped-def]
    """Into stored [N, K], and each column's sum of magnitudes before and after, and the largest one after."""
    for place, i in enumerate(told):
        for run in range(len(runs) - 1):
            left, right, up, also_up, down = _beside(len(table), i, power, group[runs[run]])
            for k in range(runs[run], runs[run + 1]):
                number = np.int64(table[i, k])
                difference = number - (_mean(table[left, k], table[right, k], up, also_up, down) if i else 0)
                stored[place, k] = difference  # where it does not fit, the column is not used
                before[k] += abs(number)
                after[k] += abs(difference)
                largest[k] = max(largest[k], abs(difference))


@kernel
def _put_back(table, told, wanted, stored):  # type: ignore[no-untyped-def]
    for place, i in enumerate(told):
        for k in range(table.shape[1]):
            if wanted[k]:
                stored[place, k] = table[i, k]


@kernel
def _add(table, power, group, runs, told, wanted):  # type: ignore[no-untyped-def]
    """Returns whether all numbers are within LARGEST_STORED."""
    most = np.int64(0)
    for i in told[1:]:
        for run in range(len(runs) - 1):
            left, right, up, also_up, down = _beside(len(table), i, power, group[runs[run]])
            for k in range(runs[run], runs[run + 1]):
                if wanted[k]:
                    number = table[i, k] + _mean(table[left, k], table[right, k], up, also_up, down)
                    most = max(most, abs(number))
                    table[i, k] = number
        if most > LARGEST_STORED:
            return False
    return True
