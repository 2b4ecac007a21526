"""Differences between neighbours come back as the numbers they were, whatever the powers, or are not used."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.scene.differences import MAX_POWER, MAX_STORED, add_differences, coding_order, take_differences

GROUP = np.array([0, 0, 1, 2, 2, 0, 1])


def back(stored: NDArray[np.int32], power: NDArray[np.int64], differenced: NDArray[np.bool_]) -> NDArray[np.int32]:
    table = np.empty_like(stored)
    table[coding_order(len(stored))] = stored
    add_differences(table, power, GROUP, differenced)
    return table


def powers_of(count: int) -> NDArray[np.int64]:
    return np.random.default_rng(1).integers(-3, MAX_POWER + 1, (count, 3))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 64, 65, 1000])
def test_every_gaussian_is_coded_once_after_its_neighbours(count: int) -> None:
    order = coding_order(count)
    assert sorted(order) == list(range(count))
    place = np.argsort(order)
    for i in range(1, count):
        step = i & -i
        assert place[i - step] < place[i]
        assert i + step >= count or place[i + step] < place[i]


@pytest.mark.parametrize("count", [1, 2, 3, 10, 257])
def test_numbers_come_back(count: int) -> None:
    random, power = np.random.default_rng(count), powers_of(count)
    smooth = np.cumsum(random.normal(0, 3, (count, 7)), axis=0) * 100
    table = np.rint(smooth * 2.0 ** power[:, GROUP]).astype(np.int32)
    stored, differenced = take_differences(table, power, GROUP)
    assert differenced.any() == (count > 1)
    np.testing.assert_array_equal(back(stored, power, differenced), table)


def test_differences_that_no_number_holds_are_not_used() -> None:
    """A coarse neighbour's number, in the unit of a fine one, may be a hundred times the largest there is."""
    count = 64
    power = np.where(np.arange(count) % 2, MAX_POWER, -3)[:, None].repeat(3, 1)
    table = np.full((count, 7), MAX_STORED, np.int32)
    table[1:4] = 0
    stored, differenced = take_differences(table, power, GROUP)
    assert np.abs(stored).max() <= MAX_STORED
    np.testing.assert_array_equal(back(stored, power, differenced), table)


def test_columns_of_which_few_differences_are_too_large_stay_as_they_are() -> None:
    power = np.zeros((9, 3), np.int64)
    table = np.full((9, 7), MAX_STORED, np.int32)
    assert take_differences(table, power, GROUP)[1].all()
    table[4:7, 0] = -MAX_STORED  # beside a number of the other sign: twice the largest apart
    stored, differenced = take_differences(table, power, GROUP)
    assert list(differenced) == [False] + [True] * 6
    np.testing.assert_array_equal(back(stored, power, differenced), table)


def test_sums_that_leave_the_numbers_are_refused() -> None:
    table = np.full((3, 7), MAX_STORED, np.int32)
    with pytest.raises(ValueError, match="exceeds"):
        add_differences(table, np.zeros((3, 3), np.int64), GROUP, np.ones(7, bool))
