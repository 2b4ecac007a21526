"""What the command lines of client and worker share: how a command is added, and which numbers can be meant."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TypeAlias

from contract.runtime.exits import EXIT_CODES_HELP

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""What ArgumentParser.add_subparsers returns."""


def add_command(
    commands: Commands, name: str, summary: str, command: Callable[[argparse.Namespace], int]
) -> argparse.ArgumentParser:
    """A parser for one command, which leaves `command` in the namespace and tells the exit codes in its help."""
    parser = commands.add_parser(name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
    parser.epilog = EXIT_CODES_HELP
    parser.set_defaults(command=command)
    return parser


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
        raise argparse.ArgumentTypeError(f"{text!r} is no number of at least 1.")
    return int(text)
