"""The memory that this process may use: the machine's, or less in a container or a service unit with a limit."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

CONTROL_GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")
LIMIT_FILES = {"": "memory.max", "memory": "memory.limit_in_bytes"}
"""Limit files by the controller in a line of OWN_GROUPS; the empty name is that of cgroup version 2."""


def memory_bytes(groups: Path = CONTROL_GROUPS, own: Path = OWN_GROUPS) -> int | None:
    """The minimum, in bytes, of the machine's memory and the limits of this process's control groups; None: unknown.

    Args:
        groups: mount point of the control groups.
        own: the file that names this process's groups.
    """
    return min((*_of_machine(), *_limits(groups, own)), default=None)


def _of_machine() -> Iterator[int]:
    try:
        found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not available on every system
        return
    if found > 0:
        yield found


def _limits(groups: Path, own: Path) -> Iterator[int]:
    """Limits of the groups and of all their parents. In a container the path may be the host's, which does not exist
    there: the container's own group is mounted in place of the host's root group."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers not in LIMIT_FILES:
            continue
        below = PurePosixPath(path.lstrip("/"))
        for folder in (below, *below.parents):
            try:
                yield int((groups / controllers / folder / LIMIT_FILES[controllers]).read_text())
            except (OSError, ValueError):  # no such file, or "max"
                continue
