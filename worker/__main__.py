"""`python -m worker consume` claims and trains jobs; `python -m worker device` is the child process that it starts,
and `python -m worker feed` that of a live feed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

from contract.runtime import traces
from contract.runtime.logs import configure
from contract.runtime.settings import Settings
from intrasplat.commands.arguments import add_command
from intrasplat.commands.exits import EXIT_CODES_HELP, ExitCode, end_by
from intrasplat.errors import IntrasplatError, UnavailableError
from intrasplat.machine.cores import keep_libraries_to_one_thread
from intrasplat.machine.processes import shutdown_event

SUMMARY = "claim jobs from the queue of REDIS_URL and serve renders, until a signal ends it"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of the two commands and return its exit code."""
    try:
        options = _parser().parse_args(argv)
        command: Callable[[argparse.Namespace], int] = options.command
        return command(options)
    except IntrasplatError as error:
        return end_by(error)
    except ModuleNotFoundError as error:
        return end_by(UnavailableError(f"{error.name} is not installed.", "`intrasplat doctor` names the remedy."))
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m worker", epilog=EXIT_CODES_HELP)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    consume = add_command(commands, "consume", SUMMARY, _consume)
    consume.prog = "intrasplat worker"
    consume.add_argument(
        "--renders-only", action="store_true", help="claim no jobs, only answer renders of finished scenes"
    )
    add_command(commands, "device", "started by consume: train and render on orders from stdin", _device)
    add_command(commands, "feed", "started by consume: follow a live feed on orders from stdin", _feed)
    return parser


def _consume(options: argparse.Namespace) -> int:
    settings = Settings.from_environment()
    configure(settings, "worker")
    traces.configure("worker", settings.worker_name)
    if settings.redis_url is None:
        raise UnavailableError("REDIS_URL is not set.", "Use `intrasplat up`, which starts a queue and a worker.")
    from worker.supervisor import run_supervisor

    run_supervisor(settings, shutdown_event(), renders_only=options.renders_only)
    return ExitCode.OK


def _device(options: argparse.Namespace) -> int:
    settings = Settings.from_environment()
    configure(settings, "device")
    traces.configure("device", settings.worker_name)
    from worker.device import run_device

    run_device(settings)
    return ExitCode.OK


def _feed(options: argparse.Namespace) -> int:
    settings = Settings.from_environment()
    configure(settings, "feed")
    traces.configure("feed", settings.worker_name)
    from worker.feed_process import run_feed

    run_feed(settings)
    return ExitCode.OK


if __name__ == "__main__":
    keep_libraries_to_one_thread()
    sys.exit(main())
