"""`up`'s parts: children come back after a crash, and one data directory has one launcher."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from pathlib import Path

import pytest

from client.up import Installation, WatchedProcess, check_port
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


def test_a_port_that_is_taken_is_said_before_anything_starts() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        with pytest.raises(UnavailableError, match="--port"):
            check_port("127.0.0.1", listener.getsockname()[1])
