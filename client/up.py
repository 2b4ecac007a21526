"""`intrasplat up`: a queue, the service and its workers on this machine, watched until the caller ends them.

If `up` itself is killed, service and workers are killed with it: what was accepted is on disk, and what was training
goes on from its last checkpoint at the next start. The queue's server alone stays; the next `up` of the same data
directory takes it over, and ends it when it ends itself.

A child that ends is started again, but for one: what it needs is not there. That would end the next one, too, so it
ends `up`, with the remedy. A queue or a bucket elsewhere that does not answer is waited for, as it may start later.
Once a child has been sound, what it needed was there and may come back (room on the disk, a device): then it is started
again like any other, and the rest keeps working meanwhile.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from client.api import Client
from contract.access.keys import check_keys
from contract.queue.embedded import EmbeddedServer
from contract.runtime.exits import LAST_WORDS_VARIABLE, ExitCode, take_last_words
from contract.runtime.locks import FolderLock
from contract.runtime.processes import die_with_parent, end_process, told_to_end
from contract.runtime.settings import Settings
from contract.store.store import Store
from contract.wire.errors import UnavailableError

DASHBOARD = Path(__file__).resolve().parent / "dashboard"
WATCH_PERIOD_S = 0.2
READY_PERIOD_S = 1.0
FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
STEADY_S = 60.0
"""A process that lived this long was sound: its next crash is the first again."""

STOP_TIMEOUT_S = 15.0
WORKER_NAME_VARIABLE = "INTRASPLAT_WORKER_NAME"
EVERY_ADDRESS = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""Where this machine finds itself when the service answers at all of its addresses."""


class WatchedProcess:
    """A child that is started again when it ends by itself, after pauses that double.

    In the folder it leaves what it lacks, if that is why it ends (contract/runtime/exits.py).
    """

    def __init__(self, name: str, command: list[str], environment: dict[str, str], folder: Path) -> None:
        self._name = name
        self._command = command
        self._last_words = folder / f"{name}.last-words"
        self._environment = {**environment, LAST_WORDS_VARIABLE: str(self._last_words)}
        self._was_sound = False
        self._process: subprocess.Popen[bytes] | None = None
        self._pause_s = FIRST_PAUSE_S
        self._started_s = 0.0
        self._start_at_s = 0.0

    @property
    def process_id(self) -> int | None:
        """Of the running child."""
        return self._process.pid if self._process else None

    def watch(self) -> None:
        """Start the child if it is not there and its pause is over.

        Raises:
            UnavailableError: it ended because something that it needs is not there, and has never been sound.
        """
        now_s = time.monotonic()
        if self._process is not None:
            status = self._process.poll()
            if status is None:
                return
            self._process = None
            self._bury(status, now_s)
        if now_s >= self._start_at_s:
            self._last_words.unlink(missing_ok=True)  # a launcher that was killed may have left them
            # A session of its own: Ctrl-C reaches the launcher alone, which ends the others in order.
            self._process = subprocess.Popen(
                self._command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                preexec_fn=die_with_parent if os.name == "posix" else None,
            )
            self._started_s = now_s

    def _bury(self, status: int, now_s: float) -> None:
        """Say that the child has ended, and when another starts; raises as watch."""
        if now_s - self._started_s > STEADY_S:
            self._was_sound, self._pause_s = True, FIRST_PAUSE_S
        lack = take_last_words(self._last_words)
        if status == ExitCode.UNAVAILABLE and not self._was_sound and not (lack and lack.may_return):
            if lack is None:
                problem = f"The {self._name} ended with status {status}: something that it needs is not there."
                raise UnavailableError(problem, "Its messages are above; try `intrasplat doctor`.")
            raise UnavailableError(f"The {self._name} cannot work here: {lack.problem}", lack.remedy)
        self._start_at_s = now_s + self._pause_s
        say(f"the {self._name} ended with status {status}; starting it again in {self._pause_s:g} s")
        self._pause_s = min(LONGEST_PAUSE_S, 2 * self._pause_s)

    def ask_to_end(self) -> None:
        """Send SIGTERM, and do not wait."""
        if self._process is not None:
            self._process.terminate()

    def stop(self) -> None:
        """Ask the child to end, and insist after STOP_TIMEOUT_S."""
        if self._process is None:
            return
        end_process(self._process, STOP_TIMEOUT_S)
        self._last_words.unlink(missing_ok=True)
        self._process = None


