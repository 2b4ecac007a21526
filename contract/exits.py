"""Exit codes of every intrasplat command, the same whether the work runs here or on a server."""

from __future__ import annotations

from enum import IntEnum

from contract.errors import Cancelled, InputError, IntrasplatError, UnavailableError


class ExitCode(IntEnum):
    """What a command's exit status says; scripts may rely on it."""

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
    """The exit code that tells of `error`."""
    if isinstance(error, InputError):
        return ExitCode.BAD_INPUT
    if isinstance(error, UnavailableError):
        return ExitCode.UNAVAILABLE
    if isinstance(error, Cancelled):
        return ExitCode.INTERRUPTED
    return ExitCode.FAILED
