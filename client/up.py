"""`intrasplat up`: runs a queue, the service and its workers on this machine until the caller ends them.

If `up` itself is killed, service and workers are killed with it. Accepted clips are on disk, and training resumes from
its last checkpoint at the next start. Only the queue's server keeps running; the next `up` of the same data directory
adopts it, and stops it at its own end.

A child that ends is started again (contract/runtime/supervised.py). If it lacks something that cannot come back by
itself, and was never healthy, the next child would end as well, so `up` ends with the child's remedy instead.

A full disk stops no process: views and purges continue, and everything else waits for free space.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from client.disk_warnings import DiskWatch
from client.page import DASHBOARD
from contract.access.keys import check_keys
from contract.queue.embedded import EmbeddedServer, ServerEnd
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.runtime.supervised import Supervised
from contract.store.store import Store
from intrasplat.errors import UnavailableError
from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import StoreFullError, disk_errors
from intrasplat.machine.processes import shutdown_event
from intrasplat_client import Client

WATCH_PERIOD_S = 0.2
READY_PERIOD_S = 1.0
QUEUE_PERIOD_S = 1.0
"""Minimum interval between two starts of the queue's server."""
QUEUE_ENDS = {
    ServerEnd.DIED: "had died",
    ServerEnd.WITH_ITS_STARTER: "ended with the command that had started it, such as a backup,",
}
HEALTHY_AFTER_S = 15.0
"""A child that has run this long is healthy: if it ends, it is started again at once."""
STOP_TIMEOUT_S = 15.0
WORKER_NAME_VARIABLE = "INTRASPLAT_WORKER_NAME"
UP_LOCK = "up.lock"
"""The lock file of `up`, in run/ of a data directory."""
EVERY_ADDRESS = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""The loopback address of a service that listens at every address."""


class Installation:
    """Queue, service and workers of one data directory; a context manager that starts and ends them."""

    def __init__(self, settings: Settings, worker_count: int = 1) -> None:
        Store(settings.data_dir)  # creates the folders, readable by their owner only
        data_dir = settings.data_dir.expanduser().resolve()
        self._lock = FolderLock(data_dir / "run" / UP_LOCK)
        self._queue = EmbeddedServer(data_dir) if settings.redis_url is None else None
        self._queue_at_s = 0.0
        self.disk = DiskWatch(Disk(data_dir), settings.min_free_bytes, say)
        redis_url = settings.redis_url if self._queue is None else self._queue.url
        self.settings = settings.model_copy(
            update={"data_dir": data_dir, "redis_url": redis_url, "dashboard_dir": DASHBOARD}
        )
        self.service = self._child("service", [sys.executable, "-m", "service"], {})
        command = [sys.executable, "-m", "worker", "consume"]
        self.workers = [
            self._child(name, command, {WORKER_NAME_VARIABLE: name})
            for name in worker_names(settings.worker_name, worker_count)
        ]

    @property
    def url(self) -> str:
        """The service's URL on this machine."""
        host = EVERY_ADDRESS.get(self.settings.host, self.settings.host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self.settings.port}"

    def __enter__(self) -> Installation:
        with disk_errors():
            is_alone = self._lock.take()
        if not is_alone:
            problem = f"Another `intrasplat up` uses {self.settings.data_dir}."
            raise UnavailableError(problem, "Use that one, end it, or choose another --data-dir.")
        try:
            if self._queue is not None:
                with suppress(StoreFullError):  # watch() tries again
                    self._queue.start()
            self.watch()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        end_together([self.service, *self.workers])
        if self._queue is not None:
            self._queue.stop()
        self._lock.release()

    def _child(self, name: str, command: list[str], variables: dict[str, str]) -> Supervised:
        return Supervised(
            name,
            command,
            {**os.environ, **self.settings.to_environment(), **variables},
            last_words=self.settings.data_dir / "run" / f"{name}.last-words",
            grace_s=STOP_TIMEOUT_S,
            healthy_after_s=HEALTHY_AFTER_S,
        )

    def watch(self) -> None:
        """Restart the processes that have ended; call it often. Raises UnavailableError if a child cannot run here."""
        self.disk.look()
        self._watch_queue()
        for child in (self.service, *self.workers):
            try:
                ended = child.watch()
            except UnavailableError as lack:
                self.disk.look(now=True)
                if self.disk.is_full:  # the child could not write to disk that what it lacks may come back
                    continue
                raise UnavailableError(f"The {child.name} cannot work here: {lack.problem}", lack.remedy) from lack
            if ended is not None:
                say(f"the {child.name} {ended.cause}; starting it again in {ended.pause_s:g} s")

    def _watch_queue(self) -> None:
        """Restart the queue's server if it has ended. While the disk is full it may die repeatedly."""
        if self._queue is None or time.monotonic() < self._queue_at_s:
            return
        try:
            end = self._queue.ensure_running()
            if end is None:
                return
        except StoreFullError:
            self.disk.look(now=True)
        else:
            self.disk.look(now=True)
            if not self.disk.is_full:
                say(f"the queue's server {QUEUE_ENDS[end]} and was started again; nothing it had accepted is lost")
        self._queue_at_s = time.monotonic() + QUEUE_PERIOD_S

    def wait_until_ready(self, is_ended: Callable[[], bool], timeout_s: float) -> bool:
        """Watch until the service is ready; False after timeout_s, once is_ended(), or if free disk space is short.

        Raises as watch.
        """
        deadline_s = time.monotonic() + timeout_s
        asked_s = 0.0
        with Client(self.url) as client:
            while time.monotonic() < deadline_s and not is_ended() and not self.disk.is_short:
                self.watch()
                if time.monotonic() > asked_s + READY_PERIOD_S:
                    asked_s = time.monotonic()
                    if client.is_ready():
                        return True
                time.sleep(WATCH_PERIOD_S)
        return False


