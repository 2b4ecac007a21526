"""What the store's and the audit's tests say often."""

from __future__ import annotations

import hashlib
import json
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from contract.queue.interface import Queue
from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.job import JobFiles, JobRecord
from intrasplat.names import MANIFEST
from tests.contract.queues import claimed

BUCKET_URL = "s3://clips/of/all"
SERVICE = 12345
"""The id of a user that is not this one."""


def given_to(user_id: int, folder: Path) -> None:
    """Make a folder with all in it a user's own, as root may."""
    for path in (folder, *folder.rglob("*")):
        os.chown(path, user_id, user_id)


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


def published(store: Store, job_id: str, attempt: int, content: bytes = b"tensors") -> Path:
    """The folder of a scene with that content."""
    folder = store.work_folder(job_id, attempt)
    (folder / "scene.safetensors").write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    (folder / MANIFEST).write_text(json.dumps({"files": {"scene.safetensors": {"sha256": digest}}}))
    return store.publish_scene(job_id, attempt)


def finished(store: Store, queue: Queue, job_id: str) -> str:
    """The job, which is the next in the queue, done: its scene is published."""
    _, claim = claimed(queue)
    published(store, job_id, claim.attempt)
    assert queue.finish(claim)
    return job_id


def lead_to(environment: pytest.MonkeyPatch, server: str) -> None:
    """Make a store in a bucket use that server."""
    environment.setenv("AWS_ENDPOINT_URL", server)
    environment.setenv("AWS_ACCESS_KEY_ID", "key")
    environment.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    environment.setenv("AWS_DEFAULT_REGION", "us-east-1")


@contextmanager
def files_no_larger_than(limit_bytes: int) -> Iterator[None]:
    """As under a quota: a longer write is cut short or fails with EFBIG."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
