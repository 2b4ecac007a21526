"""The only place that puts a file or a folder on disk whole: after a crash or a loss of power it is the old or the new.

Everything is written aside, flushed, renamed into place, and the folder that holds the name is flushed.
"""

from __future__ import annotations

import os
from pathlib import Path

OWNER_ONLY = 0o600
FOR_ALL = 0o666
"""Less what the user's umask takes away."""


def flush(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def aside_of(path: Path) -> Path:
    """Where a file is written before it takes its place; a crash may leave it there."""
    return path.with_name(f".{path.name}.new")


def replace_file(path: Path, content: bytes, mode: int = OWNER_ONLY) -> None:
    """Write a file whole, in place of any that is there. It is on disk when this returns.

    Only one process at a time may write the same file.

    Args:
        mode: the file's permissions before the umask.

    Raises:
        OSError: the disk is full or refuses; the old file is as it was.
    """
    aside = aside_of(path)
    aside.unlink(missing_ok=True)  # left by a crash
    try:
        descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        with open(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(descriptor)
        aside.rename(path)
    finally:
        aside.unlink(missing_ok=True)
    flush(path.parent)


def move_folder(source: Path, target: Path) -> None:
    """Rename a folder after every byte of it is on disk. The new name is on disk when this returns.

    Raises:
        OSError: the disk refuses; the folder is where it was.
    """
    for path in source.rglob("*"):
        flush(path)
    flush(source)
    source.rename(target)
    try:
        flush(target.parent)
    except OSError:
        target.rename(source)  # who hears that it failed must not find it done
        raise
