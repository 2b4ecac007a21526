"""The `intrasplat` command.

reconstruct, render, export, measure, phantom, evaluate, stability, doctor and worker run the worker's program on this
machine (`python -m worker ...`), and nothing that they do not need is imported here. up starts a service, keys manages
its API keys, backup and restore copy it and bring it back. submit, import, watch, fetch, jobs, cancel, retry, delete
and slicer talk to a service (client/commands.py).
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from contract.runtime.local import LOCAL_COMMANDS

DASHBOARD_VARIABLE = "INTRASPLAT_DASHBOARD_DIR"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in LOCAL_COMMANDS:
        return _run_local(arguments)
    if arguments and arguments[0] == "worker":
        return _run_local(["consume", *arguments[1:]])
    from client.commands import run

    return run(arguments)


def _run_local(arguments: list[str]) -> int:
    """Replace this process by the worker's program, so that signals and exit status are the worker's."""
    if find_spec("worker") is None:  # the service's container has no torch
        from contract.runtime.exits import end_by
        from contract.wire.errors import UnavailableError

        problem = f"`intrasplat {arguments[0]}` needs the worker's packages, which are not installed here."
        return end_by(UnavailableError(problem, "Run it where a worker runs, such as in the worker's container."))
    command = [sys.executable, "-m", "worker", *arguments]
    os.environ.setdefault(DASHBOARD_VARIABLE, str(Path(__file__).resolve().parent / "dashboard"))  # for export
    if os.name == "posix":
        os.execv(sys.executable, command)
    process = subprocess.Popen(command)  # without exec on Windows, where the caller would not wait
    while True:
        with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C reaches both processes; the worker decides
            return process.wait()


if __name__ == "__main__":
    sys.exit(main())
