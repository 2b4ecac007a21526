"""Disk blocks that are allocated to the queue's log in advance, so that a full disk does not stop the queue.

The server exits when a write to its log fails (`appendfsync always`). The reserve lies behind the end of the log's
newest file: the server appends into it, and no other file can take it.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

LOG_FOLDER = "appendonlydir"
RESERVE_BYTES = 16 * 2**20
"""About a day of an idle installation, and about ten hours of a job that reports its progress."""

_KEEP_SIZE = 1
"""FALLOC_FL_KEEP_SIZE of linux/falloc.h: allocate blocks without changing the length of the file."""


def fill_reserve(folder: Path) -> bool:
    """Allocate RESERVE_BYTES behind the newest log in the server's folder; call it often.

    Does nothing while at least half of them are left. False: there is no log, the disk has no free space, or its file
    system or this operating system cannot do it.
    """
    try:
        newest = max((folder / LOG_FOLDER).glob("*.incr.aof"), key=_sequence)
        status = newest.stat()
        if status.st_blocks * 512 - status.st_size >= RESERVE_BYTES // 2:
            return True
        descriptor = os.open(newest, os.O_WRONLY | os.O_CLOEXEC)
        try:
            return _allocate(descriptor, status.st_size, RESERVE_BYTES)
        finally:
            os.close(descriptor)
    except (OSError, ValueError):  # no log yet, or the server has just replaced it
        return False


def _sequence(path: Path) -> int:
    """The N of appendonly.aof.N.incr.aof."""
    return int(path.name.split(".")[-3])


def _allocate(descriptor: int, start: int, length: int) -> bool:
    fallocate = getattr(ctypes.CDLL(None), "fallocate", None)  # os.posix_fallocate would make the file longer
    if fallocate is None:
        return False
    return bool(fallocate(descriptor, _KEEP_SIZE, ctypes.c_int64(start), ctypes.c_int64(length)) == 0)
