"""How much memory this process may use: the machine's, or less where a container or a service unit is limited."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

CONTROL_GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")
LIMIT_FILES = {"": "memory.max", "memory": "memory.limit_in_bytes"}
"""By the controllers of a line of OWN_GROUPS: version 2 names none there."""


def memory_bytes(groups: Path = CONTROL_GROUPS, own: Path = OWN_GROUPS) -> int | None:
    """The least of the machine's memory and the limits of this process's control groups; None: nothing tells.

    Args:
        groups: where the control groups are mounted.
        own: the file that names this process's.
    """
    return min((*_of_machine(), *_limits(groups, own)), default=None)


def _of_machine() -> Iterator[int]:
    try:
        found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not every system tells
        return
    if found > 0:
        yield found


def _limits(groups: Path, own: Path) -> Iterator[int]:
    """Of the groups and of all above them. In a container the path may be the host's, which is not there: the
    container's own group is mounted where the host's topmost would be."""
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
            except (OSError, ValueError):  # not there, or "max"
                continue
