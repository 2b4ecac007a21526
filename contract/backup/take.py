"""Take a backup of an installation while it runs.

The order makes the backup consistent. Clips and scenes are copied first, which may take long; then the queue's records
are read; then the files that changed meanwhile are copied, which are few. So the files of every record are present,
unless the job was purged meanwhile. A second read of the queue and of the notes of removals finds such jobs, which are
skipped. The audit log comes last, so it names every removal that had started.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from contract.access.audit import AUDIT_FILE, AuditAction, AuditEntry, AuditLog, utc_now
from contract.access.keys import KEYS_FILE, ROTATED_FILE
from contract.backup.copier import Copier
from contract.backup.manifest import (
    JOBS_FILE,
    MANIFEST_FILE,
    UNFINISHED,
    Manifest,
    finished_backups,
    job_of,
    read_manifest,
)
from contract.queue.interface import Queue
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.store.local import LocalShelf, remove_tree
from contract.store.shelf import Area, ShelfEntry, is_job_id
from contract.store.store import PURGING, UNSCORED
from contract.wire.job import TERMINAL_STATES, JobRecord, JobState
from intrasplat.errors import InputError, UnavailableError
from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import DISK_FULL_ERRNOS
from intrasplat.files.durable import move_folder
from intrasplat.version import version

FIELD = "DEST"
COPIED = (Area.SPOOL, Area.SCENES)


@dataclass(frozen=True)
class Taken:
    """A finished backup. purged: jobs skipped because they were removed meanwhile. without_files: jobs skipped because
    this machine has neither their clip nor their scene. unreadable: jobs whose records cannot be read and are missing;
    their files are in the backup."""

    path: Path
    jobs: Mapping[JobState, int]
    files: int
    bytes: int
    linked: int
    purged: tuple[str, ...]
    without_files: tuple[str, ...]
    unreadable: tuple[str, ...]


def take_backup(settings: Settings, queue: Queue, destination: Path, *, full: bool = False) -> Taken:
    """Write a backup into a new folder in `destination`. It is complete and on disk when this returns.

    Args:
        full: copy every file; else files that have not changed since the newest backup there become hard links to it.

    Raises:
        InputError: the destination lies in the data directory.
        UnavailableError: a file cannot be read, the destination cannot be written or is full, another backup is being
            written there, or the queue or the audit log does not answer. Nothing of the new backup is left.
    """
    data_dir = settings.data_dir.expanduser().resolve()
    destination = destination.expanduser().resolve()
    if destination.is_relative_to(data_dir):
        remedy = "Name a folder on another disk."
        raise InputError(FIELD, f"{destination} lies in the data directory and would be lost with it.", remedy)
    with _writing(destination):
        destination.mkdir(mode=0o700, parents=True, exist_ok=True)
        lock = FolderLock(destination / ".lock")
        if not lock.take():
            raise UnavailableError(f"Another backup is being written to {destination}.", "Wait until it has ended.")
    try:
        with _writing(destination):
            for left in destination.glob(f"{UNFINISHED}*"):
                remove_tree(left)
            return _take(settings.model_copy(update={"data_dir": data_dir}), queue, destination, full=full)
    finally:
        lock.release()


def _take(settings: Settings, queue: Queue, destination: Path, *, full: bool) -> Taken:
    AuditLog(settings.data_dir).append(AuditEntry(time=utc_now(), action=AuditAction.BACKED_UP))
    started = datetime.now(UTC)
    name = f"{started:%Y-%m-%dT%H%M%S}.{started.microsecond // 1000:03d}Z"
    folder = destination / f"{UNFINISHED}{name}"
    folder.mkdir(mode=0o700)
    try:
        copier = Copier(settings.data_dir, folder)
        before = [] if full else finished_backups(destination)[:1]
        with contextlib.suppress(InputError):  # no links to a damaged backup
            for backup in before:
                copier.link_to(backup, read_manifest(backup).files)
        jobs, purged, without_files, unreadable = _copy_all(settings, queue, copier)
        copier.write(JOBS_FILE, b"".join(record.model_dump_json().encode() + b"\n" for record in jobs))
        manifest = Manifest(
            intrasplat=version(),
            created_at=started.isoformat(timespec="milliseconds"),
            store_url=settings.store_url,
            unreadable=unreadable,
            files=copier.files,
        )
        (folder / MANIFEST_FILE).write_text(manifest.model_dump_json(indent=1))
        (folder / MANIFEST_FILE).chmod(0o600)
        move_folder(folder, destination / name)
    except BaseException:
        with contextlib.suppress(OSError):
            remove_tree(folder)
        raise
    counts = {state: sum(record.state is state for record in jobs) for state in JobState}
    sizes = sum(file.bytes for file in manifest.files.values())
    return Taken(
        destination / name, counts, len(manifest.files), sizes, copier.linked, purged, without_files, unreadable
    )


def _copy_all(
    settings: Settings, queue: Queue, copier: Copier
) -> tuple[list[JobRecord], tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Copy what a restore needs. Returns the records in their order, the jobs purged meanwhile, the jobs without files,
    and the jobs whose records cannot be read."""
    shelf = LocalShelf(settings.data_dir) if settings.store_url is None else None
    _copy_entries(shelf, copier)
    first = {record.job_id: record for record in queue.records(None, None)}
    _copy_entries(shelf, copier)
    noted = _noted(settings.data_dir)
    last = {record.job_id: record for record in queue.records(None, None)}
    unreadable = set(queue.unreadable())
    noted |= _noted(settings.data_dir)
    purged = noted | (first.keys() - last.keys() - unreadable)
    copier.drop(lambda name: job_of(name) in purged)
    chosen, without_files = [], []
    for job_id, record in last.items():
        known = [each for each in (record, first.get(job_id)) if each is not None]
        if job_id in purged:
            continue
        if there := [each for each in known if shelf is None or _has_files(copier, each)]:
            chosen.append(there[0])
        elif job_id in first:  # else it was accepted after the files were copied
            without_files.append(job_id)
    for worker in sorted((settings.data_dir / UNSCORED).glob("*")):
        for path in sorted(worker.glob("*")):
            if path.name.partition(".")[0] not in purged:
                copier.copy(f"{UNSCORED}/{worker.name}/{path.name}")
    for job_id in sorted(noted):
        copier.write(f"{PURGING}/{job_id}", b"")
    for name in (KEYS_FILE, ROTATED_FILE, AUDIT_FILE):
        copier.copy(name)
    skipped = [tuple(sorted(job_ids)) for job_ids in (purged, without_files, unreadable - purged)]
    return _in_order(queue, chosen), skipped[0], skipped[1], skipped[2]


