"""`Shelf`: where a store keeps clips and scenes, on the disk (local.py) or in a bucket (s3.py)."""

from __future__ import annotations

import re
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from intrasplat.names import JOB_ID_PATTERN, MANIFEST, RESUME, SUBMISSION

ABANDONED_AFTER_S = 24 * 3600.0
"""A file that has not changed for this long is assumed to belong to a process that has ended."""


class Area(StrEnum):
    """The kind of an entry; each kind has a folder of this name."""

    INCOMING = "incoming"
    SPOOL = "spool"
    WORK = "work"
    KEPT = "kept"
    SCENES = "scenes"


MARKERS = {
    Area.INCOMING: SUBMISSION,
    Area.SPOOL: SUBMISSION,
    Area.WORK: MANIFEST,
    Area.KEPT: RESUME,
    Area.SCENES: MANIFEST,
}
"""The file without which an entry does not count: it is removed first and, in a bucket, written last."""


def new_job_id() -> str:
    """A random id, safe as a file name and unguessable."""
    return uuid.uuid4().hex


def is_job_id(text: str) -> bool:
    """Whether `text` is a job id and so safe as part of a path in the store."""
    return re.fullmatch(JOB_ID_PATTERN, text) is not None


def checked(job_id: str) -> str:
    """Return the id if it is safe as part of a path.

    Raises:
        ValueError: it is not a job id.
    """
    if not is_job_id(job_id):
        raise ValueError(f"not a job id: {job_id!r}")
    return job_id


@dataclass(frozen=True)
class ShelfEntry:
    """The name of a folder in the store. attempt: None in INCOMING and SPOOL. Raises ValueError for a bad job_id."""

    area: Area
    job_id: str
    attempt: int | None = None

    def __post_init__(self) -> None:
        checked(self.job_id)

    @property
    def name(self) -> str:
        """The name of the folder in its area."""
        return self.job_id if self.attempt is None else f"{self.job_id}.{self.attempt:d}"

    @property
    def marker(self) -> str:
        """The file without which the entry does not count."""
        return MARKERS[self.area]


def entry_of(area: Area, name: str) -> ShelfEntry | None:
    """The entry whose folder has that name; None if the name is not one of ours."""
    job_id, dot, attempt = name.partition(".")
    numbered = area not in (Area.INCOMING, Area.SPOOL)
    if not is_job_id(job_id) or bool(dot) is not numbered or (numbered and not re.fullmatch(r"[0-9]{1,9}", attempt)):
        return None
    return ShelfEntry(area, job_id, int(attempt) if numbered else None)


@dataclass(frozen=True)
class Removed:
    """How many files and bytes a removal deleted, by their location."""

    files: dict[str, int]
    bytes: dict[str, int]

    def __add__(self, other: Removed) -> Removed:
        return Removed(_sum(self.files, other.files), _sum(self.bytes, other.bytes))


def _sum(first: dict[str, int], second: dict[str, int]) -> dict[str, int]:
    return {name: first.get(name, 0) + second.get(name, 0) for name in first | second}


class Shelf(Protocol):
    """Stores entries for every process of an installation. An entry exists with all of its files or not at all.

    All methods raise UnavailableError when the disk or the bucket fails.
    """

    def put(self, folder: Path, entry: ShelfEntry) -> None:
        """Store a folder of this machine as the entry, replacing an earlier one; the folder moves to path(entry).

        After an error the entry does not exist, and the folder is where it was.
        """
        ...

    def put_files(self, entry: ShelfEntry, names: Sequence[str]) -> None:
        """Replace these files of the entry by those in its folder on this machine, one after the other.

        names: some of the entry's files. An entry that has been removed, or is being removed, does not come back.
        """
        ...

    def put_text(self, entry: ShelfEntry, name: str, content: bytes) -> None:
        """Store one small file of the entry, replacing an earlier one; not its marker.

        Nothing happens if the entry has been removed, or is being removed.
        """
        ...

    def get(self, entry: ShelfEntry) -> Path | None:
        """The entry's folder on this machine, downloaded if necessary; None if there is no such entry.

        Raises:
            SceneError: the downloaded files differ from their hashes.
        """
        ...

    def holds(self, entry: ShelfEntry) -> bool:
        """Whether the entry exists."""
        ...

    def read_marker(self, entry: ShelfEntry) -> bytes | None:
        """The content of the entry's marker; None if there is no such entry."""
        ...

    def read(self, entry: ShelfEntry, name: str) -> bytes | None:
        """The content of one of the entry's files; None if there is no such file."""
        ...

    def entries(self, area: Area, job_id: str | None = None) -> list[ShelfEntry]:
        """The entries of an area, of one job or of all, ordered by name and attempt."""
        ...

    def remove(self, area: Area, job_id: str, attempt: int | None = None) -> Removed:
        """Remove a job's entries in an area, incomplete ones too; only that of `attempt` if it is given."""
        ...

    def drop_copy(self, entry: ShelfEntry) -> None:
        """Declare that this machine no longer needs its copy; the entry itself stays."""
        ...

    def tidy(self) -> None:
        """Remove what interrupted processes have left, and unused copies."""
        ...
