"""Numbers on a command line: what cannot be meant is refused in a sentence."""

from __future__ import annotations

import argparse
from collections.abc import Callable

import pytest

from contract.runtime.arguments import finite, positive


def test_numbers_are_taken_as_they_are() -> None:
    assert finite("-2.5") == -2.5
    assert positive("1e3") == 1000


@pytest.mark.parametrize(
    ("parse", "text", "says"),
    [
        (finite, "soon", "'soon' is not a number."),
        (finite, "nan", "'nan' is not a number."),
        (finite, "-inf", "'-inf' is not a number."),
        (positive, "soon", "'soon' is not a number."),
        (positive, "0", "0 is not above 0."),
        (positive, "-1", "-1 is not above 0."),
    ],
)
def test_others_are_refused_in_a_sentence(parse: Callable[[str], float], text: str, says: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError) as refused:
        parse(text)
    assert str(refused.value) == says
