"""The audit log: who did what to which job, one JSON line for each action. Lines are only appended.

A line names keys, tenants and jobs by their ids, and never a file, a person or a picture. It is on disk before the
action takes place, so an action that cannot be recorded does not happen. When the disk is full, a reserve file of zeros
shrinks piece by piece to free space for lines. Without the reserve, nobody could then view or delete a scene.
"""

from __future__ import annotations

import contextlib
import errno
import os
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from contract.runtime.locks import locked
from intrasplat.files.disk_errors import StoreFullError, disk_errors
from intrasplat.files.durable import flush

AUDIT_FILE = "audit.jsonl"
RESERVE_FILE = "audit.reserve"
RESERVE_BYTES = 4 * 2**20
"""The size of the reserve file: about 18,000 lines."""
RESERVE_PIECE_BYTES = 64 * 2**10


class AuditAction(StrEnum):
    """The acts that are recorded."""

    ACCEPTED = "accepted"
    IMPORTED = "imported"
    """A scene of another installation was accepted."""
    VIEWED = "viewed"
    """At most once a minute for each key and scene, not for each picture."""
    EXPORTED = "exported"
    DOWNLOADED = "downloaded"
    LABELLED = "labelled"
    """Its label or metadata were changed; the audit does not hold them."""
    CANCELLED = "cancelled"
    RETRIED = "retried"
    SENT_AGAIN = "sent-again"
    """The webhook about its end."""
    PURGED = "purged"
    """Two lines: "begun", then "done". The outcome also says whether retention did it."""
    FEED_OPENED = "feed-opened"
    """This and the next ones name the feed as the job."""
    FEED_PAUSED = "feed-paused"
    FEED_RESUMED = "feed-resumed"
    FEED_PUSHED = "feed-pushed"
    """A caller's connection began to push its video."""
    FEED_CUT = "feed-cut"
    """A part of its recording became a job; the outcome names it."""
    FEED_ENDED = "feed-ended"
    """Its end was asked for, with all that belongs to it."""
    REFUSED = "refused"
    """A missing or wrong key, a missing scope, another tenant's job. The outcome is the HTTP status."""
    KEY_CREATED = "key-created"
    """This and the next two: two lines, "begun", then "done"."""
    KEY_REVOKED = "key-revoked"
    KEY_ROTATED = "key-rotated"
    """It has a successor; the outcome says which, and when this one ends."""
    BACKED_UP = "backed-up"
    """All of it was copied."""
    RESTORED = "restored"
    """The lines before are of the backup; its time is the outcome."""


class AuditEntry(BaseModel):
    """One line."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    time: str
    action: AuditAction
    outcome: str = "ok"
    job_id: str | None = None
    tenant: str | None = None
    key_id: str | None = None
    address: str | None = None
    request_id: str | None = None


def utc_now() -> str:
    """The time of an entry, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def utc_text(at_s: float) -> str:
    """A UNIX time for people and in outcomes, ISO 8601 to the second."""
    return datetime.fromtimestamp(at_s, UTC).isoformat(timespec="seconds")


class AuditLog:
    """The audit log of one data directory. Any number of processes may append to it.

    The file is opened for each line, so logrotate may move it away at any time.
    """

    def __init__(self, data_dir: Path) -> None:
        self._path = data_dir.expanduser() / AUDIT_FILE
        self._reserve = data_dir.expanduser() / RESERVE_FILE

    def append(self, entry: AuditEntry) -> None:
        """Write one line and wait until it is on disk.

        Raises:
            StoreFullError: the disk is full and the reserve is used up.
            UnavailableError: the file cannot be written for another reason.
        """
        line = entry.model_dump_json(exclude_none=True).encode() + b"\n"
        while True:
            try:
                with disk_errors(), locked(self._path, "the audit"):
                    return self._write(line)
            except StoreFullError:
                if not self._shrink_reserve():
                    raise

    def fill_reserve(self) -> None:
        """Fill the reserve file as far as the free space on the disk allows."""
        with contextlib.suppress(OSError):
            descriptor = os.open(self._reserve, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                if os.fstat(descriptor).st_size < RESERVE_BYTES:
                    os.posix_fallocate(descriptor, 0, RESERVE_BYTES)
            finally:
                os.close(descriptor)

    def _write(self, line: bytes) -> None:
        descriptor = os.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            size = os.fstat(descriptor).st_size
            if size and os.pread(descriptor, 1, size - 1) != b"\n":
                line = b"\n" + line  # a crash cut off the last line; this one starts on its own line
            if os.write(descriptor, line) < len(line):
                with contextlib.suppress(OSError):
                    os.ftruncate(descriptor, size)  # safe under the lock: no other process has appended since
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(descriptor)
            if size == 0:
                flush(self._path.parent)  # the name of the new file
        finally:
            os.close(descriptor)

    def _shrink_reserve(self) -> bool:
        """Return a piece of the reserve to the disk; False if nothing is left."""
        try:
            size = self._reserve.stat().st_size
            os.truncate(self._reserve, max(0, size - RESERVE_PIECE_BYTES))
        except OSError:
            return False
        return size > 0
