"""`python -m worker COMMAND`: everything that happens on this machine, without a service, and the service's worker.

`intrasplat reconstruct|render|export|measure|poses|phantom|evaluate|stability|doctor` end here with the same arguments.
Only the module of the chosen command is imported: --help and doctor answer at once, and doctor even without torch.
"""

from __future__ import annotations

import argparse
import atexit
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NoReturn

from contract.runtime import traces
from contract.runtime.logs import configure
from contract.runtime.settings import Settings
from intrasplat.commands.arguments import add_command
from intrasplat.commands.exits import EXIT_CODES_HELP, ExitCode, end_by
from intrasplat.commands.local import LOCAL_COMMANDS, WORKER_SUMMARY
from intrasplat.errors import IntrasplatError, UnavailableError
from intrasplat.machine.cores import keep_libraries_to_one_thread
from intrasplat.machine.processes import told_to_end

MODULES = {
    "reconstruct": "intrasplat.commands.reconstruct",
    "render": "intrasplat.commands.render",
    "export": "intrasplat.commands.export",
    "measure": "intrasplat.commands.measure",
    "poses": "intrasplat.commands.poses",
    "phantom": "lab.phantom.command",
    "evaluate": "lab.evaluate.command",
    "stability": "lab.evaluate.stability_command",
}
"""By command: the module with its add_cli_arguments and run_cli."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    try:
        options = _parser(arguments).parse_args(arguments)
        command: Callable[[argparse.Namespace], int] = options.command
        return command(options)
    except IntrasplatError as error:
        return end_by(error)
    except ModuleNotFoundError as error:
        return end_by(UnavailableError(f"{error.name} is not installed.", "`intrasplat doctor` tells the remedy."))
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of all commands; only the one that argv names has its options."""
    parser = argparse.ArgumentParser(prog="intrasplat", epilog=EXIT_CODES_HELP)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    chosen = next((each for each in argv if not each.startswith("-")), None)
    for name, module_name in MODULES.items():
        if name == chosen:
            module = import_module(module_name)
            module.add_cli_arguments(add_command(commands, name, LOCAL_COMMANDS[name], module.run_cli))
        else:
            add_command(commands, name, LOCAL_COMMANDS[name], _not_chosen)
    consume = add_command(commands, "consume", WORKER_SUMMARY, _consume)
    consume.prog = "intrasplat worker"
    consume.add_argument(
        "--renders-only", action="store_true", help="claim no jobs, only answer renders of finished scenes"
    )
    add_command(commands, "device", "what consume starts for itself: train and render as it is told on stdin", _device)
    add_command(commands, "doctor", LOCAL_COMMANDS["doctor"], _doctor)
    return parser


def _not_chosen(options: argparse.Namespace) -> int:
    raise AssertionError(f"the command must be the first argument: {options}")


def _doctor(options: argparse.Namespace) -> int:
    from worker.doctor import run_doctor

    return ExitCode.UNAVAILABLE if run_doctor() else ExitCode.OK


def _consume(options: argparse.Namespace) -> int:
    settings = Settings.from_environment()
    configure(settings, "worker")
    traces.configure("worker", settings.worker_name)
    if settings.redis_url is None:
        raise UnavailableError("REDIS_URL is not set.", "Use `intrasplat up`, which starts a queue and a worker.")
    from worker.supervisor import run_supervisor

    run_supervisor(settings, told_to_end(), renders_only=options.renders_only)
    return ExitCode.OK


def _device(options: argparse.Namespace) -> int:
    settings = Settings.from_environment()
    configure(settings, "device")
    traces.configure("device", settings.worker_name)
    from worker.device import run_device

    run_device(settings)
    return ExitCode.OK


def _leave(code: int) -> NoReturn:
    """End this process. Python's own end would free every object of torch and Numba first, which takes most of a
    second."""
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    keep_libraries_to_one_thread()
    status = main()
    if sys.argv[1] in LOCAL_COMMANDS:
        _leave(status)
    sys.exit(status)
