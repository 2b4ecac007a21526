"""`python -m lab COMMAND`: the commands of the laboratory, from a checkout."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from intrasplat.commands.arguments import add_command
from intrasplat.commands.exits import EXIT_CODES_HELP, ExitCode, end_by
from intrasplat.errors import IntrasplatError
from intrasplat.machine.cores import keep_libraries_to_one_thread

COMMANDS = {
    "phantom": ("lab.phantom.command", "make a synthetic stereo clip of tissue, with its truth"),
    "evaluate": ("lab.evaluate.command", "measure presets on clips, and draw speed against accuracy"),
    "stability": (
        "lab.evaluate.stability_command",
        "spoil synthetic clips in many ways, and draw where presets break and whether they say so",
    ),
}
"""The module with add_cli_arguments and run_cli, and a summary, by command."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(prog="python -m lab", epilog=EXIT_CODES_HELP)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, (module_name, summary) in COMMANDS.items():
        if arguments[:1] == [name]:
            module = import_module(module_name)
            module.add_cli_arguments(add_command(commands, name, summary, module.run_cli))
        else:
            commands.add_parser(name, help=summary, add_help=False)
    try:
        options = parser.parse_args(arguments)
        command: Callable[[argparse.Namespace], int] = options.command
        return command(options)
    except IntrasplatError as error:
        return end_by(error)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


if __name__ == "__main__":
    keep_libraries_to_one_thread()
    sys.exit(main())
