"""The commands that the server adds to `intrasplat`: up and worker run a service; keys, backup and restore maintain it;
the others are its clients. intrasplat/__main__.py runs them, and the library's own commands."""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import ValidationError

from client.backup import add_backup
from client.feeds import add_feeds
from client.keys import add_keys
from client.remote import add_remote
from client.slicer.command import add_slicer
from contract.runtime.settings import Settings, default_data_dir
from intrasplat.__main__ import run_local
from intrasplat.commands.arguments import Commands, add_command, count
from intrasplat.commands.exits import EXIT_CODES_HELP, ExitCode, exit_code_of
from intrasplat.commands.local import LOCAL_COMMANDS
from intrasplat.errors import InputError, IntrasplatError

EXAMPLES = """\
a clip on this machine:
  intrasplat reconstruct left.mp4 right.mp4 --calibration calibration.json --out scene
  intrasplat render scene --t 0.4 --pose orbit:10,0,1 --out view.png
through a service:
  intrasplat up
  intrasplat submit clip.mp4 --calibration calibration.json --watch
  intrasplat fetch JOB --out results
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in LOCAL_COMMANDS:
        return run_local(arguments)
    if arguments and arguments[0] == "worker":
        return _run_worker(arguments[1:])
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


def _run_worker(arguments: Sequence[str]) -> int:
    """Replace this process with the worker's program, so that the worker gets signals and sets the exit status."""
    command = [sys.executable, "-m", "worker", "consume", *arguments]
    if os.name == "posix":
        os.execv(sys.executable, command)
    process = subprocess.Popen(command)  # no exec on Windows, where the caller would not wait
    while True:
        with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C reaches both processes; the worker decides
            return process.wait()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="intrasplat",
        description="Dynamic 3D Gaussians of tissue from a stereo endoscope clip. Research use only.",
        epilog=f"{EXAMPLES}\n{EXIT_CODES_HELP}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in LOCAL_COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)  # they parse their own options
    _add_up(commands)
    worker = "claim jobs from the queue of REDIS_URL and serve renders, until a signal ends it"
    commands.add_parser("worker", help=worker, add_help=False)
    add_remote(commands)
    add_feeds(commands)
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


if __name__ == "__main__":
    sys.exit(main())
