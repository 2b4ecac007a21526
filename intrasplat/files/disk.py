"""The disk of a data directory: how much room it has, and the error that names it when it has none."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from intrasplat.files.disk_errors import NO_ROOM, StoreFullError

PROBE_BYTES = 64 * 2**10
"""A disk that cannot give this much is full, whatever it says of its free bytes: a quota may be used up."""

FULL_REMEDY = "Free space, or delete scenes: DELETE /scenes/ID."


class Disk:
    """The disk that holds a folder, or that would hold it if it were made."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.expanduser().resolve()

    @property
    def _there(self) -> Path:
        return next(path for path in (self._folder, *self._folder.parents) if path.is_dir())

    @property
    def name(self) -> str:
        """The folder and where its disk is mounted, for people."""
        mount = next(path for path in (self._folder, *self._folder.parents) if os.path.ismount(path))
        return f"the disk of {self._folder}" + ("" if mount == self._folder else f" (mounted at {mount})")

    def free_bytes(self) -> int:
        """What this user may still write, without regard to quotas. Raises OSError if the disk is gone."""
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
            return error.errno in NO_ROOM
        return False

    def full_error(self) -> StoreFullError:
        """The error that names this disk; for whoever runs the service, not for its callers."""
        problem = f"There is no room left on {self.name}: {self.free_bytes() >> 20} MiB are free."
        return StoreFullError(problem, FULL_REMEDY)
