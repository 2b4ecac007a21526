"""Fill an empty data directory and an empty queue from a backup.

Files come first, each compared with its hash, then the records. While a file `restoring` lies in the data directory,
neither service nor worker starts on it. That file says which records are being entered into which queue. So a restore
that failed or was cut off can be run again: it copies the files anew and keeps the records that the queue already has.
Jobs that were purged after the backup, according to the given audit logs, do not come back; nor do revoked keys.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import time
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from contract.access.audit import AUDIT_FILE, AuditAction, AuditEntry, AuditLog, utc_now
from contract.access.keys import KeyFile
from contract.backup.copier import place_for, write_hashed
from contract.backup.manifest import (
    ANOTHER,
    FIELD,
    JOBS_FILE,
    MANIFEST_FILE,
    PIECE_BYTES,
    Manifest,
    digest_of,
    finished_backups,
    job_of,
    read_jobs,
    read_manifest,
)
from contract.queue.interface import IDEMPOTENCY_S, Queue
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.store.local import remove_tree
from contract.store.store import RESTORING, Store
from contract.wire.job import TERMINAL_STATES, JobRecord, JobState
from intrasplat.errors import InputError, UnavailableError
from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import DISK_FULL_ERRNOS
from intrasplat.files.durable import flush

NO_CONTENT = frozenset({"lost+found"})
"""Names that may lie in an empty folder: the root of a disk has lost+found."""
EMBEDDED_QUEUE = frozenset({"valkey"})
"""The embedded queue's folder may exist: its server may still run after a restore was killed."""


@dataclass
class Restored:
    """What was restored. purged: jobs skipped because they were purged. lost: jobs with neither clip nor scene."""

    backup: Path
    created_at: str
    jobs: Counter[JobState] = field(default_factory=Counter)
    purged: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    revoked_keys: list[str] = field(default_factory=list)
    unreadable: tuple[str, ...] = ()
    """Jobs whose records the backup lacks."""


class _Entering(BaseModel):
    """The file `restoring`, once records are entered. backup: its time. queue: SHA-256 of REDIS_URL; None: the embedded
    one."""

    model_config = ConfigDict(frozen=True)

    backup: str
    queue: str | None


@dataclass(frozen=True)
class _Since:
    """What the audit logs report: purged jobs and revoked keys."""

    purged: frozenset[str]
    revoked_keys: frozenset[str]


def restore_backup(
    settings: Settings, open_queue: AbstractContextManager[Queue], source: Path, audits: Sequence[Path] = ()
) -> Restored:
    """Restore a backup: `source` itself, or the newest one in it. When this returns, all is on disk and in the queue.

    Args:
        open_queue: entered once the data directory is known to be empty.
        audits: audit logs that cover the time after the backup.

    Raises:
        InputError: there is no whole backup, it does not fit the settings, or an audit cannot be read.
        UnavailableError: the data directory or the queue is not empty, cannot be written, or is full; or another
            restore fills them.

    After an error the data directory is empty again if it was empty before. If a queue elsewhere may have some of the
    records, the file `restoring` stays instead, and the same restore continues when it is run again.
    """
    backup = _backup_in(source.expanduser().resolve())
    manifest = read_manifest(backup)
    _check_store(manifest, settings)
    since = _since([backup / AUDIT_FILE] * (AUDIT_FILE in manifest.files) + list(audits))
    data_dir = settings.data_dir.expanduser().resolve()
    with _writing(data_dir):
        data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        _check_empty(data_dir)
        if data_dir.stat().st_uid == os.geteuid():  # only the owner may set modes; a volume may belong to its group
            data_dir.chmod(0o700)
        marker, lock = data_dir / RESTORING, FolderLock(data_dir / RESTORING)
        if not lock.take():
            raise UnavailableError(f"Another restore fills {data_dir}.", "Wait until it has ended.")
        queue_url = settings.redis_url
        entering = _Entering(
            backup=manifest.created_at, queue=queue_url and hashlib.sha256(queue_url.encode()).hexdigest()
        )
        try:
            _empty(data_dir, {RESTORING} if queue_url else {RESTORING, *EMBEDDED_QUEUE})
            with open_queue as queue:
                interrupted = _interrupted(marker)
                _check_queue(queue, interrupted, entering, backup)
                _copy_files(backup, manifest, data_dir, since.purged)
                restored = Restored(backup, manifest.created_at, unreadable=manifest.unreadable)
                restored.revoked_keys = _revoke(data_dir, since.revoked_keys)
                records = list(read_jobs(backup))
                if interrupted != entering:  # when equal, the queue has records, and the marker must never be empty
                    marker.write_text(entering.model_dump_json())
                    flush(marker)
                _fill_queue(queue, Store(data_dir, settings.store_url), records, since.purged, restored)
            outcome = f"backup of {manifest.created_at}"
            AuditLog(data_dir).append(AuditEntry(time=utc_now(), action=AuditAction.RESTORED, outcome=outcome))
            marker.unlink()
            flush(data_dir)
        except BaseException:
            with suppress(OSError):
                _empty(data_dir, {RESTORING} if queue_url and marker.stat().st_size else set())
            raise
        finally:
            lock.release()
    return restored


