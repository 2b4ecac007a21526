"""Atomic, durable writes of files and folders: after a crash or power loss there is the old or the new one, complete.

The content is written to a temporary name, flushed and renamed; then the parent folder is flushed.
"""

from __future__ import annotations

import os
from pathlib import Path

OWNER_ONLY = 0o600
FOR_ALL = 0o666
"""File mode before the user's umask."""


def flush(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def temporary_path(path: Path) -> Path:
    """The temporary path at which a file is written before the rename; a crash may leave a file there."""
    return path.with_name(f".{path.name}.new")


def replace_file(path: Path, content: bytes, mode: int = OWNER_ONLY) -> None:
    """Write a file atomically, replacing any old one. It is on disk when this returns.

    Only one process at a time may write the same file.

    Args:
        mode: the file's permissions before the umask.

    Raises:
        OSError: the disk is full or refuses; the old file is unchanged.
    """
    temporary = temporary_path(path)
    temporary.unlink(missing_ok=True)  # left by a crash
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        with open(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(descriptor)
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)
    flush(path.parent)


def move_folder(source: Path, target: Path) -> None:
    """Rename a folder after all its content is on disk. The new name is on disk when this returns.

    Raises:
        OSError: the disk refuses; the folder keeps its old name.
    """
    for path in source.rglob("*"):
        flush(path)
    flush(source)
    source.rename(target)
    try:
        flush(target.parent)
    except OSError:
        target.rename(source)  # undo: after an error the new name must not exist
        raise
