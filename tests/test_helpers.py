"""assert_close is the judge of the kernels, so it is judged first."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import assert_close


def test_assert_close_names_the_place_and_size_of_the_worst_difference() -> None:
    expected = np.ones((3, 4))
    actual = expected.copy()
    actual[1, 2] = 1.5
    actual[2, 0] = 1.1
    with pytest.raises(AssertionError, match=r"worst at \(1, 2\): 1.5, expected 1, difference 0.5 .* 2 of 12"):
        assert_close(actual, expected)


def test_assert_close_measures_against_the_largest_expected_value() -> None:
    assert_close(np.array([1000.05, 0.05]), np.array([1000.0, 0.0]))
    with pytest.raises(AssertionError):
        assert_close(np.array([0.05]), np.array([0.0]))


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_assert_close_refuses_what_is_not_finite(broken: float) -> None:
    with pytest.raises(AssertionError, match="1 NaN or infinity"):
        assert_close(np.array([0.0, broken]), np.zeros(2))


def test_assert_close_looks_only_where_it_is_told() -> None:
    actual = np.zeros((2, 2, 3))
    actual[0, 1] = 5.0
    kept = np.array([[True, False], [True, True]])
    assert_close(actual, np.zeros((2, 2, 3)), where=kept)
    with pytest.raises(AssertionError):
        assert_close(actual, np.zeros((2, 2, 3)), where=~kept)


def test_assert_close_refuses_another_shape() -> None:
    with pytest.raises(AssertionError, match="shape"):
        assert_close(np.zeros(3), np.zeros((3, 1)))
