"""Exit codes of every intrasplat command, local or on a server; and the error that a process leaves when it ends."""

from __future__ import annotations

import json
import os
import sys
from enum import IntEnum
from pathlib import Path

from intrasplat.errors import Cancelled, InputError, IntrasplatError, UnavailableError
from intrasplat.options import FIELD_PREFIX


class ExitCode(IntEnum):
    """The meaning of a command's exit status. Scripts may rely on it."""

    OK = 0
    USAGE = 2
    BAD_INPUT = 3
    FAILED = 4
    UNAVAILABLE = 5
    INTERRUPTED = 130


EXIT_CODES_HELP = (
    "exit codes: 0 ok, 2 wrong usage, 3 the input cannot be used, 4 the work failed, "
    "5 something needed is not there, 130 interrupted"
)


def exit_code_of(error: IntrasplatError) -> ExitCode:
    """The exit code for `error`."""
    if isinstance(error, InputError):
        return ExitCode.BAD_INPUT
    if isinstance(error, UnavailableError):
        return ExitCode.UNAVAILABLE
    if isinstance(error, Cancelled):
        return ExitCode.INTERRUPTED
    return ExitCode.FAILED


LAST_WORDS_VARIABLE = "INTRASPLAT_LAST_WORDS"
"""Environment variable set by Supervised: the file for last words, the UnavailableError that ends a process."""


def end_by(error: IntrasplatError) -> ExitCode:
    """Print on stderr why this process ends, write an UnavailableError as last words, and return the exit code."""
    print(f"intrasplat: {_in_flags(error)}", file=sys.stderr)
    if isinstance(error, UnavailableError):
        leave_last_words(error)
    return exit_code_of(error)


def leave_last_words(error: UnavailableError) -> bool:
    """Write the error for the process that started this one; False: no file was asked for, or writing failed."""
    path = os.environ.get(LAST_WORDS_VARIABLE)
    if not path:
        return False
    try:
        words = {"problem": error.problem, "remedy": error.remedy, "may_return": error.may_return}
        Path(path).write_text(json.dumps(words))
    except OSError:  # the disk may be full
        return False
    return True


def flag_of(name: str) -> str:
    """The command-line option of a name: budget_s is --budget-s."""
    return f"--{name.replace('_', '-')}"


def _in_flags(error: IntrasplatError) -> str:
    """The error's sentences, with options named as on the command line."""
    prefix = f"{FIELD_PREFIX}."
    if not isinstance(error, InputError) or not error.field.startswith(prefix):
        return str(error)
    return f"{flag_of(error.field.removeprefix(prefix))}: {error.problem} {error.remedy}"


def take_last_words(path: Path) -> UnavailableError | None:
    """Read and remove the last words of a process that has ended; None if it left none."""
    try:
        return UnavailableError(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    finally:
        path.unlink(missing_ok=True)