def _interrupted(marker: Path) -> _Entering | None:
    """What an earlier restore was entering into the queue when it failed or was cut off; None: nothing yet."""
    try:
        return _Entering.model_validate_json(marker.read_bytes())
    except ValidationError:
        return None


def _check_queue(queue: Queue, interrupted: _Entering | None, entering: _Entering, backup: Path) -> None:
    """Refuse a queue with records other than those that the same restore has already entered."""
    goes_on = interrupted == entering
    found = queue.records(None, None) if goes_on else queue.records(limit=1)
    own = {record.job_id for record in read_jobs(backup)} if goes_on else set()
    if all(record.job_id in own for record in found):
        return
    problem, remedy = "The queue is not empty: it holds jobs of another installation, or of a restore cut off.", ""
    if interrupted is not None and not goes_on and interrupted.queue == entering.queue:
        remedy = f"Restore the backup of {interrupted.backup} again, which was being entered, or empty the queue. Or: "
    raise UnavailableError(
        problem, f"{remedy}Give the restored service a queue of its own (REDIS_URL), or empty this one."
    )


def _backup_in(source: Path) -> Path:
    """The backup to restore: `source` itself, or the newest one in it."""
    if (source / MANIFEST_FILE).is_file():
        return source
    if found := finished_backups(source):
        return found[0]
    remedy = "Name the folder that was given to `intrasplat backup`, or one backup in it."
    raise InputError(FIELD, f"{source} holds no finished backup.", remedy)


def _check_store(manifest: Manifest, settings: Settings) -> None:
    if manifest.store_url is not None and settings.store_url is None:
        problem = f"The clips and scenes of this backup are in the bucket {manifest.store_url}."
        raise InputError("INTRASPLAT_STORE_URL", problem, "Set it to that bucket, or to a copy of it.")
    if manifest.store_url is None and settings.store_url is not None:
        problem = "The clips and scenes of this backup come from a data directory, not from a bucket."
        raise InputError("INTRASPLAT_STORE_URL", problem, "Unset it.")


def _since(audits: Sequence[Path]) -> _Since:
    """The jobs whose purge has started or ended, and the revoked keys, according to these audit logs."""
    ids_by_action: dict[str, set[str]] = {AuditAction.PURGED: set(), AuditAction.KEY_REVOKED: set()}
    for path in audits:
        for entry in _acts(path):
            about = entry.get("job_id") or entry.get("key_id")
            if (action := entry["action"]) in ids_by_action and about is not None:
                ids_by_action[action].add(about)
    return _Since(frozenset(ids_by_action[AuditAction.PURGED]), frozenset(ids_by_action[AuditAction.KEY_REVOKED]))


def _acts(audit: Path) -> Iterator[dict[str, str]]:
    """The entries of an audit log, without lines that a crash has cut off.

    Raises:
        InputError: it cannot be read, or it has lines and none is an audit entry.
    """
    line, acts = None, 0
    for line in _lines(audit):
        with suppress(ValueError):
            entry = json.loads(line)
            if isinstance(entry, dict) and "action" in entry:
                acts += 1
                yield entry
    if line is not None and not acts:
        raise InputError("--audit", f"{audit} holds no line of an audit.", "Name audit.jsonl, or one that was rotated.")


def _lines(audit: Path) -> Iterator[bytes]:
    """The lines of an audit log, which may be compressed (.gz). Raises InputError if it cannot be read."""
    try:
        with gzip.open(audit) if audit.suffix == ".gz" else audit.open("rb") as file:
            yield from file
    except (OSError, EOFError, zlib.error) as error:
        problem = f"{audit} cannot be read ({type(error).__name__})."
        raise InputError("--audit", problem, "Name files of an audit, as the user that runs the service.") from error


