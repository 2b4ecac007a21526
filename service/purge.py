"""Removes a job and all its data, with a receipt, and finishes removals that were cut off.

Order: write a note (data_dir/purging/<job>), remove the files, the queue's record, then the note. If the service ends
in between, the note makes service/retention.py repeat all steps. While the record exists, another request does so too.
"""

from __future__ import annotations

import contextlib
import logging
import time
from pathlib import Path

from pydantic import BaseModel, Field

from contract.access.audit import AuditAction, utc_now
from contract.queue.interface import Queue
from contract.store.shelf import Removed, is_job_id
from contract.store.store import PURGING, Store
from contract.wire.job import TERMINAL_STATES
from intrasplat.errors import UnavailableError
from intrasplat.files.disk_errors import StoreFullError, disk_errors
from intrasplat.files.durable import flush
from service.access import Caller
from service.audit import Audit
from service.done import DoneJobs
from service.partial import partials_of
from service.problems import Problem

NOTE_IS_OLD_S = 60.0
"""A younger note may belong to a removal that still runs."""
LOG_CLEARED_AFTER_S = 90.0
"""The queue itself stores for a minute which ids were removed."""
logger = logging.getLogger("intrasplat.service")


class Receipt(BaseModel):
    """What was removed of a job. Counts are of this removal: one that goes on after a cut counts the rest."""

    job_id: str
    purged_at: str = Field(description="ISO 8601, UTC")
    files: dict[str, int] = Field(description="removed files by area: incoming, spool, work, scenes, uploads")
    bytes: dict[str, int] = Field(description="removed bytes by area")
    record: bool = Field(description="the queue holds no record, event or idempotency key of it")
    verified: bool = Field(description="it was looked whether anything is left, and nothing is")
    clip_kept_by: list[str] = Field(default=[], description="other jobs that have the same clip (clip_of), and keep it")


class Purger:
    """Removes jobs from queue and store."""

    def __init__(self, queue: Queue, store: Store, audit: Audit, done: DoneJobs) -> None:
        self._queue = queue
        self._store = store
        self._audit = audit
        self._done = done
        self._notes = store.data_dir / PURGING
        self._log_stale_since_s: float | None = None

    def purge(self, job_id: str, caller: Caller | None, reason: str = "request") -> Receipt:
        """Remove a job that has ended. The audit log records the start and the end.

        Raises:
            Problem: 409: the job is queued or running.
            UnavailableError: queue, store or audit log fails; the removal is finished later, or by asking again.
        """
        self._refuse_live(job_id)
        self._audit.record(AuditAction.PURGED, caller, job_id, f"begun ({reason})")
        note = self._write_note(job_id)
        uploads = self._remove_uploads(job_id)
        removed = self._store.purge(job_id)
        self._audit.record(AuditAction.PURGED, caller, job_id, f"done ({reason})")
        self._queue.forget(job_id)
        self._done.forget(job_id)
        self.log_is_stale()
        self._refuse_live(job_id)
        receipt = self._receipt(job_id, removed, uploads)
        note.unlink(missing_ok=True)
        return receipt

    def log_is_stale(self) -> None:
        """Note that the queue's log on disk contains a purged job."""
        self._log_stale_since_s = time.monotonic()

    def clear_log(self, now_s: float | None = None) -> None:
        """Remove purged jobs from the queue's log on disk, once their keys have expired. now_s: monotonic."""
        since_s, now_s = self._log_stale_since_s, time.monotonic() if now_s is None else now_s
        if since_s is not None and now_s - since_s > LOG_CLEARED_AFTER_S and self._queue.rewrite_log():
            self._log_stale_since_s = None

    def finish_cut_off(self) -> None:
        """Finish the removals that earlier services had started."""
        for note in list(self._notes.glob("*")) if self._notes.is_dir() else []:
            with contextlib.suppress(FileNotFoundError):  # finished meanwhile
                if is_job_id(note.name) and note.stat().st_mtime < time.time() - NOTE_IS_OLD_S:
                    try_to_purge(self, note.name, "finished later")

    def _refuse_live(self, job_id: str) -> None:
        record = self._queue.get(job_id)
        if record is not None and record.state not in TERMINAL_STATES:
            remedy = f"Cancel it first: DELETE /jobs/{job_id}."
            raise Problem(409, f"The job is still {record.state}.", field="scene_id", remedy=remedy)

    def _write_note(self, job_id: str) -> Path:
        """Note on disk that the job is being removed. A full disk does not stop a removal, which frees space."""
        note = self._notes / job_id
        with contextlib.suppress(StoreFullError), disk_errors():
            self._notes.mkdir(mode=0o700, exist_ok=True)
            note.touch(mode=0o600)
            flush(self._notes)
        return note

    def _remove_uploads(self, job_id: str) -> Removed:
        """Remove the folders of the job's resumable uploads."""
        files = sizes = 0
        with disk_errors():
            for partial in partials_of(self._store, job_id):
                with contextlib.suppress(FileNotFoundError):  # another process removes the same
                    found = [path.stat().st_size for path in partial.folder.iterdir()]
                    files, sizes = files + len(found), sizes + sum(found)
                self._store.discard_incoming(partial.upload_id)
        return Removed({"uploads": files}, {"uploads": sizes})

    def _receipt(self, job_id: str, removed: Removed, uploads: Removed) -> Receipt:
        """The receipt, after a check that nothing is left; the store has checked its own files."""
        if self._queue.get(job_id) is not None or self._queue.events(job_id):
            raise UnavailableError(f"The queue still knows job {job_id}.", "Ask for its removal once more.")
        return Receipt(
            job_id=job_id,
            purged_at=utc_now(),
            files=removed.files | uploads.files,
            bytes=removed.bytes | uploads.bytes,
            record=True,
            verified=True,
        )


def try_to_purge(purger: Purger, job_id: str, reason: str) -> bool:
    """Purge a job for the service itself. If that fails, log it and return False; the next call tries again."""
    try:
        purger.purge(job_id, None, reason)
    except Problem:  # the job was queued again meanwhile
        return False
    except (OSError, UnavailableError) as error:
        logger.error("a job could not be purged", extra={"job_id": job_id, "error": type(error).__name__})
        return False
    return True