def end_together(children: Sequence[Supervised]) -> None:
    """Ask all children to end, then wait for each."""
    for child in children:
        child.ask_to_end()
    for child in children:
        child.stop()


def worker_names(first: str, number: int) -> list[str]:
    """The names of the workers: `first` for one; for several its stem with a number: worker-1, worker-2, ..."""
    stem = first.removesuffix("-1")
    return [first] if number == 1 else [f"{stem}-{each}" for each in range(1, number + 1)]


def say(text: str) -> None:
    """Print a message of the launcher."""
    print(f"intrasplat: {text}", file=sys.stderr, flush=True)


def run(settings: Settings, worker_count: int = 1, ready_timeout_s: float = 300.0) -> None:
    """Start all processes, print the URL, and watch until SIGINT or SIGTERM.

    Raises:
        UnavailableError: there is no API key, the port is taken, there is no queue, the service or a worker lacks
            something, or the service does not become ready.
        StoreFullError: the disk is so full that nothing can start; the error names it.
    """
    end = shutdown_event()
    check_keys(settings)
    check_port(settings.host, settings.port)
    try:
        _run(settings, worker_count, ready_timeout_s, end)
    except StoreFullError as error:
        raise Disk(settings.data_dir).full_error() from error


def _run(settings: Settings, worker_count: int, ready_timeout_s: float, end: threading.Event) -> None:
    with Installation(settings, worker_count) as installation:
        say("starting; the first time, the kernels are compiled, which takes up to a minute")
        if not installation.wait_until_ready(end.is_set, ready_timeout_s):
            if end.is_set():
                return
            if not installation.disk.is_short:
                raise UnavailableError(
                    "The worker did not become ready.", "Its messages are above; try `intrasplat doctor`."
                )
        state = "read-only" if installation.disk.is_short else "ready"
        say(f"{state}: {installation.url}/   data: {installation.settings.data_dir}   end with Ctrl-C")
        while not end.wait(WATCH_PERIOD_S):
            installation.watch()
        say("ending")


def check_port(host: str, port: int) -> None:
    """Raise UnavailableError if another process listens there."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            problem = f"Cannot listen on {host}:{port} ({error.strerror})."
            raise UnavailableError(problem, f"Choose another: --port {port + 1}.") from error
