"""Service and worker are replaced one after the other, by their next version, on one queue with a job in flight.

The older version is the code of an older commit, run from its own tree by the same interpreter.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

from contract.queue.embedded import EmbeddedServer
from contract.queue.interface import Queue
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from contract.wire.job import JobState
from lab.phantom import PhantomSettings, make_phantom, write_stereo_video
from tests.receiver import Receiver
from tests.test_many_machines import end_process, eventually, free_port, opened

NEW = Path(__file__).resolve().parents[1]
OLDER = "6f3874b"
"""The first commit whose services read what later workers report. A release takes its place."""
LONG, SHORT = 300, 20
"""Iterations of a job that a worker is to be stopped in, and of the others."""


@pytest.fixture(scope="module")
def old(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tree of the older version, where pytest keeps it: Numba knows what it compiled by the path of its source."""
    found = subprocess.run(["git", "archive", OLDER], cwd=NEW, capture_output=True)
    if found.returncode:
        pytest.skip(f"this tree has no git history with {OLDER}")
    kept = getattr(pytestconfig, "cache", None)
    folder = tmp_path_factory.mktemp("old") if kept is None else Path(kept.mkdir(f"tree-{OLDER}"))
    with tarfile.open(fileobj=io.BytesIO(found.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return folder


class Site:
    """A queue and a data directory, and a service and a worker of either version."""

    def __init__(self, folder: Path, ended: ExitStack) -> None:
        self.folder = folder
        self._ended = ended
        server = EmbeddedServer(folder / "data")
        server.start()
        ended.callback(server.stop)
        self.receiver = ended.enter_context(Receiver())
        self.settings = Settings(
            data_dir=folder / "data", redis_url=server.url, device="cpu", min_free_bytes=0, port=free_port(),
            webhook_hosts=(self.receiver.origin,), webhook_private="yes", webhook_secret="s" * 32,
        )  # fmt: skip
        self.queue: Queue = RedisQueue(server.url)
        ended.callback(self.queue.close)
        self.http = ended.enter_context(httpx.Client(base_url=f"http://127.0.0.1:{self.settings.port}", timeout=60.0))

    def start(self, tree: Path, *command: str) -> subprocess.Popen[bytes]:
        path = {"PYTHONPATH": f"{tree}{os.pathsep}{tree / 'client'}"}
        log = self._ended.enter_context((self.folder / f"{command[0]}-{tree.name}.log").open("ab"))
        process = subprocess.Popen(
            [sys.executable, "-m", *command],
            cwd=tree, env={**os.environ, **self.settings.to_environment(), **path}, stdout=log, stderr=log,
        )  # fmt: skip
        self._ended.callback(end_process, process, 30.0)
        return process

    def start_service(self, tree: Path) -> subprocess.Popen[bytes]:
        process = self.start(tree, "service")

        def answers() -> bool:
            with suppress(httpx.TransportError):
                return self.http.get("/healthz").is_success
            return False

        eventually(answers)
        return process

    def start_worker(self, tree: Path) -> subprocess.Popen[bytes]:
        return self.start(tree, "worker", "consume")

    def job(self, job_id: str) -> dict[str, Any]:
        answer = self.http.get(f"/jobs/{job_id}")
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found

    def send(self, clip: Path, iterations: int) -> str:
        data = {"options": f'{{"iterations": {iterations}}}', "callback_url": f"{self.receiver.origin}/"}
        with opened(clip) as files:
            sent = self.http.post("/reconstruct", files=files, data=data)
        assert sent.status_code == 202, sent.text
        return str(sent.json()["id"])

    def told(self, job_id: str) -> int:
        """How many webhooks about the job have come."""
        return sum(each.document["data"]["job_id"] == job_id for each in self.receiver.all)

    def assert_is_shown(self, job_id: str, iterations: int) -> None:
        """The job is done, and what a caller asks of its scene is answered."""
        assert self.job(job_id)["state"] == JobState.DONE
        assert self.http.get(f"/scenes/{job_id}").json()["iterations"] == iterations
        assert job_id in {each["id"] for each in self.http.get("/scenes").json()}
        for layer in ("rgb", "depth", "confidence"):
            view = self.http.get("/render", params={"scene": job_id, "t": 0.5, "layer": layer})
            assert view.status_code == 200, view.text
        events = self.http.get(f"/jobs/{job_id}/events")
        assert '"state":"done"' in events.text.replace(" ", "")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as ended:
        yield Site(tmp_path, ended)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phantom") / "clip"
    write_stereo_video(make_phantom(PhantomSettings(width=96, height=80, frames=10)), folder)
    return folder


def test_worker_and_then_service_are_replaced_under_a_job_and_back_again(site: Site, old: Path, clip: Path) -> None:
    service, worker = site.start_service(old), site.start_worker(old)
    first = site.send(clip, LONG)
    waiting = site.send(clip, SHORT)
    eventually(lambda: bool(site.job(first)["iteration"]))
    end_process(worker, 60.0)
    assert site.job(first)["state"] == JobState.QUEUED

    worker = site.start_worker(NEW)
    eventually(lambda: site.job(first)["state"] in ("done", "failed"))
    assert site.job(first)["attempt"] == 2
    site.assert_is_shown(first, LONG)
    eventually(lambda: site.job(waiting)["state"] in ("done", "failed"))
    site.assert_is_shown(waiting, SHORT)

    end_process(service, 60.0)
    service = site.start_service(NEW)
    site.assert_is_shown(first, LONG)
    site.assert_is_shown(waiting, SHORT)
    eventually(lambda: site.told(first) == 1)
    assert site.http.post(f"/jobs/{first}/deliveries").status_code == 202
    eventually(lambda: site.told(first) == 2)

    end_process(worker, 60.0)
    site.start_worker(old)
    later = site.send(clip, SHORT)
    eventually(lambda: site.job(later)["state"] in ("done", "failed"))
    site.assert_is_shown(later, SHORT)
    site.assert_is_shown(first, LONG)
    eventually(lambda: {each.document["data"]["job_id"] for each in site.receiver.all} == {first, waiting, later})
