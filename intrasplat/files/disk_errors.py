"""Converts errors of the operating system to errors that name a remedy."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator

from intrasplat.errors import ErrorCode, UnavailableError

DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
NOT_WRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
NOT_THERE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.ESTALE})


class StoreFullError(UnavailableError):
    """The data directory's disk, quota or file size limit is used up. Earlier files are intact.

    Space may become free at any time (may_return), so processes wait for it.
    """

    code = ErrorCode.STORE_FULL

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy, may_return=True)


@contextlib.contextmanager
def disk_errors() -> Iterator[None]:
    """Context manager that converts an OSError to an UnavailableError with a remedy and without file names."""
    try:
        yield
    except OSError as error:
        raise _disk_error(error) from error


def _disk_error(error: OSError) -> UnavailableError:
    reason = os.strerror(error.errno) if error.errno else type(error).__name__
    if error.errno in DISK_FULL_ERRNOS:
        problem = f"There is no room left in the data directory ({reason})."
        return StoreFullError(problem, "Purge scenes that are no longer needed, or give it a larger disk or quota.")
    if error.errno in NOT_WRITABLE:
        problem = f"The data directory cannot be written to ({reason})."
        return UnavailableError(problem, "Mount it for writing, and give it to the user that runs intrasplat.")
    if error.errno in NOT_THERE:
        problem = f"A folder of the data directory is gone ({reason})."
        return UnavailableError(problem, "See that its disk is mounted, and start intrasplat again.")
    return UnavailableError(f"The data directory's disk fails ({reason}).", "Look into the system's log.")
