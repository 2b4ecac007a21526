"""The parser of all commands of `intrasplat`, and those that need no worker on this machine."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import ValidationError

from client.backup import add_backup
from client.keys import add_keys
from client.remote import add_remote
from client.slicer.command import add_slicer
from contract.runtime.arguments import Commands, add_command, count
from contract.runtime.exits import EXIT_CODES_HELP, ExitCode, exit_code_of
from contract.runtime.local import LOCAL_COMMANDS, WORKER_SUMMARY
from contract.runtime.settings import Settings, default_data_dir
from contract.wire.errors import InputError, IntrasplatError

EXAMPLES = """\
a clip on this machine:
  intrasplat reconstruct left.mp4 right.mp4 --calibration calibration.json --out scene
  intrasplat render scene --t 0.4 --pose orbit:10,0,1 --out view.png
through a service:
  intrasplat up
  intrasplat submit clip.mp4 --calibration calibration.json --watch
  intrasplat fetch JOB --out results
"""


def run(arguments: Sequence[str]) -> int:
    """Run one of these commands and return its exit code."""
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except IntrasplatError as error:
        print(f"intrasplat: {error}", file=sys.stderr)
        return exit_code_of(error)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except BrokenPipeError:  # the reader, such as head, has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="intrasplat",
        description="Dynamic 3D Gaussians of tissue from a stereo endoscope clip. Research use only.",
        epilog=f"{EXAMPLES}\n{EXIT_CODES_HELP}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in LOCAL_COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)  # the worker parses its options
    _add_up(commands)
    commands.add_parser("worker", help=WORKER_SUMMARY, add_help=False)
    add_remote(commands)
    add_slicer(commands)
    add_keys(commands)
    add_backup(commands)
    return parser


def _add_up(commands: Commands) -> None:
    parser = add_command(commands, "up", "start a queue, the service and its workers on this machine", _up)
    parser.add_argument("--port", type=int, help="where the service answers (default: 8765)")
    parser.add_argument(
        "--host",
        help="address to listen on (default: 127.0.0.1, for this machine alone; others need `intrasplat keys`)",
    )
    parser.add_argument(
        "--data-dir", type=Path, metavar="DIR", help=f"where clips and scenes are kept (default: {default_data_dir()})"
    )
    parser.add_argument(
        "--workers",
        type=count,
        default=1,
        metavar="N",
        help="clips trained at a time; they share the cores (default: 1)",
    )
    parser.add_argument("--log-format", choices=("text", "json"), help="of service and workers (default: text)")


def _up(options: argparse.Namespace) -> int:
    from client.up import run  # imports the queue's client, which no other command needs

    names = ("port", "host", "data_dir", "log_format")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    try:
        settings = Settings.model_validate({**Settings.from_environment().model_dump(), **given})
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"--{first['loc'][0]}".replace("_", "-"), f"{first['msg']}.", "See --help.") from error
    run(settings, options.workers)
    return ExitCode.OK
