"""Copies files of a data directory into a backup, with their hashes. A folder is copied in one consistent state."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from contract.backup.manifest import PIECE_BYTES, BackedUpFile
from contract.store.local import remove_tree
from intrasplat.errors import UnavailableError

MAX_TRIES = 10
"""A folder's files change only a few times: when its scores, its labels and its thumbnail are added."""
READ_REMEDY = "Run the backup as the user of the service, and look into the system's log if the disk fails."

State = dict[str, tuple[int, int, int]]
"""The state of a folder: inode, size and time of change (ns) of each file, by name."""


class Copier:
    """Fills the folder of a backup. Names are paths relative to both folders, with slashes.

    Methods raise UnavailableError where the data directory cannot be read, and OSError where the backup cannot be
    written.
    """

    def __init__(self, source: Path, target: Path) -> None:
        self._source = source
        self._target = target
        self._earlier: tuple[Path, Mapping[str, BackedUpFile]] = (target, {})
        self._states: dict[str, State] = {}
        self.files: dict[str, BackedUpFile] = {}
        """The copied files, by name."""
        self.linked = 0
        """How many files are hard links to those of an earlier backup."""

    def link_to(self, backup: Path, files: Mapping[str, BackedUpFile]) -> None:
        """From now on, link to the files of an earlier backup that have not changed."""
        self._earlier = (backup, files)

    def copy(self, name: str) -> None:
        """Copy one file, if it exists."""
        path = self._source / name
        try:
            with _reading(path):
                file = path.open("rb")
        except FileNotFoundError:
            return
        with file:
            status = os.fstat(file.fileno())
            if not self._link(name, status):
                self._put(name, _pieces(file.read, path), status.st_mtime_ns)

    def write(self, name: str, content: bytes) -> None:
        """Write a file into the backup that is not a copy of one in the data directory."""
        self._put(name, iter((content,)), 0)

    def copy_folder(self, name: str, marker: str) -> None:
        """Update the copy of a folder. A folder without its marker is being removed, so its copy is removed too."""
        for _ in range(MAX_TRIES):
            state = self._state(name)
            if f"{name}/{marker}" not in state:
                self.drop(lambda each: each.startswith(f"{name}/"))
                return
            known = self._states.get(name, {})
            if state == known:
                return
            stale = {each for each, seen in known.items() if state.get(each) != seen}
            self.drop(stale.__contains__)
            for each in state.keys() - self.files.keys():
                self.copy(each)
            self._states[name] = {each: seen for each, seen in state.items() if each in self.files}
        problem = f"{self._source / name} changes again and again."
        raise UnavailableError(problem, "Look which process writes there; only workers and services may.")

    def keep_folders(self, areas: Collection[str], names: Collection[str]) -> None:
        """Remove the copies of all folders in these areas but those named."""
        self.drop(lambda each: each.split("/")[0] in areas and "/".join(each.split("/")[:2]) not in names)

    def drop(self, is_unwanted: Callable[[str], bool]) -> None:
        """Remove the copies for which `is_unwanted` is true."""
        for name in [name for name in self.files if is_unwanted(name)]:
            remove_tree(self._target / name)
            del self.files[name]
            with contextlib.suppress(OSError):
                (self._target / name).parent.rmdir()  # the last file of a folder is gone

    def _state(self, name: str) -> State:
        """The present state of a folder, without temporary files that are about to be renamed."""
        found: State = {}
        with _reading(self._source / name):
            for path in _paths_below(self._source / name):
                with contextlib.suppress(FileNotFoundError):
                    status = path.stat()
                    if path.is_file():
                        each = path.relative_to(self._source).as_posix()
                        found[each] = (status.st_ino, status.st_size, status.st_mtime_ns)
        return found

    def _link(self, name: str, status: os.stat_result) -> bool:
        """Hard-link the earlier backup's file if its size and time are the same; False if that cannot be done."""
        backup, files = self._earlier
        file = files.get(name)
        if file is None or (file.bytes, file.changed_ns) != (status.st_size, status.st_mtime_ns):
            return False
        target = place_for(self._target, name)
        try:
            if (backup / name).stat().st_size != file.bytes:
                return False
            os.link(backup / name, target)
        except OSError:
            return False
        self.files[name] = file
        self.linked += 1
        return True

    def _put(self, name: str, pieces: Iterator[bytes], changed_ns: int) -> None:
        size, sha256 = write_hashed(place_for(self._target, name), pieces)
        self.files[name] = BackedUpFile(bytes=size, sha256=sha256, changed_ns=changed_ns)


def place_for(root: Path, name: str) -> Path:
    """The path root/name. Creates its folders, for their owner alone. Raises OSError."""
    *folders, file = name.split("/")
    for folder in folders:
        root /= folder
        root.mkdir(mode=0o700, exist_ok=True)
    return root / file


def write_hashed(target: Path, pieces: Iterator[bytes]) -> tuple[int, str]:
    """Write a file for its owner alone. Returns its size and SHA-256. Raises OSError."""
    digest, size = hashlib.sha256(), 0
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    with open(descriptor, "wb") as file:
        for piece in pieces:
            digest.update(piece)
            size += file.write(piece)
    return size, digest.hexdigest()


def _paths_below(folder: Path) -> list[Path]:
    """Everything below a folder but hidden names; nothing if the folder is removed meanwhile."""
    while True:
        try:
            return sorted(folder.rglob("[!.]*"))
        except FileNotFoundError:  # a folder below it, or it itself, was removed while it was read
            if not folder.exists():
                return []


def _pieces(read: Callable[[int], bytes], path: Path) -> Iterator[bytes]:
    while True:
        with _reading(path):
            piece = read(PIECE_BYTES)
        if not piece:
            return
        yield piece


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raise an OSError of the body as an UnavailableError that names the file; FileNotFoundError passes unchanged."""
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        problem = f"{path} cannot be read ({os.strerror(error.errno or 0)})."
        raise UnavailableError(problem, READ_REMEDY) from error
