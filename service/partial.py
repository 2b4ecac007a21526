"""Resumable uploads on disk. The size of the file is the upload's offset, so a restart loses nothing.

    incoming/<upload>/upload.json   the declaration, and the job that took the file
    incoming/<upload>/<part>.mp4    the bytes received so far; gone once a job has the file

One request at a time writes to the file, across all processes.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
from dataclasses import dataclass
from io import RawIOBase
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from contract.store.shelf import is_job_id, new_job_id
from contract.store.store import Store
from intrasplat.files.durable import flush, replace_file
from intrasplat.names import JOB_ID_PATTERN

DECLARATION = "upload.json"
HASHED_AT_ONCE_BYTES = 2**20


class Declaration(BaseModel):
    """What was said of an upload when it was created, and later the job that took it."""

    model_config = ConfigDict(frozen=True)

    tenant: str
    part: str
    suffix: str
    length_bytes: int = Field(gt=0)
    created_at_s: float
    job_id: str | None = Field(default=None, pattern=JOB_ID_PATTERN)


@dataclass(frozen=True)
class Partial:
    """One upload in its folder."""

    upload_id: str
    folder: Path
    declaration: Declaration

    @property
    def path(self) -> Path:
        """The file to which pieces are appended."""
        return self.folder / (self.declaration.part + self.declaration.suffix)

    @property
    def offset_bytes(self) -> int:
        """Bytes received; all of them once a job has taken the file."""
        try:
            return self.path.stat().st_size
        except FileNotFoundError:
            return self.declaration.length_bytes

    @property
    def is_complete(self) -> bool:
        """Whether all bytes were received."""
        return self.offset_bytes == self.declaration.length_bytes

    def open(self) -> RawIOBase:
        """The file, locked and open for appending; pass it to close().

        Raises:
            BlockingIOError: another request, of this or another process, is writing to it.
            FileNotFoundError: a job has taken it, or it was removed.
        """
        file = self.path.open("r+b", buffering=0)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise
        file.seek(0, os.SEEK_END)
        return file

    def sha256(self) -> str:
        """The SHA-256 of the file."""
        return sha256_of(self.path)

    def assign_to(self, job_id: str) -> None:
        """Record which job has the file, and remove the file here."""
        taken = self.declaration.model_copy(update={"job_id": job_id})
        replace_file(self.folder / DECLARATION, taken.model_dump_json().encode())
        self.path.unlink(missing_ok=True)


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(HASHED_AT_ONCE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def append(file: RawIOBase, piece: bytes) -> None:
    """Write the whole piece."""
    rest = memoryview(piece)
    while rest:
        rest = rest[file.write(rest) or 0 :]


def close(file: RawIOBase) -> None:
    """Sync an upload's file to disk and close it."""
    with file:
        os.fsync(file.fileno())


def create_partial(store: Store, declaration: Declaration) -> Partial:
    """Create an empty upload, which is on disk when this returns."""
    upload_id = new_job_id()
    partial = Partial(upload_id, store.open_incoming(upload_id), declaration)
    partial.path.touch(mode=0o600)
    replace_file(partial.folder / DECLARATION, declaration.model_dump_json().encode())
    flush(partial.folder.parent)
    return partial


def find_partial(store: Store, upload_id: str, tenant: str) -> Partial | None:
    """The tenant's upload of that id; None if there is none."""
    partial = _read(store.incoming_folder(upload_id)) if is_job_id(upload_id) else None
    return partial if partial is not None and partial.declaration.tenant == tenant else None


def open_partials(store: Store) -> list[Partial]:
    """All uploads that no job has taken."""
    return [partial for partial in _all(store) if partial.declaration.job_id is None]


def partials_of(store: Store, job_id: str) -> list[Partial]:
    """The uploads that a job has taken, even if the service died before it could note that in upload.json."""
    taken: set[tuple[int, int] | None] = set()
    with contextlib.suppress(FileNotFoundError):
        taken = {_identity(path) for path in store.spool_folder(job_id).iterdir()} - {None}
    return [each for each in _all(store) if each.declaration.job_id == job_id or _identity(each.path) in taken]


def promised_bytes(store: Store, tenant: str | None = None) -> int:
    """Bytes that uploads, of one tenant or of all, have declared and not sent yet; disk space is reserved for them."""
    partials = [each for each in open_partials(store) if tenant in (None, each.declaration.tenant)]
    return sum(partial.declaration.length_bytes - partial.offset_bytes for partial in partials)


def _all(store: Store) -> list[Partial]:
    read = [_read(folder) for folder in (store.data_dir / "incoming").iterdir()]
    return [partial for partial in read if partial is not None]


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode: the same for all hard links of a file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def _read(folder: Path) -> Partial | None:
    try:
        text = (folder / DECLARATION).read_bytes()
        return Partial(folder.name, folder, Declaration.model_validate_json(text))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
