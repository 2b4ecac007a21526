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

from client import up
from client.up import Installation, WatchedProcess, check_port, worker_names
from contract.runtime.exits import ExitCode
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.wire.errors import UnavailableError

WAIT_S = 10.0


def child_that_runs(program: str, folder: Path) -> WatchedProcess:
    return WatchedProcess("worker", [sys.executable, "-c", program], dict(os.environ), folder)


def watch_until_ended(child: WatchedProcess) -> None:
    """Start the child, wait for its end, and look at it again."""
    child.watch()
    assert child.process_id is not None
    os.waitid(os.P_PID, child.process_id, os.WEXITED | os.WNOWAIT)
    child.watch()


def test_a_killed_child_is_started_again_and_a_stopped_one_is_not(tmp_path: Path) -> None:
    child = child_that_runs("import time; time.sleep(60)", tmp_path)
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


@pytest.mark.parametrize("status", [code for code in ExitCode if code != ExitCode.UNAVAILABLE] + [1])
def test_a_child_that_crashes_at_once_is_not_started_in_a_hurry(status: int, tmp_path: Path) -> None:
    child = child_that_runs(f"raise SystemExit({int(status)})", tmp_path)
    watch_until_ended(child)
    child.watch()
    assert child.process_id is None
    child.stop()


LACKS = """
from contract.wire.errors import UnavailableError
from contract.runtime.exits import end_by
raise SystemExit(end_by(UnavailableError("There is no such device.", "Set INTRASPLAT_DEVICE.")))
"""


def test_a_child_that_lacks_something_is_not_started_again_and_says_what_it_lacks(tmp_path: Path) -> None:
    child = child_that_runs(LACKS, tmp_path)
    with pytest.raises(UnavailableError, match=r"worker cannot work here: There is no such device\. Set INTRASPLAT"):
        watch_until_ended(child)
    assert child.process_id is None
    assert list(tmp_path.iterdir()) == []


def test_a_child_whose_queue_does_not_answer_yet_is_started_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    away = LACKS.replace('"Set INTRASPLAT_DEVICE."', '"Start it.", may_return=True')
    child = child_that_runs(away, tmp_path)
    watch_until_ended(child)
    assert "starting it again" in capsys.readouterr().err
    child.stop()


def test_words_that_an_earlier_child_left_are_not_taken_for_those_of_the_next(tmp_path: Path) -> None:
    (tmp_path / "worker.last-words").write_text('{"problem": "There was no queue.", "remedy": "Start one."}')
    with pytest.raises(UnavailableError, match=r"ended with status 5.*messages are above"):
        watch_until_ended(child_that_runs("raise SystemExit(5)", tmp_path))


def test_a_child_that_was_sound_once_is_started_again_whatever_it_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(up, "STEADY_S", -1.0)
    monkeypatch.setattr(up, "FIRST_PAUSE_S", 0.0)
    child = child_that_runs(LACKS, tmp_path)
    watch_until_ended(child)
    monkeypatch.setattr(up, "STEADY_S", 60.0)
    watch_until_ended(child)
    assert capsys.readouterr().err.count("starting it again") == 2
    child.stop()


def test_a_worker_that_lacks_something_ends_the_launcher_with_its_remedy_and_leaves_nothing_behind(
    tmp_path: Path,
) -> None:
    for name in ("run", "valkey"):
        (tmp_path / name).mkdir()
    its_name = FolderLock(tmp_path / "run" / "worker-1.lock")
    assert its_name.take()  # what another worker of this name would hold
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "client.cli", "up", "--port", str(port), "--data-dir", str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("INTRASPLAT", "REDIS"))}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert ended.returncode == ExitCode.UNAVAILABLE, ended.stderr
    assert "The worker-1 cannot work here: A worker named worker-1" in ended.stderr.splitlines()[-1]
    assert "INTRASPLAT_WORKER_NAME" in ended.stderr.splitlines()[-1]
    assert "starting it again" not in ended.stderr
    assert all(FolderLock(tmp_path / each).take() for each in ("run/up.lock", "valkey/lock"))


def test_a_second_launcher_of_a_data_directory_is_refused(tmp_path: Path) -> None:
    installation = Installation(Settings(data_dir=tmp_path))
    other = FolderLock(tmp_path / "run" / "up.lock")
    assert other.take()
    with pytest.raises(UnavailableError, match="Another `intrasplat up`"), installation:
        pass
    other.release()


def test_a_launcher_that_cannot_start_everything_leaves_nothing_behind(tmp_path: Path) -> None:
    installation = Installation(Settings(data_dir=tmp_path))
    installation.service = child_that_runs("import time; time.sleep(60)", tmp_path)
    installation.workers = [WatchedProcess("worker", [str(tmp_path / "no-such-program")], {}, tmp_path)]
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


def test_children_end_with_a_launcher_that_was_killed(tmp_path: Path) -> None:
    program = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from client.up import WatchedProcess\n"
        "command = [sys.executable, '-c', 'import time; time.sleep(60)']\n"
        "child = WatchedProcess('worker', command, dict(os.environ), Path(sys.argv[1]))\n"
        "child.watch()\n"
        "print(child.process_id, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as launcher:
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
