"""A process that reads a live source may be given one TCP port to connect to, and nothing else of the network."""

from __future__ import annotations

import ctypes
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel's protections are Linux's")
def test_a_process_that_may_connect_reaches_one_port_and_no_other_kind_of_socket(tmp_path: Path) -> None:
    program = (
        "import json, socket, sys\nfrom pathlib import Path\n"
        "from intrasplat.decode.guard import Allowance, lock_in\n"
        "permitted, other = map(int, sys.argv[1:])\n"
        f"lock_in(Allowance(1 << 30, 1 << 20, 60), [], Path({str(tmp_path)!r}), connect_port=permitted)\n"
        "def tried(family, address):\n"
        "    try:\n"
        "        socket.socket(family, socket.SOCK_STREAM).connect(address)\n"
        "    except PermissionError:\n"
        "        return False\n"
        "    return True\n"
        "local = '127.0.0.1'\n"
        "try:\n"
        "    listens = bool(socket.create_server((local, 0)))\n"
        "except PermissionError:\n"
        "    listens = False\n"
        "reached = [tried(socket.AF_INET, (local, port)) for port in (permitted, other)]\n"
        "print(json.dumps([*reached, tried(socket.AF_UNIX, '/run/none'), listens]))\n"
    )
    with socket.create_server(("127.0.0.1", 0)) as permitted, socket.create_server(("127.0.0.1", 0)) as other:
        ports = [str(each.getsockname()[1]) for each in (permitted, other)]
        environment = {
            **os.environ,
            "PYTHONPATH": str(Path(__file__).resolve().parents[3]),
            "OPENBLAS_NUM_THREADS": "1",
        }
        output = subprocess.run(
            [sys.executable, "-c", program, *ports], capture_output=True, env=environment, check=True
        )
    reached, elsewhere, local, listens = json.loads(output.stdout)
    assert reached
    assert not local
    if has_port_rules():
        assert not elsewhere
        assert not listens


def has_port_rules() -> bool:
    """Whether the kernel's Landlock restricts TCP ports."""
    return int(ctypes.CDLL(None).syscall(444, None, 0, 1)) >= 4
