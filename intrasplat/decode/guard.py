"""Confines the decoding process before it opens untrusted files.

The limits apply on every system. Some protections depend on the kernel. Without them decoding continues, and the report
lists them as missing. The process cannot undo any of it.
"""

from __future__ import annotations

import ctypes
import resource
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from intrasplat.decode.landlock import confine_files
from intrasplat.decode.seccomp import forbid_network_and_programs
from intrasplat.machine.processes import die_with_parent

MAX_OPEN_FILES = 128  # a zip, a video, the results, and Python's own files

_PR_SET_NO_NEW_PRIVS = 38
_CLONE_NEWUSER = 0x10000000
_CLONE_NEWNET = 0x40000000
_CAPABILITY_VERSION = 0x20080522
_CAP_DAC_READ_SEARCH = 1 << 2  # kept if present: a worker that runs as root reads other users' files

LIMITED_MEMORY = "limited memory"
NO_NETWORK = "no network"
NO_PROGRAMS = "no other program"
OWN_FILES = "no files but its own"
PROTECTIONS = (LIMITED_MEMORY, NO_NETWORK, NO_PROGRAMS, OWN_FILES)


@dataclass(frozen=True)
class Allowance:
    """Limits of the process: memory, size of a file that it writes, CPU seconds over all cores."""

    memory_bytes: int
    file_bytes: int
    cpu_s: int


def lock_in(
    allowance: Allowance,
    readable: Sequence[Path],
    writable: Path,
    devices: Sequence[Path] = (),
    connect_port: int | None = None,
) -> list[str]:
    """Drop privileges that decoding does not need. Returns the protections that were granted.

    Call it before the first thread starts. readable lists the untrusted files and folders; writable is the folder for
    the results; devices are capture devices; with connect_port the process may open internet sockets, which the kernel
    restricts to that port if it can.

    Raises:
        OSError: a limit cannot be set.
        RuntimeError: another thread runs, which would remain unconfined.
    """
    _check_alone()
    die_with_parent()
    _gain_no_privileges()
    _limit(resource.RLIMIT_CORE, 0)  # a core dump would contain the clip
    _limit(resource.RLIMIT_FSIZE, allowance.file_bytes)
    _limit(resource.RLIMIT_CPU, allowance.cpu_s, allowance.cpu_s + 1)  # SIGXCPU names the cause; SIGKILL follows
    _limit(resource.RLIMIT_NOFILE, MAX_OPEN_FILES)
    granted = [LIMITED_MEMORY] if _limit_memory(allowance.memory_bytes) else []
    apart = connect_port is None and _leave_network()
    confined = confine_files(_libraries() + list(readable), writable, devices, connect_port)
    _drop_capabilities()
    filtered = forbid_network_and_programs(with_sockets=connect_port is not None)
    if apart or (filtered and connect_port is None):
        granted.append(NO_NETWORK)
    if filtered:
        granted.append(NO_PROGRAMS)
    if confined:
        granted.append(OWN_FILES)
    return granted


def _check_alone() -> None:
    threads = Path("/proc/self/task")
    if threads.is_dir() and len(list(threads.iterdir())) > 1:
        raise RuntimeError("a library has started a thread, which would not be confined")


def _limit(kind: int, soft: int, hard: int | None = None) -> None:
    """Lower a limit, unless it is lower already."""
    _, maximum = resource.getrlimit(kind)
    hard = soft if hard is None else hard
    hard = hard if maximum == resource.RLIM_INFINITY else min(hard, maximum)
    resource.setrlimit(kind, (min(soft, hard), hard))


def _limit_memory(max_bytes: int) -> bool:
    """Limit memory; False if the system refuses, as macOS may."""
    try:
        _limit(resource.RLIMIT_AS, max_bytes)
    except (ValueError, OSError):
        return False
    return True


def _gain_no_privileges() -> None:
    """Forbid new privileges, which Landlock and seccomp require."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)


def _drop_capabilities() -> None:
    """Drop all capabilities except _CAP_DAC_READ_SEARCH, also those in a user namespace of our own."""
    if not sys.platform.startswith("linux"):
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header = struct.pack("=Ii", _CAPABILITY_VERSION, 0)
    capabilities = ctypes.create_string_buffer(
        struct.calcsize("=6I")
    )  # effective, permitted, inheritable; then bits 32 up
    if libc.capget(header, capabilities) == 0:
        kept = struct.unpack_from("=I", capabilities, 4)[0] & _CAP_DAC_READ_SEARCH
        libc.capset(header, struct.pack("=6I", kept, kept, 0, 0, 0, 0))


def _leave_network() -> bool:
    """Move to an empty network namespace, within a user namespace if necessary; whether the kernel allowed it."""
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    return any(libc.unshare(flags) == 0 for flags in (_CLONE_NEWNET, _CLONE_NEWUSER | _CLONE_NEWNET))


def _libraries() -> list[Path]:
    """The folders of Python and of the libraries that it loads."""
    package = Path(__file__).resolve().parents[1]
    installed = (sys.prefix, sys.base_prefix, *(each for each in sys.path if "-packages" in each))
    return [package, *map(Path, (*installed, "/usr", "/lib", "/lib64"))]
