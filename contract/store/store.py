"""Clips and scenes on disk, and the rules by which a folder appears: written aside, made durable, then renamed.

    data_dir/
    ├── incoming/<id>/      an upload, whole or resumable, before it is a job; removed when it is refused or given up
    ├── spool/<job>/        an accepted clip: clip.mp4, calibration.json, ..., submission.json (the JobRecord of then)
    ├── work/<job>.<n>/     what attempt n has written so far
    ├── work/tmp-<name>/    what worker <name> has unpacked; emptied whenever it starts
    ├── scenes/<job>.<n>/   what attempt n has finished: manifest.json, scene.safetensors, report.json, curve.csv
    ├── run/                sockets of live workers
    └── valkey/             the embedded queue's log

A folder in spool/ or scenes/ is complete by its mere presence. Which attempt's scene is THE scene of a job, its record
in the queue says; an attempt writes to and removes folders of its own number only, so that one that was thought dead
can spoil nothing. The data directory is readable by its owner only.

Every method raises UnavailableError when the disk is full (StoreFullError), read-only, missing or failing.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from contract.runtime.settings import Settings
from contract.store.durable import flush, move_folder
from contract.wire.errors import SceneError, UnavailableError
from contract.wire.job import JOB_ID_PATTERN, JobRecord
from contract.wire.names import MANIFEST, SUBMISSION

AREAS = ("incoming", "spool", "work", "scenes", "run")

ABANDONED_AFTER_S = 24 * 3600.0
"""What has not changed for this long was given up, or cut off by the end of its process."""

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
NOT_WRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
NOT_THERE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.ESTALE})


class StoreFullError(UnavailableError):
    """The data directory's disk, quota or largest file is used up; nothing that was stored before is harmed."""


@dataclass(frozen=True)
class Removed:
    """What a purge took away, by area of the store; nothing of the job was left when it ended."""

    files: dict[str, int]
    bytes: dict[str, int]


def open_store(settings: Settings) -> Store:
    """The store that the settings name: a bucket's if there is a store_url, else the data directory's.

    Raises:
        UnavailableError: the data directory cannot be made, or the package for buckets is not installed.
    """
    if settings.store_url is None:
        return Store(settings.data_dir)
    from contract.store.bucket import BucketStore  # it imports this module

    return BucketStore(settings.data_dir, settings.store_url)


def new_job_id() -> str:
    """A random id, safe as a file name and unguessable."""
    return uuid.uuid4().hex


def is_job_id(text: str) -> bool:
    """Whether `text` may be used as a part of a path here."""
    return re.fullmatch(JOB_ID_PATTERN, text) is not None


@contextlib.contextmanager
def disk_errors() -> Iterator[None]:
    """What the operating system refuses, as an UnavailableError that says what to do and names no file."""
    try:
        yield
    except OSError as error:
        raise _disk_error(error) from error


def _disk_error(error: OSError) -> UnavailableError:
    reason = os.strerror(error.errno) if error.errno else type(error).__name__
    if error.errno in NO_ROOM:
        problem = f"There is no room left in the data directory ({reason})."
        return StoreFullError(problem, "Purge scenes that are no longer needed, or give it a larger disk or quota.")
    if error.errno in NOT_WRITABLE:
        problem = f"The data directory cannot be written to ({reason})."
        return UnavailableError(problem, "Mount it for writing, and give it to the user that runs intrasplat.")
    if error.errno in NOT_THERE:
        problem = f"A folder of the data directory is gone ({reason})."
        return UnavailableError(problem, "See that its disk is mounted, and start intrasplat again.")
    return UnavailableError(f"The data directory's disk fails ({reason}).", "Look into the system's log.")


