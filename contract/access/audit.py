"""The audit log: who did what to which job, one JSON line for each act. Lines are only appended.

A line names keys, tenants and jobs by their ids, and never a file, a person or a picture. It is on disk before the act
goes on, so an act that cannot be recorded does not happen. A reserve file of zeros shrinks piece by piece when the disk
is full. Without it, nobody could then look at a scene or delete one. The lines are chained by hashes (chain.py).
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from contract.access.chain import HEAD_PATTERN, START, head_of
from contract.runtime.locks import held
from intrasplat.files.disk_errors import StoreFullError, disk_errors
from intrasplat.files.durable import flush

AUDIT_FILE = "audit.jsonl"
RESERVE_FILE = "audit.reserve"
HEAD_FILE = "audit.head"
"""The head of the chain, and the lock of whoever appends. It counts only where the audit was moved away. It is noted
after the line, and flushed once a file: a kill in between leaves the head before that line, and a loss of power may
leave an earlier one, which the next file then names if this one is moved away at once (chain.unnamed_lines)."""
RESERVE_BYTES = 4 * 2**20
"""About 12,000 lines."""
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

    chain: str | None = None
    """Of chain.py, set by AuditLog.append; the first field, so that it is found in a line that was cut off."""
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

    It is opened for each line, so it may be moved away at any time, as logrotate does; the next file goes on with its
    chain.
    """

    def __init__(self, data_dir: Path) -> None:
        self._path = data_dir.expanduser() / AUDIT_FILE
        self._head = data_dir.expanduser() / HEAD_FILE
        self._reserve = data_dir.expanduser() / RESERVE_FILE

    def append(self, entry: AuditEntry) -> None:
        """Write one line and wait until it is on disk.

        Raises:
            StoreFullError: the disk is full and the reserve is used up.
            UnavailableError: the file cannot be written for another reason.
        """
        while True:
            try:
                with disk_errors(), held(self._head, "the audit"):
                    return self._write(entry)
            except StoreFullError:
                if not self._shrink_reserve():
                    raise

    def fill_reserve(self) -> None:
        """Fill the reserve file as far as the disk has room now."""
        with contextlib.suppress(OSError):
            descriptor = os.open(self._reserve, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                if os.fstat(descriptor).st_size < RESERVE_BYTES:
                    os.posix_fallocate(descriptor, 0, RESERVE_BYTES)
            finally:
                os.close(descriptor)

    def _write(self, entry: AuditEntry) -> None:
        head = os.open(self._head, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        audit = os.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            size = os.fstat(audit).st_size
            noted = os.pread(head, len(START), 0).decode("ascii", "replace")
            if not re.fullmatch(HEAD_PATTERN, noted):
                noted = START
                _put(head, noted)  # from now on, writing over it needs no room
            chained = entry.model_copy(update={"chain": head_of(audit) or noted})
            line = chained.model_dump_json(exclude_none=True).encode()
            is_cut_off = size > 0 and os.pread(audit, 1, size - 1) != b"\n"  # keep this one apart from it
            text = b"\n" * is_cut_off + line + b"\n"
            if os.write(audit, text) < len(text):
                with contextlib.suppress(OSError):
                    os.ftruncate(audit, size)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(audit)
            if size == 0:  # the name of the new file, and the head that it goes on from
                os.fsync(head)
                flush(self._path.parent)
            with contextlib.suppress(OSError):
                _put(head, hashlib.sha256(line).hexdigest())
        finally:
            os.close(audit)
            os.close(head)

    def _shrink_reserve(self) -> bool:
        """Return a piece of the reserve to the disk; False if nothing is left."""
        try:
            size = self._reserve.stat().st_size
            os.truncate(self._reserve, max(0, size - RESERVE_PIECE_BYTES))
        except OSError:
            return False
        return size > 0


def _put(descriptor: int, head: str) -> None:
    if os.pwrite(descriptor, head.encode(), 0) < len(head):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
