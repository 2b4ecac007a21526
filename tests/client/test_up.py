"""`up`'s parts: it starts its children again, says what they lack, and is alone in its data directory."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from client import up
from client.up import Installation, check_port, worker_names
from contract.queue.embedded import EmbeddedServer, ServerEnd
from contract.queue.installed import installed_queue
from contract.queue.redis_queue import RedisQueue
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.runtime.supervised import Supervised
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import UnavailableError
from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import StoreFullError
from tests.contract.queues import job

SLEEP = "import time; time.sleep(60)"
LACKS = """
from intrasplat.errors import UnavailableError
from intrasplat.commands.exits import end_by
raise SystemExit(end_by(UnavailableError("There is no such device.", "Set INTRASPLAT_DEVICE.")))
"""


class FailingQueue(EmbeddedServer):
    """A queue's server whose starts end so: with an error, or well (None)."""

    def __init__(self, data_dir: Path, starts: list[StoreFullError | None]) -> None:
        super().__init__(data_dir)
        self.starts = starts

    def ensure_running(self) -> ServerEnd | None:
        error = self.starts.pop(0)
        if error is not None:
            raise error
        return ServerEnd.DIED


def child_that_runs(program: str, folder: Path) -> Supervised:
    return Supervised("worker", [sys.executable, "-c", program], last_words=folder / "worker.last-words")


@contextmanager
def started(folder: Path, worker: str, redis_url: str | None = "redis://127.0.0.1:1") -> Iterator[Installation]:
    """An installation with a queue elsewhere, a service that sleeps, and one worker that runs a program."""
    installation = Installation(Settings(data_dir=folder, redis_url=redis_url))
    installation.service = child_that_runs(SLEEP, folder)
    installation.workers = [child_that_runs(worker, folder)]
    with installation:
        yield installation


def watch_the_worker_end(installation: Installation) -> None:
    process_id = installation.workers[0].process_id
    assert process_id is not None
    os.waitid(os.P_PID, process_id, os.WEXITED | os.WNOWAIT)
    installation.watch()


def test_a_worker_that_ends_is_started_again_and_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with started(tmp_path, "raise SystemExit(7)") as installation:
        watch_the_worker_end(installation)
        assert installation.service.process_id is not None
    assert "the worker ended with status 7; starting it again in 0.5 s" in capsys.readouterr().err


def test_a_worker_that_lacks_something_raises_what_it_lacks(tmp_path: Path) -> None:
    with (
        started(tmp_path, LACKS) as installation,
        pytest.raises(UnavailableError, match=r"worker cannot work here: There is no such device\. Set INTRASPLAT"),
    ):
        watch_the_worker_end(installation)
    assert installation.workers[0].process_id is None
    assert not list(tmp_path.glob("*.last-words"))


def test_a_worker_whose_queue_does_not_answer_yet_is_started_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    away = LACKS.replace('"Set INTRASPLAT_DEVICE."', '"Start it.", may_return=True')
    with started(tmp_path, away) as installation:
        watch_the_worker_end(installation)
    assert "starting it again" in capsys.readouterr().err


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


def test_a_launcher_starts_while_a_backup_runs_the_queue_and_has_one_when_the_backup_has_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ExitStack() as ended:
        with installed_queue(Settings(data_dir=tmp_path)) as queue:
            record = queue.submit(job())
            installation = ended.enter_context(started(tmp_path, SLEEP, None))
        installation.watch()
        after = RedisQueue(EmbeddedServer(tmp_path).url)
        ended.callback(after.close)
        assert [each.job_id for each in after.records()] == [record.job_id]
    told = [line for line in capsys.readouterr().err.splitlines() if "the queue's server" in line]
    assert len(told) == 1
    assert "ended with the command that had started it, such as a backup" in told[0]


def test_a_launcher_that_finds_a_queue_which_ends_just_then_starts_its_own(tmp_path: Path) -> None:
    server = EmbeddedServer(tmp_path)
    lock = FolderLock(tmp_path / "valkey" / "lock")  # what whoever ends its server holds until that is done
    assert lock.take()
    threading.Timer(0.2, lock.release).start()
    server.start()
    assert server.process_id is not None
    server.stop()


def test_a_launcher_that_cannot_start_everything_leaves_nothing_behind(tmp_path: Path) -> None:
    installation = Installation(Settings(data_dir=tmp_path))
    installation.service = child_that_runs(SLEEP, tmp_path)
    installation.workers = [Supervised("worker", [str(tmp_path / "no-such-program")])]
    with pytest.raises(FileNotFoundError), installation:
        pass
    assert installation.service.process_id is None
    assert all(FolderLock(tmp_path / each).take() for each in ("run/up.lock", "valkey/lock"))


def test_a_taken_port_is_reported_before_anything_starts() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        with pytest.raises(UnavailableError, match="--port"):
            check_port("127.0.0.1", listener.getsockname()[1])


def test_every_worker_has_a_name_of_its_own(tmp_path: Path) -> None:
    assert worker_names("worker-1", 1) == ["worker-1"]
    assert worker_names("worker-1", 3) == ["worker-1", "worker-2", "worker-3"]
    assert worker_names("theatre-2", 2) == ["theatre-2-1", "theatre-2-2"]
    assert len(Installation(Settings(data_dir=tmp_path), worker_count=3).workers) == 3


def test_a_service_at_every_address_is_found_at_loopback(tmp_path: Path) -> None:
    urls = [Installation(Settings(data_dir=tmp_path, host=host)).url for host in ("127.0.0.1", "0.0.0.0", "::")]
    assert urls == ["http://127.0.0.1:8765", "http://127.0.0.1:8765", "http://[::1]:8765"]


def test_a_disk_that_is_short_of_room_is_named_once_with_the_remedy_and_ends_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [0]
    monkeypatch.setattr(Disk, "free_bytes", lambda disk: free[0])
    with started(tmp_path, SLEEP) as installation:
        for free[0] in (0, 5 << 20, 2**40, 2**40):
            installation.disk.look(now=True)
            assert not installation.wait_until_ready(lambda: True, 1.0)
        assert installation.workers[0].process_id is not None
    short, enough = capsys.readouterr().err.splitlines()
    assert str(tmp_path) in short
    assert "0 MiB left" in short
    assert "DELETE /scenes/ID" in short
    assert "clips are accepted" in enough


def test_a_queue_that_a_full_disk_has_ended_is_tried_again_and_the_rest_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(up, "QUEUE_PERIOD_S", 0.0)
    monkeypatch.setattr(Disk, "is_full", lambda disk: True)
    with started(tmp_path, SLEEP) as installation:
        starts = [Disk(tmp_path).full_error(), Disk(tmp_path).full_error(), None]
        installation._queue = queue = FailingQueue(tmp_path, starts)
        while queue.starts:
            installation.watch()
        assert installation.workers[0].process_id is not None
    assert len([line for line in capsys.readouterr().err.splitlines() if "MiB left" in line]) == 1


def test_a_child_that_cannot_start_on_a_full_disk_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Disk, "is_full", lambda disk: True)
    with started(tmp_path, LACKS) as installation:
        watch_the_worker_end(installation)
        while installation.workers[0].process_id is None:
            installation.watch()


def test_an_installation_that_finds_no_room_to_start_names_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*arguments: object) -> None:
        raise StoreFullError("There is no room left in the data directory.", "Make room.")

    monkeypatch.setattr(up, "Installation", no_room)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(StoreFullError, match=rf"the disk of {tmp_path}.*DELETE /scenes/ID"):
        up.run(Settings(data_dir=tmp_path, port=port))
