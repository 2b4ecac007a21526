"""A queue and a store with jobs in them, and waiting for what becomes of these: for tests of a worker."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from contract.queue.interface import Queue
from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.job import TERMINAL_STATES, JobFiles, JobRecord, JobState
from intrasplat.options import JobOptions

WAIT_S = 40.0
STANDIN = Path(__file__).with_name("standin.py")


def eventually(holds: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


class Jobs:
    """The jobs of a queue and their files."""

    def __init__(self, queue: Queue, store: Store) -> None:
        self.queue = queue
        self.store = store

    def submit(self, clip: str | Path, **options: object) -> str:
        """Send a clip: a file, or a text that tells standin.py what to do."""
        name, content = ("clip.mp4", clip.encode()) if isinstance(clip, str) else (clip.name, clip.read_bytes())
        files, chosen = JobFiles(clip=name), JobOptions.model_validate(options)
        record = JobRecord(job_id=new_job_id(), files=files, options=chosen, created_at_s=time.time())
        (self.store.open_incoming(record.job_id) / name).write_bytes(content)
        self.store.accept(record)
        self.queue.submit(record)
        return record.job_id

    def record(self, job_id: str) -> JobRecord:
        record = self.queue.get(job_id)
        assert record is not None
        return record

    def state(self, job_id: str) -> JobState:
        return self.record(job_id).state

    def wait_for_end(self, job_id: str) -> JobRecord:
        eventually(lambda: self.state(job_id) in TERMINAL_STATES)
        return self.record(job_id)

    def wait_for_step(self, job_id: str, attempt: int = 1) -> None:
        """Until this attempt trains."""

        def trains() -> bool:
            record = self.record(job_id)
            return record.attempt == attempt and record.progress is not None and record.progress.iteration > 0

        eventually(trains)

    def files(self, job_id: str, area: str = "") -> list[Path]:
        """What there is of a job on disk."""
        return [path for path in (self.store.data_dir / area).rglob("*") if path.name.startswith(job_id)]
