"""Options of a reconstruction, and what is said of wrong ones."""

from __future__ import annotations

import pytest

from intrasplat.errors import InputError
from intrasplat.options import ReconstructionOptions, parse_options


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("iterations", 0, "how many steps"),
        ("holdout", "everyday", "every8, blocks8, none"),
        ("sed", 1, "Did you mean seed?"),
    ],
)
def test_a_wrong_option_is_named_with_what_it_is_for(name: str, value: object, remedy: str) -> None:
    with pytest.raises(InputError) as wrong:
        parse_options(ReconstructionOptions, {name: value})
    assert wrong.value.field == f"options.{name}"
    assert remedy in wrong.value.remedy
