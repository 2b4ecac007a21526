"""What the store's and the audit's tests say often."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

from contract.store.store import Store, new_job_id
from contract.wire.job import JobFiles, JobRecord


def received(store: Store) -> JobRecord:
    """A clip that came in and is no job yet."""
    record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=5.0)
    (store.open_incoming(record.job_id) / "clip.mp4").write_bytes(b"frames")
    return record


def accepted(store: Store) -> JobRecord:
    """A clip in the spool."""
    record = received(store)
    store.accept(record)
    return record


@contextmanager
def files_no_larger_than(limit_bytes: int) -> Iterator[None]:
    """As under a quota: a longer write is cut short or fails with EFBIG."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
