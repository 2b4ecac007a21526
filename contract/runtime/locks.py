"""A file lock that the system releases when its process ends: one process of a kind for each data directory."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from intrasplat.errors import UnavailableError

LOCK_TIMEOUT_S = 5.0
"""How long locked() waits for the lock. Others hold it for milliseconds only."""
TRY_PERIOD_S = 0.005


class FolderLock:
    """A lock that this process holds from take() until release() or its end, kill -9 included."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    def take(self) -> bool:
        """Take the lock without waiting; False if another process holds it. True if this object holds it already."""
        if self._descriptor is not None:
            return True
        descriptor = os.open(self._path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return False
        self._descriptor = descriptor
        return True

    def release(self) -> None:
        """Release the lock if this object holds it."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


@contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Hold the lock of this file during the context; no other process or thread has it meanwhile.

    Args:
        what: what is changed meanwhile, for the error message.

    Raises:
        UnavailableError: another process or thread holds it for longer than LOCK_TIMEOUT_S.
        OSError: the file cannot be opened.
    """
    lock = FolderLock(path)
    deadline_s = time.monotonic() + LOCK_TIMEOUT_S
    while not lock.take():
        if time.monotonic() > deadline_s:
            raise UnavailableError(f"Another process is changing {what}.", "Try again.")
        time.sleep(TRY_PERIOD_S)
    try:
        yield
    finally:
        lock.release()