class Store:
    """The folders above, under one data directory that this makes if need be."""

    @disk_errors()
    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir.expanduser().resolve()
        self.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in AREAS:
            (self.data_dir / name).mkdir(mode=0o700, exist_ok=True)
        self._number_old_scenes()

    @property
    def run_dir(self) -> Path:
        """Where live workers put their sockets."""
        return self.data_dir / "run"

    @disk_errors()
    def free_bytes(self) -> int:
        """What is left on the data directory's disk."""
        return shutil.disk_usage(self.data_dir).free

    # what comes in

    @disk_errors()
    def open_incoming(self, job_id: str) -> Path:
        """A new empty folder to receive an upload."""
        folder = self.incoming_folder(job_id)
        folder.mkdir(mode=0o700)
        return folder

    def incoming_folder(self, job_id: str) -> Path:
        """Where an upload lies, or lay."""
        return self._folder("incoming", job_id)

    @disk_errors()
    def discard_incoming(self, job_id: str) -> None:
        """Remove an upload that will not become a job."""
        remove_tree(self.incoming_folder(job_id))

    @disk_errors()
    def accept(self, record: JobRecord) -> None:
        """Make what came in a spooled clip: submission written, all of it on disk, then renamed into place.

        After an error nothing is accepted, and what came in is still there, to be discarded.
        """
        folder = self.incoming_folder(record.job_id)
        (folder / SUBMISSION).write_text(record.model_dump_json(indent=1))
        move_folder(folder, self._folder("spool", record.job_id))

    @disk_errors()
    def spooled_ids(self) -> list[str]:
        """Ids of all accepted clips."""
        names = sorted(entry.name for entry in (self.data_dir / "spool").iterdir())
        return [name for name in names if is_job_id(name) and (self.spool_folder(name) / SUBMISSION).is_file()]

    def submission(self, job_id: str) -> JobRecord | None:
        """The record with which a clip was accepted; None if it is gone, or cannot be read as one."""
        with disk_errors(), contextlib.suppress(FileNotFoundError, ValidationError):
            return JobRecord.model_validate_json((self.spool_folder(job_id) / SUBMISSION).read_bytes())
        return None

    def spool_folder(self, job_id: str) -> Path:
        """Where the job's clip lies, or lay, on this machine."""
        return self._folder("spool", job_id)

    @disk_errors()
    def fetch_clip(self, job_id: str) -> Path:
        """The folder with the job's clip, brought to this machine if need be.

        Raises:
            UnavailableError: there is no such clip.
        """
        folder = self.spool_folder(job_id)
        if not (folder / SUBMISSION).is_file():
            raise UnavailableError(f"The clip of job {job_id} is not there.", "It was purged: send it again.")
        return folder

    # attempts

    @disk_errors()
    def work_folder(self, job_id: str, attempt: int, keep: str | None = None) -> Path:
        """The folder for one attempt, empty but for the file `keep` if an attempt before left one to go on from.

        The folders of earlier attempts are removed; one of a later attempt is not looked at.
        """
        folder = self._folder("work", job_id, attempt)
        folder.mkdir(mode=0o700, exist_ok=True)
        for name in (entry.name for entry in list(folder.iterdir()) if entry.name != keep):
            remove_tree(folder / name)
        for number in sorted((each for each in self._attempts("work", job_id) if each < attempt), reverse=True):
            earlier = self._folder("work", job_id, number)
            if keep and not (folder / keep).exists():
                with contextlib.suppress(FileNotFoundError):
                    (earlier / keep).rename(folder / keep)
            remove_tree(earlier)
        return folder

    def hand_over(self, job_id: str, attempt: int, keep: str) -> None:
        """Before a job is released: let an attempt on any machine go on from the file `keep`.

        On one disk it lies where work_folder() looks for it; there is nothing to do.
        """

    @disk_errors()
    def publish_scene(self, job_id: str, attempt: int) -> Path:
        """Put what the attempt has made into the place where finished scenes are looked for; may be repeated.

        Raises:
            SceneError: the attempt has left nothing, because a later one removed it.
        """
        work, scene = self._folder("work", job_id, attempt), self._folder("scenes", job_id, attempt)
        if work.is_dir():
            _remove_scene(scene)
            move_folder(work, scene)
        return self.scene_folder(job_id, attempt)

    @disk_errors()
    def scene_folder(self, job_id: str, attempt: int) -> Path:
        """The scene that one attempt has finished.

        Raises:
            SceneError: there is none.
        """
        folder = self._folder("scenes", job_id, attempt) if is_job_id(job_id) else None
        if folder is None or not (folder / MANIFEST).is_file():
            raise SceneError(f"There is no scene {job_id[:40]!r}.")
        return folder

    @disk_errors()
    def has_scene(self, job_id: str, attempt: int) -> bool:
        """Whether the attempt's scene is there."""
        return (self._folder("scenes", job_id, attempt) / MANIFEST).is_file()

    @disk_errors()
    def scene_attempts(self, job_id: str) -> list[int]:
        """The attempts whose scenes are there; more than one only until the last is reported and tidies up."""
        return [number for number in self._attempts("scenes", job_id) if self.has_scene(job_id, number)]

    def published_attempt(self, job_id: str) -> int | None:
        """The last attempt whose scene is there, for a record that was lost; None if there is no scene."""
        return max(self.scene_attempts(job_id), default=None)

    @disk_errors()
    def remove_attempt(self, job_id: str, attempt: int) -> None:
        """Remove what one attempt has written, also if it is in place and its report was refused."""
        remove_tree(self._folder("work", job_id, attempt))
        _remove_scene(self._folder("scenes", job_id, attempt))

    @disk_errors()
    def remove_other_attempts(self, job_id: str, attempt: int) -> None:
        """Remove all work on the job, and scenes other than that of the attempt, whose report was accepted."""
        for number in self._attempts("work", job_id):
            remove_tree(self._folder("work", job_id, number))
        for number in self._attempts("scenes", job_id):
            if number != attempt:
                _remove_scene(self._folder("scenes", job_id, number))

    @disk_errors()
    def scratch_folder(self, worker_name: str) -> Path:
        """Where one worker unpacks clips, emptied of what an earlier process of that name left."""
        folder = self.data_dir / "work" / f"tmp-{worker_name}"
        remove_tree(folder)
        folder.mkdir(mode=0o700)
        return folder

    # removal

    @disk_errors()
    def purge(self, job_id: str) -> Removed:
        """Remove clip, work and scenes of a job, and make sure that nothing of it is left; may be repeated.

        Raises:
            UnavailableError: something could not be removed.
        """
        folders = self._folders_of(job_id)
        files, sizes = dict.fromkeys(folders, 0), dict.fromkeys(folders, 0)
        for area, place in ((area, place) for area, places in folders.items() for place in places):
            with contextlib.suppress(FileNotFoundError):  # its worker has just renamed it, or another purge removes it
                for path in (path for path in place.rglob("*") if path.is_file()):
                    sizes[area] += path.stat().st_size
                    files[area] += 1
        for place in (place for places in folders.values() for place in places):
            (place / SUBMISSION).unlink(missing_ok=True)  # without it a clip counts as removed
            _remove_scene(place)
        for area in folders:
            flush(self.data_dir / area)
        left = sum(len(places) for places in self._folders_of(job_id).values())
        if left:
            raise UnavailableError(f"{left} folders of job {job_id} could not be removed.", "Ask for it once more.")
        return Removed(files, sizes)

    @disk_errors()
    def tidy(self) -> None:
        """Remove what nobody will come back for.

        That is what has not changed for ABANDONED_AFTER_S among uploads and what workers have unpacked, and the rest
        of purges that were cut off.
        """
        left = [*(self.data_dir / "incoming").iterdir(), *(self.data_dir / "work").glob("tmp-*/*")]
        for path in left:
            with contextlib.suppress(FileNotFoundError):  # its user has just ended
                touched_s = max(each.stat().st_mtime for each in (path, *path.rglob("*")))
                if touched_s < time.time() - ABANDONED_AFTER_S:
                    remove_tree(path)
        for area, marker in (("spool", SUBMISSION), ("scenes", MANIFEST)):
            for folder in (self.data_dir / area).iterdir():
                if not (folder / marker).is_file():
                    remove_tree(folder)

    def _folders_of(self, job_id: str) -> dict[str, list[Path]]:
        """Everything that is there of a job, by area."""
        found = {area: [self._folder(area, job_id)] for area in ("incoming", "spool")}
        found |= {
            area: [self._folder(area, job_id, attempt) for attempt in self._attempts(area, job_id)]
            for area in ("work", "scenes")
        }
        return {area: [folder for folder in folders if folder.exists()] for area, folders in found.items()}

    def _attempts(self, area: str, job_id: str) -> list[int]:
        """Numbers of the attempts that have a folder in the area, in order."""
        # Not by glob: Python keeps each pattern it has seen, and every job would be another.
        beginning = f"{self._checked(job_id)}."
        names = [entry.name for entry in os.scandir(self.data_dir / area) if entry.name.startswith(beginning)]
        return sorted(int(name.removeprefix(beginning)) for name in names)

    def _number_old_scenes(self) -> None:
        """Version 0.1 kept one scene a job, in a folder without a number: it counts as made by the first attempt."""
        for entry in list((self.data_dir / "scenes").iterdir()):
            if is_job_id(entry.name):
                with contextlib.suppress(FileNotFoundError):  # another process does the same
                    entry.rename(entry.with_name(f"{entry.name}.1"))

    def _folder(self, area: str, job_id: str, attempt: int | None = None) -> Path:
        return self.data_dir / area / (self._checked(job_id) + ("" if attempt is None else f".{attempt:d}"))

    @staticmethod
    def _checked(job_id: str) -> str:
        if not is_job_id(job_id):
            raise ValueError(f"not a job id: {job_id!r}")
        return job_id


def remove_tree(path: Path) -> None:
    """Remove a file or a folder with all that is in it, as far as it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, onerror=_unless_gone)
    else:
        path.unlink(missing_ok=True)


def _remove_scene(folder: Path) -> None:
    """Remove a folder; its manifest first, so that nobody finds half a scene."""
    (folder / MANIFEST).unlink(missing_ok=True)
    remove_tree(folder)


def _unless_gone(_: object, __: object, failure: tuple[type[BaseException], BaseException, object]) -> None:
    """For rmtree: somebody else removing the same is no failure."""
    if not isinstance(failure[1], FileNotFoundError):
        raise failure[1]
