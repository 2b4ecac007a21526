"""An allow-list of files and of TCP ports (Linux, Landlock): a compromised decoder cannot read other clips or keys."""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
import sys
from collections.abc import Sequence
from pathlib import Path

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same numbers on every architecture
_ASK_VERSION = 1
_PATH_BENEATH, _TCP_PORT = 1, 2  # kinds of rules
_FIRST_WITH_TCP = 4  # version

# rights (linux/landlock.h)
_EXECUTE, _READ_FILE, _READ_FOLDER = 1 << 0, 1 << 2, 1 << 3
_FILE_RIGHTS = _EXECUTE | 1 << 1 | _READ_FILE | 1 << 14 | 1 << 15  # the rights that a rule on a file may contain
_RIGHTS_BY_VERSION = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 4: (1 << 15) - 1, 5: (1 << 16) - 1}
_BIND_TCP, _CONNECT_TCP = 1 << 0, 1 << 1
_READING = _EXECUTE | _READ_FILE | _READ_FOLDER
_DEVICE = _READ_FILE | 1 << 1 | 1 << 15  # read, write, ioctl


def confine_files(
    readable: Sequence[Path], writable: Path, devices: Sequence[Path] = (), connect_port: int | None = None
) -> bool:
    """Allow this thread and those that it starts to read only `readable`, to change only `writable`, to control only
    `devices`, and to connect by TCP only to `connect_port`; they may offer no port. Old kernels restrict no ports.

    False if the kernel cannot. Paths are files or folders; missing ones are ignored. It needs PR_SET_NO_NEW_PRIVS.
    """
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    version = libc.syscall(_CREATE_RULESET, None, 0, _ASK_VERSION)
    if version < 1:
        return False
    handled = _RIGHTS_BY_VERSION[min(version, max(_RIGHTS_BY_VERSION))]
    attributes = struct.pack("=QQ", handled, _BIND_TCP | _CONNECT_TCP)[: 16 if version >= _FIRST_WITH_TCP else 8]
    ruleset = libc.syscall(_CREATE_RULESET, attributes, len(attributes), 0)
    if ruleset < 0:
        return False
    try:
        for path in readable:
            _allow(libc, ruleset, path, _READING & handled)
        for path in devices:
            _allow(libc, ruleset, path, _DEVICE & handled)
        _allow(libc, ruleset, writable, handled & ~_EXECUTE)
        if connect_port is not None and version >= _FIRST_WITH_TCP:
            libc.syscall(_ADD_RULE, ruleset, _TCP_PORT, struct.pack("=QQ", _CONNECT_TCP, connect_port), 0)
        return bool(libc.syscall(_RESTRICT_SELF, ruleset, 0) == 0)
    finally:
        os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, path: Path, rights: int) -> None:
    with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            rights = rights if path.is_dir() else rights & _FILE_RIGHTS
            libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, struct.pack("=Qi", rights, descriptor), 0)
        finally:
            os.close(descriptor)