def _check_empty(data_dir: Path) -> None:
    """Refuse a folder that is not empty, unless only an unfinished restore's files lie in it."""
    found = sorted(each.name for each in data_dir.iterdir() if each.name not in NO_CONTENT)
    if found and RESTORING not in found:
        problem = f"{data_dir} is not empty: it holds {', '.join(found[:5])}."
        raise UnavailableError(problem, "Restore into an empty data directory; move away or remove what is there.")


def _copy_files(backup: Path, manifest: Manifest, data_dir: Path, purged: frozenset[str]) -> None:
    """Copy all files but those of purged jobs. The hashes of all files are compared."""
    folders: set[Path] = set()
    for name, file in manifest.files.items():
        target = None
        try:
            if name == JOBS_FILE or job_of(name) in purged:
                found = (backup / name).stat().st_size, digest_of(backup / name)
            else:
                with (backup / name).open("rb") as original:
                    target = place_for(data_dir, name)
                    found = write_hashed(target, iter(lambda: original.read(PIECE_BYTES), b""))
                os.utime(target, ns=(time.time_ns(), file.changed_ns))
        except FileNotFoundError as error:
            raise InputError(FIELD, f"{name} is missing in {backup}.", ANOTHER) from error
        if found != (file.bytes, file.sha256):
            raise InputError(FIELD, f"{name} in {backup} is not what was backed up: its hash differs.", ANOTHER)
        if target is not None:
            flush(target)
            folders |= {each for each in target.parents if each.is_relative_to(data_dir)}
    for folder in folders:
        flush(folder)


def _revoke(data_dir: Path, key_ids: frozenset[str]) -> list[str]:
    keys = KeyFile(data_dir)
    return [key.key_id for key in keys.list() if key.key_id in key_ids and keys.revoke(key.key_id)]


def _fill_queue(
    queue: Queue, store: Store, records: Sequence[JobRecord], purged: frozenset[str], restored: Restored
) -> None:
    """Enter the jobs into the queue, in their order. Purge from a bucket what was purged after the backup."""
    scenes: Mapping[str, list[int]] = store.finished_scenes()
    clips = set(store.spooled_ids())
    for job_id in sorted(purged & (scenes.keys() | clips)):
        store.purge(job_id)
    for record in records:
        if record.job_id in purged:
            restored.purged.append(record.job_id)
            queue.cancel(record.job_id)  # a restore that was cut off may have entered it
            queue.forget(record.job_id)
        elif (found := _as_found(record, scenes.get(record.job_id, []), record.job_id in clips)) is None:
            restored.lost.append(record.job_id)
        else:
            restored.jobs[_put(queue, found)] += 1


def _as_found(record: JobRecord, attempts: Sequence[int], has_clip: bool) -> JobRecord | None:
    """The record to enter: done if its scene exists, else queued; None without clip and scene."""
    if record.state in TERMINAL_STATES and record.state is not JobState.DONE:
        return record
    if record.state is JobState.DONE and record.attempt in attempts:
        return record
    if attempts:
        ended = {"state": JobState.DONE, "attempt": max(attempts), "finished_at_s": record.finished_at_s or time.time()}
        return record.model_copy(update=ended)
    if not has_clip:
        return None
    waits = {"state": JobState.QUEUED, "released": record.attempt, "owner": None, "progress": None}
    waits |= {"started_at_s": None, "finished_at_s": None}
    if record.created_at_s + IDEMPOTENCY_S < time.time():
        waits["idempotency_key"] = None  # it has expired, and another job may have used it since
    return record.model_copy(update=waits)


def _put(queue: Queue, record: JobRecord) -> JobState:
    """Enter a job into the queue. Returns its state there."""
    if record.state in TERMINAL_STATES:
        queue.restore(record)
        return record.state
    asked = record.cancel_requested
    queue.submit(record.model_copy(update={"cancel_requested": False}))
    cancelled = queue.cancel(record.job_id) if asked else None
    return cancelled.state if cancelled else record.state


def _empty(data_dir: Path, kept: Collection[str]) -> None:
    for path in data_dir.iterdir():
        if path.name not in NO_CONTENT and path.name not in kept:
            remove_tree(path)


@contextmanager
def _writing(data_dir: Path) -> Iterator[None]:
    """Raise an OSError of the body as an UnavailableError that names the file, or the disk that is full."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL_ERRNOS:
            problem = f"There is no room left on {Disk(data_dir).name}; nothing was restored."
            raise UnavailableError(problem, "Use a larger disk.") from error
        problem = f"{error.filename or data_dir} cannot be read or written ({os.strerror(error.errno or 0)})."
        raise UnavailableError(problem, "Run the command as the user of the service.") from error