def _copy_entries(shelf: LocalShelf | None, copier: Copier) -> None:
    """Update the backup's clips and scenes to the present ones."""
    if shelf is None:
        return
    entries = [entry for area in COPIED for entry in shelf.entries(area)]
    copier.keep_folders(COPIED, {f"{entry.area}/{entry.name}" for entry in entries})
    for entry in entries:
        copier.copy_folder(f"{entry.area}/{entry.name}", entry.marker)


def _has_files(copier: Copier, record: JobRecord) -> bool:
    """Whether the backup has the files of a job."""
    clip, scene = ShelfEntry(Area.SPOOL, record.job_id), ShelfEntry(Area.SCENES, record.job_id, record.attempt)
    needed = {JobState.DONE: scene, JobState.CANCELLED: None}.get(record.state, clip)
    return needed is None or f"{needed.area}/{needed.name}/{needed.marker}" in copier.files


def _noted(data_dir: Path) -> set[str]:
    """The jobs whose removal has started and not ended."""
    return {path.name for path in (data_dir / PURGING).glob("*") if is_job_id(path.name)}


def _in_order(queue: Queue, records: list[JobRecord]) -> list[JobRecord]:
    """Ended jobs by their time, then those that run, then those that wait, in the order in which they would run."""

    def place(record: JobRecord) -> tuple[int, float]:
        if record.state in TERMINAL_STATES:
            return 0, record.created_at_s
        if record.state is JobState.RUNNING:
            return 1, record.started_at_s or 0.0
        position = queue.forecast(record.job_id).position
        return 2, -1.0 if position is None else position  # claimed meanwhile

    return sorted(records, key=place)


@contextlib.contextmanager
def _writing(destination: Path) -> Iterator[None]:
    """Raise an OSError of the body as an UnavailableError that names the destination."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL_ERRNOS:
            problem = f"There is no room left on {Disk(destination).name}."
            remedy = "Free space there, or name a folder on a larger disk; nothing of this backup was kept."
        else:
            problem = f"{error.filename or destination} cannot be written ({os.strerror(error.errno or 0)})."
            remedy = "Name a folder that this user may write to."
        raise UnavailableError(problem, remedy) from error
