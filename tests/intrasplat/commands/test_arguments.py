"""Numbers on a command line: what cannot be meant is refused in a sentence."""

from __future__ import annotations

import argparse
from collections.abc import Callable

import pytest

from intrasplat.commands.arguments import add_options, finite, given_options, positive
from intrasplat.commands.exits import flag_of
from intrasplat.errors import InputError
from intrasplat.options import JobOptions, ReconstructionOptions


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


def parsed(*arguments: str) -> ReconstructionOptions:
    parser = argparse.ArgumentParser()
    add_options(parser, ReconstructionOptions)
    return given_options(parser.parse_args(arguments), ReconstructionOptions)


def test_every_field_of_the_options_is_an_option_of_the_command_line_with_its_choices_and_default() -> None:
    parser = argparse.ArgumentParser()
    add_options(parser, JobOptions)
    told = " ".join(parser.format_help().split())
    for name, field in JobOptions.model_fields.items():
        assert flag_of(name) in told
        assert field.description is not None
        assert field.description in told
    assert "{auto,tool,tissue}" in told
    assert "(default: fast)" in told


def test_what_is_not_given_is_the_models_default_and_not_sent() -> None:
    assert parsed() == ReconstructionOptions()
    given = parsed("--budget-s", "20", "--layout", "sbs")
    assert given.model_dump(exclude_unset=True) == {"budget_s": 20.0, "layout": "sbs"}


@pytest.mark.parametrize("arguments", [("--budget-s", "1", "--iterations", "1"), ("--seed", "x"), ("--layout", "mono")])
def test_wrong_usage_is_refused_by_the_parser(arguments: tuple[str, ...]) -> None:
    with pytest.raises(SystemExit):
        parsed(*arguments)


def test_a_value_out_of_bounds_names_its_option() -> None:
    with pytest.raises(InputError) as refused:
        parsed("--iterations", "0")
    assert refused.value.field == "options.iterations"
