"""The queue's log owns blocks of the disk in advance: what was acknowledged is kept, and a full disk ends no server."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from contract.queue.embedded import EmbeddedServer
from contract.queue.log_reserve import LOG_FOLDER, RESERVE_BYTES, fill_reserve
from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import StoreFullError

DISK_MIB = 40


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own of DISK_MIB."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", str(tmp_path)]
    try:
        mounted = subprocess.run(mount, check=False, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("only root may mount a small disk")
    yield tmp_path
    subprocess.run(["umount", "--lazy", str(tmp_path)], check=True)


def fill(folder: Path) -> Path:
    """A file that leaves no room on the folder's disk."""
    path = folder / "filler"
    with path.open("ab", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(4096)):
            pass
    return path


def log_of(folder: Path) -> Path:
    (newest,) = (folder / "valkey" / LOG_FOLDER).glob("*.incr.aof")
    return newest


def test_the_reserve_makes_the_log_no_longer(tmp_path: Path) -> None:
    server = EmbeddedServer(tmp_path)
    server.start()
    log = log_of(tmp_path)
    before = log.stat().st_size
    if not fill_reserve(tmp_path / "valkey"):
        server.stop()
        pytest.skip("this file system reserves no blocks")
    assert log.stat().st_size == before
    assert log.stat().st_blocks * 512 >= RESERVE_BYTES
    redis.Redis.from_url(server.url).set("key", "kept")
    server.stop()
    server.start()
    assert redis.Redis.from_url(server.url).get("key") == b"kept"
    server.stop()


def test_a_folder_without_a_log_has_no_reserve(tmp_path: Path) -> None:
    assert not fill_reserve(tmp_path)


def test_a_queue_goes_on_while_its_disk_is_full(small_disk: Path) -> None:
    server = EmbeddedServer(small_disk)
    server.start()
    client = redis.Redis.from_url(server.url)
    fill(small_disk)
    assert Disk(small_disk).is_full()
    for number in range(500):
        client.set(f"key-{number}", "x" * 1000)
    with contextlib.suppress(redis.ResponseError):
        client.bgrewriteaof()  # needs a new file, for which there is no room
    client.set("after", "rewrite")
    assert not server.ensure_running()
    assert client.dbsize() == 501
    server.stop()


def test_a_queue_whose_reserve_is_used_up_comes_back_with_all_it_acknowledged(small_disk: Path) -> None:
    server = EmbeddedServer(small_disk)
    server.start()
    filler = fill(small_disk)
    client = redis.Redis.from_url(server.url)
    acknowledged = 0
    with contextlib.suppress(redis.ConnectionError):
        for _ in range(100):
            client.set(f"key-{acknowledged}", "x" * 2**20)
            acknowledged += 1
    assert 5 < acknowledged < 100
    filler.unlink()
    while not server.ensure_running():
        pass
    assert redis.Redis.from_url(server.url).dbsize() >= acknowledged
    server.stop()


def test_a_queue_that_never_started_starts_when_there_is_room(small_disk: Path) -> None:
    filler = fill(small_disk)
    server = EmbeddedServer(small_disk / "data")
    for start in (server.start, server.ensure_running):
        with pytest.raises(StoreFullError):
            start()
    filler.unlink()
    assert server.ensure_running()
    assert redis.Redis.from_url(server.url).ping()
    server.stop()


def test_a_folder_that_could_not_be_made_is_named_with_the_disk_that_would_hold_it(tmp_path: Path) -> None:
    assert f"the disk of {tmp_path}/new/data" in Disk(tmp_path / "new" / "data").full_error().problem


def test_a_server_that_cannot_start_on_a_full_disk_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "valkey-server"
    program.write_text("#!/bin/sh\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setattr(Disk, "is_full", lambda disk: True)
    server = EmbeddedServer(tmp_path / "data")
    with pytest.raises(StoreFullError, match=r"the disk of .*/data.*DELETE /scenes"):
        server.start()
    with pytest.raises(StoreFullError):
        server.ensure_running()  # tries again
    server.stop()