class Installation:
    """Queue, service and workers of one data directory; a context manager that starts and ends them."""

    def __init__(self, settings: Settings, worker_count: int = 1) -> None:
        Store(settings.data_dir)  # makes the folders, readable by their owner only
        data_dir = settings.data_dir.expanduser().resolve()
        self._lock = FolderLock(data_dir / "run" / "up.lock")
        self._queue = EmbeddedServer(data_dir) if settings.redis_url is None else None
        redis_url = settings.redis_url if self._queue is None else self._queue.url
        self.settings = settings.model_copy(
            update={"data_dir": data_dir, "redis_url": redis_url, "dashboard_dir": DASHBOARD}
        )
        environment = {**os.environ, **self.settings.to_environment()}
        folder = data_dir / "run"
        self.service = WatchedProcess("service", [sys.executable, "-m", "service"], environment, folder)
        command = [sys.executable, "-m", "worker", "consume"]
        self.workers = [
            WatchedProcess(name, command, {**environment, WORKER_NAME_VARIABLE: name}, folder)
            for name in worker_names(settings.worker_name, worker_count)
        ]

    @property
    def url(self) -> str:
        """Where the service answers callers on this machine."""
        host = EVERY_ADDRESS.get(self.settings.host, self.settings.host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self.settings.port}"

    def __enter__(self) -> Installation:
        if not self._lock.take():
            problem = f"Another `intrasplat up` uses {self.settings.data_dir}."
            raise UnavailableError(problem, "Use that one, end it, or choose another --data-dir.")
        try:
            if self._queue is not None:
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

    def watch(self) -> None:
        """Start again what has died; call it often. Raises UnavailableError for what cannot work here at all."""
        if self._queue is not None and self._queue.ensure_running():
            say("the queue's server had died and was started again; nothing it had accepted is lost")
        for process in (self.service, *self.workers):
            process.watch()

    def wait_until_ready(self, is_ended: Callable[[], bool], timeout_s: float) -> bool:
        """Watch until a clip would be trained; False if that takes too long or the caller ends. Raises as watch."""
        deadline_s = time.monotonic() + timeout_s
        asked_s = 0.0
        with Client(self.url) as client:
            while time.monotonic() < deadline_s and not is_ended():
                self.watch()
                if time.monotonic() > asked_s + READY_PERIOD_S:
                    asked_s = time.monotonic()
                    if client.is_ready():
                        return True
                time.sleep(WATCH_PERIOD_S)
        return False


def end_together(processes: Sequence[WatchedProcess]) -> None:
    """Ask all to end, then wait for each, so that the slowest alone is waited for."""
    for process in processes:
        process.ask_to_end()
    for process in processes:
        process.stop()


def worker_names(first: str, number: int) -> list[str]:
    """`first` alone; of several, worker-1, worker-2 and so on, or what stands in place of `worker`."""
    stem = first.removesuffix("-1")
    return [first] if number == 1 else [f"{stem}-{each}" for each in range(1, number + 1)]


def say(text: str) -> None:
    """A line for whoever watches the launcher."""
    print(f"intrasplat: {text}", file=sys.stderr, flush=True)


def run(settings: Settings, worker_count: int = 1, ready_timeout_s: float = 300.0) -> None:
    """Start everything, say where it is, and watch until SIGINT or SIGTERM.

    Raises:
        UnavailableError: there is no key to let anybody in, the port is taken, there is no queue, the service or a
            worker lacks something, or nothing becomes ready.
    """
    end = told_to_end()
    check_keys(settings)
    check_port(settings.host, settings.port)
    with Installation(settings, worker_count) as installation:
        say("starting; the first time, the kernels are compiled, which takes up to a minute")
        if not installation.wait_until_ready(end.is_set, ready_timeout_s):
            if end.is_set():
                return
            raise UnavailableError(
                "The worker did not become ready.", "Its messages are above; try `intrasplat doctor`."
            )
        say(f"ready: {installation.url}/   data: {installation.settings.data_dir}   end with Ctrl-C")
        while not end.wait(WATCH_PERIOD_S):
            installation.watch()
        say("ending")


def check_port(host: str, port: int) -> None:
    """Raise UnavailableError if somebody else listens there."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            problem = f"Port {port} of {host} cannot be had ({error.strerror})."
            raise UnavailableError(problem, f"Choose another: --port {port + 1}.") from error
