"""Helpers of all command lines: add commands, create options from a model's fields, parse numbers."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from types import NoneType
from typing import Any, Literal, TypeAlias, get_args, get_origin

from intrasplat.commands.exits import EXIT_CODES_HELP, flag_of
from intrasplat.formats import ExportOptions
from intrasplat.options import ClipOptions, Options, parse_options

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""What ArgumentParser.add_subparsers returns."""


def add_command(
    commands: Commands, name: str, summary: str, command: Callable[[argparse.Namespace], int]
) -> argparse.ArgumentParser:
    """A parser for one command. It stores `command` in the namespace and lists the exit codes in its help."""
    description = f"{summary[0].upper()}{summary[1:]}."
    parser = commands.add_parser(name, help=summary, description=description, allow_abbrev=False)
    parser.epilog = EXIT_CODES_HELP
    parser.set_defaults(command=command)
    return parser


def add_options(
    parser: argparse.ArgumentParser, model: type[ClipOptions] | type[ExportOptions], *names: str, **overrides: Any
) -> None:
    """Add one command-line option for each named field of `model` (default: all): flag, type, choices and help.

    The namespace has None for an option that was not given. The parser refuses more than one of `model.exclusive`. In
    the help, the last word of an option's name stands for its value (--budget-s S), unless it lists choices.
    `overrides` go to every add_argument, such as nargs="+".
    """
    chosen = names or tuple(model.model_fields)
    has_exclusive = any(name in model.exclusive for name in chosen)
    exclusive = parser.add_mutually_exclusive_group() if has_exclusive else parser  # an empty group breaks --help
    for name in chosen:
        field = model.model_fields[name]
        kinds = [kind for kind in get_args(field.annotation) or (field.annotation,) if kind is not NoneType]
        settings: dict[str, Any] = {"default": None, "help": field.description}
        if get_origin(field.annotation) is Literal:
            settings["choices"] = kinds
        elif get_origin(kinds[0]) is Literal:
            settings["choices"] = get_args(kinds[0])
        else:
            is_positive = any(getattr(bound, "gt", None) == 0 for bound in field.metadata)
            settings["type"] = (positive if is_positive else finite) if kinds == [float] else kinds[0]
            settings["metavar"] = name.rsplit("_", 1)[-1].upper()
        if field.default is not None:
            settings["help"] = f"{field.description} (default: {field.default})"
        target = exclusive if name in model.exclusive else parser
        target.add_argument(flag_of(name), **(settings | overrides))


def given_options(namespace: argparse.Namespace, model: type[Options]) -> Options:
    """The options of add_options that the user gave, as a model; the others get its defaults.

    Raises:
        InputError: an option is invalid; the error names it.
    """
    values = {name: getattr(namespace, name) for name in model.model_fields}
    return parse_options(model, {name: value for name, value in values.items() if value is not None})


def finite(text: str) -> float:
    """An argument's number; ArgumentTypeError for text, NaN and infinity."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number.")
    return value


def positive(text: str) -> float:
    """An argument's number above 0; ArgumentTypeError for any other."""
    value = finite(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not above 0.")
    return value


def count(text: str) -> int:
    """An argument's whole number of at least 1; ArgumentTypeError for any other."""
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1.")
    return int(text)
