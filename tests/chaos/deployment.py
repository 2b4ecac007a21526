"""A whole installation that is killed again and again: Valkey, service, supervisor and its device child.

Whatever dies is started again at once, as a process manager does; only the pauses between crashes are left out.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Any

import httpx

from contract.access.keys import DEFAULT_SCOPES, KeyFile
from contract.queue.embedded import EmbeddedServer
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from contract.store.store import Store
from tests.chaos.points import FOLDER_VARIABLE, Points
from tests.receiver import Receiver

REPOSITORY = Path(__file__).resolve().parents[2]
KEEP_PERIOD_S = 0.05
START_TIMEOUT_S = 60.0
TENANTS = ("theatre-1", "theatre-2", "theatre-3")
WEBHOOK_SECRET = "chaos" * 8


class Victim(StrEnum):
    """Which processes are killed."""

    SERVICE = "service"
    SUPERVISOR = "supervisor"
    CHILD = "device child"
    VALKEY = "Valkey"
    ALL = "all"


class Kept:
    """A process that is started again whenever it ends."""

    def __init__(self, module: str, environment: dict[str, str], log: Path) -> None:
        self._command = [sys.executable, "-m", module]
        self._environment = environment
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def process_id(self) -> int | None:
        """Process id, None unless it runs."""
        return self._process.pid if self._process is not None and self._process.poll() is None else None

    def keep(self) -> None:
        """Start it unless it runs."""
        if self.process_id is None:
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    self._command, env=self._environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                    start_new_session=True, cwd=REPOSITORY,
                )  # fmt: skip

    def end(self) -> None:
        """Kill it for good."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGKILL)
            self._process.wait()


class Deployment:
    """One installation in its own folder and on its own port; a context manager.

    keys: headers with the key of each of several tenants. receiver: of the webhooks that they ask for.
    more_ports: of further services. environment: of its processes, too.
    """

    def __init__(
        self, folder: Path, port: int, workers: int = 1, more_ports: Sequence[int] = (), **environment: str
    ) -> None:
        folder.mkdir(parents=True)
        self._more = environment
        self.data_dir = folder / "data"
        self.points = Points(folder / "points")
        self.server = EmbeddedServer(self.data_dir)
        self.urls = [f"http://127.0.0.1:{each}" for each in (port, *more_ports)]
        self.url = self.urls[0]
        self.store = Store(self.data_dir)
        self.receiver = Receiver()
        self.settings = Settings(
            data_dir=self.data_dir,
            port=port,
            redis_url=self.server.url,
            min_free_bytes=0,
            webhook_secret=WEBHOOK_SECRET,
            webhook_hosts=(self.receiver.origin,),
            webhook_private="yes",
        )
        self._folder = folder
        self.services = [
            Kept("tests.chaos.service_process", self._environment({"port": each}), folder / f"service-{each}.log")
            for each in (port, *more_ports)
        ]
        self.workers: list[Kept] = []
        self.add_workers(workers)
        self._end = threading.Event()
        self._keeper = threading.Thread(target=self._keep, name="keeper", daemon=True)

    def __enter__(self) -> Deployment:
        self.server.start()
        self.receiver.__enter__()
        self.keys = {tenant: {"Authorization": f"Bearer {self._new_key(tenant)}"} for tenant in TENANTS}
        self.queue = RedisQueue(self.server.url)
        self._keeper.start()
        self.wait_until_ready()
        return self

    def __exit__(self, *exception: object) -> None:
        self._end.set()
        self._keeper.join()
        for kept in (*self.services, *self.workers):
            kept.end()
        self.queue.close()
        self.server.stop()
        self.receiver.__exit__()

    @property
    def socket(self) -> Path:
        """The socket of the queue's server."""
        return Path(self.server.url.removeprefix("unix://"))

    def add_workers(self, count: int, **settings: str) -> None:
        """Add workers, with settings of their own, that are kept running."""
        for number in range(len(self.workers) + 1, len(self.workers) + count + 1):
            environment = self._environment({"worker_name": f"worker-{number}", **settings})
            log = self._folder / f"worker-{number}.log"
            self.workers.append(Kept("tests.chaos.worker_process", environment, log))

    def wait_until_ready(self, timeout_s: float = START_TIMEOUT_S) -> None:
        """Wait until services, queue and all workers answer.

        Raises:
            TimeoutError: they do not.
        """
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            with suppress(Exception):
                # A stand-in for a worker answers no views, so /readyz would wait for it for ever.
                lives = [httpx.get(f"{url}/healthz", timeout=2.0).status_code == 200 for url in self.urls]
                if all(lives) and len(self.queue.workers()) >= len(self.workers):
                    return
            time.sleep(0.05)
        raise TimeoutError(f"{self.data_dir} is not ready after {timeout_s:g} s; its logs lie beside it")

    def kill(self, target: Victim) -> None:
        """kill -9 the victim."""
        services = [kept.process_id for kept in self.services]
        supervisors = [kept.process_id for kept in self.workers]
        children = [child for supervisor in supervisors if supervisor for child in children_of(supervisor)]
        victims = {
            Victim.SERVICE: services,
            Victim.SUPERVISOR: supervisors,
            Victim.CHILD: children,
            Victim.VALKEY: [self.server.process_id],
            Victim.ALL: [*services, *supervisors, *children, self.server.process_id],
        }[target]
        for victim in victims:
            if victim is not None:
                with suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGKILL)

    def _new_key(self, tenant: str) -> str:
        return KeyFile(self.data_dir).create(tenant, DEFAULT_SCOPES)[1]

    def _environment(self, changes: dict[str, Any]) -> dict[str, str]:
        settings = self.settings.model_copy(update=changes)
        return {**os.environ, **settings.to_environment(), FOLDER_VARIABLE: str(self.points.folder), **self._more}

    def _keep(self) -> None:
        while not self._end.wait(KEEP_PERIOD_S):
            with suppress(Exception):  # it is tried again
                self.server.ensure_running()
                for kept in (*self.services, *self.workers):
                    kept.keep()


def children_of(process_id: int) -> list[int]:
    """The direct children of a process (Linux)."""
    try:
        text = Path(f"/proc/{process_id}/task/{process_id}/children").read_text()
    except FileNotFoundError:
        return []
    return [int(child) for child in text.split()]
