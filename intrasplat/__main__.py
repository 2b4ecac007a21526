"""The `intrasplat` command.

reconstruct, render, export, measure, live, evaluate, poses and doctor work on this machine without a service. The
server (the distribution intrasplat-server) registers the other commands (intrasplat/server_parts.py).
"""

from __future__ import annotations

import argparse
import atexit
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from intrasplat.commands.arguments import add_command
from intrasplat.commands.exits import EXIT_CODES_HELP, ExitCode, end_by
from intrasplat.commands.local import LOCAL_COMMANDS
from intrasplat.errors import IntrasplatError, UnavailableError
from intrasplat.machine.cores import keep_libraries_to_one_thread
from intrasplat.server_parts import server_part

LABORATORY_COMMAND = "phantom"
"""Draws a synthetic clip. It is the laboratory's, which a checkout has and no installation."""
LABORATORY = Path(__file__).resolve().parents[1] / "lab" / LABORATORY_COMMAND
NO_SERVER = UnavailableError(
    "This command needs the server, which is not installed here.", "Install intrasplat-server."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in LOCAL_COMMANDS:
        return run_local(arguments)
    if arguments[:1] == [LABORATORY_COMMAND] and LABORATORY.is_dir():
        return int(import_module("lab.__main__").main(arguments))
    commands: Callable[[Sequence[str]], int] | None = server_part("commands")
    if commands is not None:
        return commands(arguments)
    if arguments and not arguments[0].startswith("-"):
        return end_by(NO_SERVER)
    _parser(None).parse_args(arguments)  # prints the help or the mistake, and exits
    return ExitCode.USAGE


def run_local(arguments: Sequence[str]) -> int:
    """Run a command of LOCAL_COMMANDS and return its exit code."""
    try:
        options = _parser(arguments[0]).parse_args(arguments)
        command: Callable[[argparse.Namespace], int] = options.command
        return command(options)
    except IntrasplatError as error:
        return end_by(error)
    except ModuleNotFoundError as error:
        return end_by(UnavailableError(f"{error.name} is not installed.", "`intrasplat doctor` names the remedy."))
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


def _parser(chosen: str | None) -> argparse.ArgumentParser:
    """The parser of the library's commands. Only the chosen command has its options. The others are not imported, so
    that --help and doctor answer at once, and doctor works without torch."""
    parser = argparse.ArgumentParser(
        prog="intrasplat",
        description="Dynamic 3D Gaussians of tissue from a stereo endoscope clip. Research use only.",
        epilog=EXIT_CODES_HELP,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in LOCAL_COMMANDS.items():
        if name == chosen:
            module = import_module(f"intrasplat.commands.{name}")
            module.add_cli_arguments(add_command(commands, name, summary, module.run_cli))
        else:
            commands.add_parser(name, help=summary, add_help=False)
    return parser


def _leave(code: int) -> NoReturn:
    """End this process at once. Python's own exit would first free every object of torch and Numba, which takes most of
    a second."""
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def command_line() -> NoReturn:
    """Run one command, then end the process: the entry point of `intrasplat` and `python -m intrasplat`."""
    keep_libraries_to_one_thread()  # must come before their import
    is_local = len(sys.argv) > 1 and sys.argv[1] in LOCAL_COMMANDS
    status = main()
    if is_local:
        _leave(status)
    sys.exit(status)


if __name__ == "__main__":
    command_line()
