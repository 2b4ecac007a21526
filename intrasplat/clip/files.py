"""A folder, a zip or a single image as one flat list of named files, read into memory.

Archives are untrusted: intrasplat/intake/zips.py defines what is refused, and no member is written under its own name.
"""

from __future__ import annotations

import os
import re
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, TypeVar

from intrasplat.errors import InputError, LimitError
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.zips import UNREADABLE, check_member_count, open_zip

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm"})
MAX_FOLDER_DEPTH = 6  # levels below the given folder; also limits a loop of linked folders
_CHUNK_BYTES = 1 << 20
_LAYOUT_FOLDERS = frozenset({"images", "depth", "masks", "mask", "left", "right"})  # never removed as a wrapping folder

_Item = TypeVar("_Item")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts frame9 before frame10."""
    parts = re.split(r"([0-9]+)", name.lower())
    numbers = (part.lstrip("0") for part in parts[1::2])
    keys: list[tuple[int, int, str]] = [(1, 0, part) for part in parts]
    keys[1::2] = [(0, len(number), number) for number in numbers]
    return tuple(keys)


@dataclass(frozen=True)
class FileTree(ABC):
    """Files by relative name ("images/000001.png"), in natural order, without wrapping folders.

    field is the input that errors name ("clip", "masks", "right"); label is the tree's name in messages.
    """

    field: str
    label: str
    names: tuple[str, ...]
    limits: ClipLimits

    @abstractmethod
    def open(self, name: str) -> IO[bytes]:
        """The file, open for reading. Raises the exceptions of zipfile and of the operating system."""

    def path(self, name: str) -> Path | None:
        """The file's path on disk; None inside an archive."""
        return None

    def read(self, name: str, max_bytes: int) -> bytes:
        """The content of a file. InputError if it is unreadable, LimitError if it is larger than max_bytes."""
        return b"".join(self._chunks(name, max_bytes))

    def head(self, name: str, size: int) -> bytes:
        """The first `size` bytes of a file, or all of a smaller one. InputError if it is unreadable."""
        return next(self._chunks(name, size, size), b"")

    def copy_to(self, name: str, target: Path, max_bytes: int | None = None) -> None:
        """Write a file to target, for readers that need a path. target must not exist.

        Raises as `read`; max_bytes defaults to the limit for a whole archive.
        """
        descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with open(descriptor, "wb") as stream:
            for chunk in self._chunks(name, self.limits.decoded_bytes if max_bytes is None else max_bytes):
                stream.write(chunk)

    def _chunks(self, name: str, max_bytes: int, size: int = _CHUNK_BYTES) -> Iterator[bytes]:
        """The content in chunks. Bytes are counted during inflation, because an archive may declare a false size."""
        total = 0
        try:
            with self.open(name) as stream:
                while chunk := stream.read(size):
                    total += len(chunk)
                    if total > max_bytes:
                        problem = f"{name} is larger than {max_bytes} bytes."
                        raise LimitError(
                            self.field, problem, "Write the file again, without what does not belong in it."
                        )
                    yield chunk
        except UNREADABLE as error:
            raise InputError(
                self.field, f"{name} in {self.label} cannot be read ({error}).", "Write the file again."
            ) from error

    def images(self, folder: str | None = None) -> tuple[str, ...]:
        """The image files of the tree, or only those directly in `folder`."""
        return tuple(
            name
            for name in self.names
            if PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES
            and (folder is None or str(PurePosixPath(name).parent).lower() == folder)
        )

    def videos(self) -> tuple[str, ...]:
        return tuple(name for name in self.names if PurePosixPath(name).suffix.lower() in VIDEO_SUFFIXES)


@dataclass(frozen=True)
class _Folder(FileTree):
    paths: dict[str, Path]

    def path(self, name: str) -> Path | None:
        return self.paths[name]

    def open(self, name: str) -> IO[bytes]:
        return self.paths[name].open("rb")


@dataclass(frozen=True)
class _Zip(FileTree):
    archive: zipfile.ZipFile
    members: dict[str, zipfile.ZipInfo]

    def open(self, name: str) -> IO[bytes]:
        return self.archive.open(self.members[name])


def open_tree(path: Path, field: str, limits: ClipLimits) -> FileTree | None:
    """The files of a folder or of a zip (detected by content), or a single image; None for any other file."""
    if path.is_dir():
        return _open_folder(path, field, limits)
    if zipfile.is_zipfile(path):
        return _open_zip(path, field, limits)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return _Folder(field, path.name, (path.name,), limits, {path.name: path})
    return None


def check_exists(path: Path, field: str) -> None:
    """InputError unless path is a folder or a readable file with content."""
    if not path.exists():
        raise InputError(field, f"{path} does not exist.", "Check the path.")
    if path.is_dir():
        return
    if not path.is_file() or not os.access(path, os.R_OK):
        raise InputError(field, f"{path.name} is not a readable file or folder.", "Check its kind and permissions.")
    if path.stat().st_size == 0:
        raise InputError(field, f"{path.name} is empty (0 bytes).", "Copy or upload the file again.")


def scratch_folder() -> Path:
    """A new private folder for files that need a path. The caller removes it."""
    return Path(tempfile.mkdtemp(prefix="intrasplat-"))


def _open_folder(root: Path, field: str, limits: ClipLimits) -> FileTree:
    paths: dict[str, Path] = {}
    for folder, subfolders, files in os.walk(root, followlinks=True):
        relative = Path(folder).relative_to(root)
        if len(relative.parts) >= MAX_FOLDER_DEPTH:
            subfolders.clear()
        for file in files:
            paths[(relative / file).as_posix()] = Path(folder) / file
        check_member_count(len(paths), field, root.name)
    named = _without_wrapping(paths)
    return _Folder(field, root.name, tuple(sorted(named, key=natural_key)), limits, named)


def _open_zip(path: Path, field: str, limits: ClipLimits) -> FileTree:
    archive, entries = open_zip(path, field, path.name, limits)
    named = _without_wrapping({entry.filename: entry for entry in entries})
    return _Zip(field, path.name, tuple(sorted(named, key=natural_key)), limits, archive, named)


def _without_wrapping(items: dict[str, _Item]) -> dict[str, _Item]:
    """The items without file managers' own files and wrapping folders ("clip/images/..." -> "images/...")."""
    items = {name: item for name, item in items.items() if not _is_system_file(name)}
    while items:
        first = {name.split("/", 1)[0] for name in items}
        if len(first) > 1 or any("/" not in name for name in items) or first & _LAYOUT_FOLDERS:
            break
        items = {name.split("/", 1)[1]: item for name, item in items.items()}
    return items


def _is_system_file(name: str) -> bool:
    parts = name.split("/")
    return "__MACOSX" in parts or parts[-1] == "Thumbs.db" or any(part.startswith(".") for part in parts)
