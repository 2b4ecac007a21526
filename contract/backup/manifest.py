"""The format of a backup: one folder in the folder of all backups, named by the time at which it was begun.

    DEST/
    ├── .lock                       held while a backup is written
    ├── .unfinished-<time>/         a backup that was cut off, or is being written; the next one removes it
    └── 2026-11-24T132055.120Z/
        ├── spool/ scenes/ unscored/ purging/ keys.json keys.rotated.json audit.jsonl: as in a data directory
        ├── jobs.jsonl              a JobRecord a line: ended jobs, then live ones in the order in which they are to run
        └── backup.json             the manifest: size, SHA-256 and time of change of each other file

With a store in a bucket, spool/ and scenes/ are missing: clips and scenes are the bucket's own matter.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from contract.access.audit import AUDIT_FILE
from contract.access.keys import KEYS_FILE, ROTATED_FILE
from contract.store.shelf import Area
from contract.store.store import PURGING, UNSCORED
from contract.wire.errors import InputError
from contract.wire.job import JobRecord

MANIFEST_FILE = "backup.json"
JOBS_FILE = "jobs.jsonl"
UNFINISHED = ".unfinished-"
NAME = re.compile(r"\d{4}-\d\d-\d\dT\d{6}\.\d{3}Z", re.ASCII)
PIECE_BYTES = 1 << 20
FOLDERS = frozenset({str(Area.SPOOL), str(Area.SCENES), UNSCORED, PURGING})
FILES = frozenset({KEYS_FILE, ROTATED_FILE, AUDIT_FILE, "audit.head", JOBS_FILE})
"""What a backup may hold beside the folders. Builds before 0.3.0 wrote audit.head, which nothing reads now."""
FIELD = "SOURCE"
ANOTHER = "Restore another backup; this one is not whole."


class BackedUpFile(BaseModel):
    """A file of a backup. changed_ns: when its original was changed, UNIX time."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bytes: int = Field(ge=0)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    changed_ns: int


class Manifest(BaseModel):
    """backup.json. store_url: the bucket that keeps clips and scenes; None: they are in the backup.
    unreadable: jobs whose records could not be read and are missing."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["intrasplat-backup"] = "intrasplat-backup"
    version: Literal[1] = 1
    intrasplat: str
    created_at: str
    store_url: str | None = None
    unreadable: tuple[str, ...] = ()
    files: dict[str, BackedUpFile]

    @field_validator("files")
    @classmethod
    def _are_ours(cls, files: dict[str, BackedUpFile]) -> dict[str, BackedUpFile]:
        """Refuse a path that leads out of the data directory, or to what no backup holds."""
        for name in files:
            parts = PurePosixPath(name).parts
            is_ours = parts[0] in FOLDERS if len(parts) > 1 else name in FILES
            if not is_ours or ".." in parts or str(PurePosixPath(*parts)) != name:
                raise ValueError(f"{name[:80]!r} is no file of a backup")
        return files


def finished_backups(folder: Path) -> list[Path]:
    """The whole backups in the folder of all backups, the newest first."""
    names = [each.name for each in folder.iterdir() if NAME.fullmatch(each.name)] if folder.is_dir() else []
    return [folder / name for name in sorted(names, reverse=True) if (folder / name / MANIFEST_FILE).is_file()]


def read_manifest(backup: Path) -> Manifest:
    """The manifest of a backup.

    Raises:
        InputError: it cannot be read, is damaged, or a newer version wrote it.
    """
    try:
        return Manifest.model_validate_json((backup / MANIFEST_FILE).read_bytes())
    except (OSError, ValidationError) as error:
        problem = f"{backup / MANIFEST_FILE} cannot be read ({type(error).__name__})."
        remedy = "Restore another backup, or update intrasplat if a newer version wrote this one."
        raise InputError(FIELD, problem, remedy) from error


def read_jobs(backup: Path) -> Iterator[JobRecord]:
    """The records of a backup, in the order of the file.

    Raises:
        InputError: one cannot be read.
    """
    for number, line in enumerate((backup / JOBS_FILE).read_bytes().splitlines(), 1):
        try:
            yield JobRecord.model_validate_json(line)
        except ValidationError as error:
            problem = f"Line {number} of {JOBS_FILE} is no record of this version."
            remedy = "Update intrasplat to the version that wrote the backup, or restore another one."
            raise InputError(FIELD, problem, remedy) from error


def digest_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def job_of(name: str) -> str | None:
    """The id of the job to which a file of a backup belongs; None: to the installation."""
    parts = PurePosixPath(name).parts
    if len(parts) == 1:
        return None
    return parts[2 if parts[0] == UNSCORED and len(parts) > 2 else 1].partition(".")[0]
