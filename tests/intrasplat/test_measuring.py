"""Points as callers write them."""

from __future__ import annotations

import pytest

from intrasplat.errors import InputError
from intrasplat.measuring import MAX_POINTS, parse_points


def test_points_are_pairs_of_numbers() -> None:
    assert parse_points("320,256") == ((320.0, 256.0),)
    assert parse_points("1.5, 2 ;-3,4e1") == ((1.5, 2.0), (-3.0, 40.0))


@pytest.mark.parametrize(
    "text", ["", ";", "1", "1,2,3", "1,2;", "a,b", "nan,1", "1,inf", "1;2", ";".join(["1,2"] * 17)]
)
def test_what_are_no_points_is_refused_with_a_remedy(text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_points(text)
    assert refused.value.field == "points"
    assert str(MAX_POINTS) in refused.value.remedy
