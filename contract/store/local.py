"""A shelf on the disk of this machine: an entry is the folder data_dir/<area>/<name>."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from contract.store.shelf import MARKERS, Area, Removed, ShelfEntry, checked, entry_of
from intrasplat.files.disk_errors import disk_errors
from intrasplat.files.durable import flush, move_folder, replace_file


class LocalShelf:
    """A Shelf in one data directory. Creates the folders that are missing."""

    @disk_errors()
    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir
        self.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        for area in Area:
            (self.data_dir / area).mkdir(mode=0o700, exist_ok=True)

    def path(self, entry: ShelfEntry) -> Path:
        """Where the entry's folder lies, or would lie."""
        return self.data_dir / entry.area / entry.name

    @disk_errors()
    def put(self, folder: Path, entry: ShelfEntry) -> None:
        target = self.path(entry)
        if folder != target:
            _remove_folder(target, entry.marker)
            move_folder(folder, target)

    def put_files(self, entry: ShelfEntry, names: Sequence[str]) -> None:
        """Nothing: what lies here is the entry itself."""

    @disk_errors()
    def put_text(self, entry: ShelfEntry, name: str, content: bytes) -> None:
        if self.holds(entry):
            with contextlib.suppress(FileNotFoundError):  # it has just been removed
                replace_file(self.path(entry) / name, content)

    def get(self, entry: ShelfEntry) -> Path | None:
        return self.path(entry) if self.holds(entry) else None

    @disk_errors()
    def holds(self, entry: ShelfEntry) -> bool:
        return (self.path(entry) / entry.marker).is_file()

    def read_marker(self, entry: ShelfEntry) -> bytes | None:
        return self.read(entry, entry.marker)

    @disk_errors()
    def read(self, entry: ShelfEntry, name: str) -> bytes | None:
        with contextlib.suppress(FileNotFoundError):
            return (self.path(entry) / name).read_bytes()
        return None

    def entries(self, area: Area, job_id: str | None = None) -> list[ShelfEntry]:
        return [entry for entry in self.folders(area, job_id) if self.holds(entry)]

    @disk_errors()
    def folders(self, area: Area, job_id: str | None = None) -> list[ShelfEntry]:
        """As entries(), including folders that lack their marker."""
        # No glob: Python caches each pattern, and every job would add one.
        start = checked(job_id) if job_id is not None else ""
        names = [each.name for each in os.scandir(self.data_dir / area) if each.name.startswith(start)]
        found = [entry for entry in (entry_of(area, name) for name in names) if entry is not None]
        return sorted(found, key=lambda entry: (entry.job_id, entry.attempt or 0))

    @disk_errors()
    def remove(self, area: Area, job_id: str, attempt: int | None = None) -> Removed:
        found = [self.path(entry) for entry in self.folders(area, job_id) if attempt in (None, entry.attempt)]
        files = sizes = 0
        for folder in found:
            with contextlib.suppress(
                FileNotFoundError
            ):  # its worker has just renamed it, or another process removes it
                for path in (path for path in folder.rglob("*") if path.is_file()):
                    sizes += path.stat().st_size
                    files += 1
        for folder in found:
            _remove_folder(folder, MARKERS[area])
        if found:
            flush(self.data_dir / area)
        return Removed({str(area): files}, {str(area): sizes})

    def drop_copy(self, entry: ShelfEntry) -> None:
        """Nothing: what lies here is the entry itself."""

    @disk_errors()
    def tidy(self) -> None:
        for area in (Area.SPOOL, Area.SCENES):
            for folder in (self.data_dir / area).iterdir():
                if not (folder / MARKERS[area]).is_file():  # of a removal that was cut off
                    remove_tree(folder)


def remove_tree(path: Path) -> None:
    """Remove a file or a folder with its content, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, onerror=_unless_gone)
    else:
        path.unlink(missing_ok=True)


def _remove_folder(folder: Path, marker: str) -> None:
    """Remove a folder, its marker first, so that the rest does not count as an entry."""
    (folder / marker).unlink(missing_ok=True)
    remove_tree(folder)


def _unless_gone(_: object, __: object, failure: tuple[type[BaseException], BaseException, object]) -> None:
    """Error handler of rmtree: ignore what another process has removed meanwhile."""
    if not isinstance(failure[1], FileNotFoundError):
        raise failure[1]
