"""A service on a real port, as its server program runs it, for what needs real connections: WebSockets above all."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contract.queue.embedded import short_socket_path
from contract.queue.interface import Claim
from contract.queue.memory import MemoryQueue
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.errors import SceneError
from contract.wire.job import JobFiles, JobRecord
from contract.wire.names import MANIFEST
from contract.wire.rendering import ExportRequest, RenderRequest, WorkerAddress
from service.app import create_app
from service.renderer import ZmqRenderer
from service.server import Server
from tests.answers import at_once
from worker.daemon.reply import Reply
from worker.daemon.serve import RequestServer

WORKER = "worker-1"


@dataclass
class LiveService:
    """Where it listens, and what it stands on."""

    port: int
    queue: MemoryQueue
    store: Store
    worker_endpoint: str
    server: Server
    thread: threading.Thread

    @property
    def url(self) -> str:
        """Where it answers."""
        return f"http://127.0.0.1:{self.port}"

    def running_job(self, tenant: str = "local") -> Claim:
        """A job that the worker runs, and says so."""
        job_id = new_job_id()
        files = JobFiles(clip="clip.mp4")
        self.queue.submit(JobRecord(job_id=job_id, files=files, tenant=tenant, created_at_s=time.time()))
        record = self.queue.claim(WORKER, 0.0)
        assert record is not None
        address = WorkerAddress(name=WORKER, endpoint=self.worker_endpoint, device="cpu", job_id=job_id)
        self.queue.announce(address)
        return Claim(record.job_id, record.attempt, WORKER)

    def finish(self, claim: Claim) -> str:
        """Make the job a scene; its id."""
        (self.store.work_folder(claim.job_id, claim.attempt) / MANIFEST).write_text("{}")
        self.store.publish_scene(claim.job_id, claim.attempt)
        assert self.queue.finish(claim)
        return claim.job_id

    def finished_scene(self, tenant: str = "local") -> str:
        """The id of a scene that can be shown."""
        return self.finish(self.running_job(tenant))


def nothing_to_see(request: RenderRequest | ExportRequest) -> Reply:
    """The answer of a worker that has no scene."""
    raise SceneError("There is no such scene.")


@contextmanager
def live_service(
    data_dir: Path, answer: Callable[[RenderRequest | ExportRequest], Reply] = nothing_to_see, **changes: Any
) -> Iterator[LiveService]:
    """Start a service whose worker answers so, hand it out, end it; `changes` are to its settings."""
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = Settings(data_dir=data_dir, port=port, min_free_bytes=0).model_copy(update=changes)
    queue, store = MemoryQueue(), Store(data_dir)
    endpoint = f"ipc://{short_socket_path(store.run_dir, f'{WORKER}.sock')}"
    server = Server(create_app(settings, queue, store, ZmqRenderer(queue, settings.render_timeout_s)), settings)
    thread = threading.Thread(target=server.run)
    with RequestServer(endpoint, at_once(answer)):
        queue.announce(WorkerAddress(name=WORKER, endpoint=endpoint, device="cpu"))
        thread.start()
        try:
            while not server.started:
                assert thread.is_alive()
                time.sleep(0.01)
            yield LiveService(port, queue, store, endpoint, server, thread)
        finally:
            server.should_exit = True
            thread.join()
