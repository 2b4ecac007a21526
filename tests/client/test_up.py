"""`up`'s parts: children come back after a crash and end with it, and one data directory has one launcher."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from client.up import Installation, WatchedProcess, check_port, worker_names
from contract.errors import UnavailableError
from contract.locks import FolderLock
from contract.settings import Settings

WAIT_S = 10.0


def test_a_killed_child_is_started_again_and_a_stopped_one_is_not() -> None:
    child = WatchedProcess("worker", [sys.executable, "-c", "import time; time.sleep(60)"], dict(os.environ))
    child.watch()
    first = child.process_id
    assert first is not None
    os.kill(first, signal.SIGKILL)
    deadline_s = time.monotonic() + WAIT_S
    while child.process_id in (first, None):
        assert time.monotonic() < deadline_s
        child.watch()
        time.sleep(0.02)
    child.stop()
    assert child.process_id is None


def test_a_child_that_crashes_at_once_is_not_started_in_a_hurry() -> None:
    child = WatchedProcess("worker", [sys.executable, "-c", "raise SystemExit(5)"], dict(os.environ))
    child.watch()
    assert child.process_id is not None
    os.waitid(os.P_PID, child.process_id, os.WEXITED | os.WNOWAIT)
    child.watch()
    child.watch()
    assert child.process_id is None
    child.stop()


def test_a_second_launcher_of_a_data_directory_is_refused(tmp_path: Path) -> None:
    installation = Installation(Settings(data_dir=tmp_path))
    other = FolderLock(tmp_path / "run" / "up.lock")
    assert other.take()
    with pytest.raises(UnavailableError, match="Another `intrasplat up`"), installation:
        pass
    other.release()


def test_a_launcher_that_cannot_start_everything_leaves_nothing_behind(tmp_path: Path) -> None:
    installation = Installation(Settings(data_dir=tmp_path))
    installation.service = WatchedProcess("service", [sys.executable, "-c", "import time; time.sleep(60)"], {})
    installation.workers = [WatchedProcess("worker", [str(tmp_path / "no-such-program")], {})]
    with pytest.raises(FileNotFoundError), installation:
        pass
    assert installation.service.process_id is None
    assert all(FolderLock(tmp_path / each).take() for each in ("run/up.lock", "valkey/lock"))


def test_a_port_that_is_taken_is_said_before_anything_starts() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        with pytest.raises(UnavailableError, match="--port"):
            check_port("127.0.0.1", listener.getsockname()[1])


def test_children_end_with_a_launcher_that_was_killed() -> None:
    program = (
        "import os, sys, time\n"
        "from client.up import WatchedProcess\n"
        "child = WatchedProcess('worker', [sys.executable, '-c', 'import time; time.sleep(60)'], dict(os.environ))\n"
        "child.watch()\n"
        "print(child.process_id, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as launcher:
        assert launcher.stdout is not None
        child_id = int(launcher.stdout.readline())
        assert is_running(child_id)
        launcher.kill()
    deadline_s = time.monotonic() + WAIT_S
    while is_running(child_id):
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def is_running(process_id: int) -> bool:
    """Whether the process is there and has not ended; one that ended may wait for somebody to ask for its status."""
    try:
        state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_every_worker_has_a_name_of_its_own(tmp_path: Path) -> None:
    assert worker_names("worker-1", 1) == ["worker-1"]
    assert worker_names("worker-1", 3) == ["worker-1", "worker-2", "worker-3"]
    assert worker_names("theatre-2", 2) == ["theatre-2-1", "theatre-2-2"]
    assert len(Installation(Settings(data_dir=tmp_path), worker_count=3).workers) == 3


def test_a_service_at_every_address_is_found_at_loopback(tmp_path: Path) -> None:
    urls = [Installation(Settings(data_dir=tmp_path, host=host)).url for host in ("127.0.0.1", "0.0.0.0", "::")]
    assert urls == ["http://127.0.0.1:8765", "http://127.0.0.1:8765", "http://[::1]:8765"]
