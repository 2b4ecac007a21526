"""The disk of a data directory: its free space, and the error that names it when it is full."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from intrasplat.files.disk_errors import DISK_FULL_ERRNOS, StoreFullError

PROBE_BYTES = 64 * 2**10
"""A disk on which this much cannot be written is full, whatever its free bytes: a quota may be used up."""

FULL_REMEDY = "Free space, or delete scenes: DELETE /scenes/ID."


class Disk:
    """The disk of a folder, which need not exist yet."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.expanduser().resolve()

    @property
    def _there(self) -> Path:
        return next(path for path in (self._folder, *self._folder.parents) if path.is_dir())

    @property
    def name(self) -> str:
        """The folder and the mount point of its disk, for messages."""
        mount = next(path for path in (self._folder, *self._folder.parents) if os.path.ismount(path))
        return f"the disk of {self._folder}" + ("" if mount == self._folder else f" (mounted at {mount})")

    def free_bytes(self) -> int:
        """Bytes that this user can still write, ignoring quotas. Raises OSError if the disk is gone."""
        status = os.statvfs(self._there)
        return status.f_bavail * status.f_frsize

    def is_full(self) -> bool:
        """Whether not even PROBE_BYTES can be written."""
        try:
            with tempfile.TemporaryFile(dir=self._there) as probe:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(probe.fileno(), 0, PROBE_BYTES)
                else:
                    probe.write(bytes(PROBE_BYTES))
        except OSError as error:
            return error.errno in DISK_FULL_ERRNOS
        return False

    def full_error(self) -> StoreFullError:
        """The error that names this disk, for operators of the service, not for its clients."""
        problem = f"There is no room left on {self.name}: {self.free_bytes() >> 20} MiB are free."
        return StoreFullError(problem, FULL_REMEDY)
