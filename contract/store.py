"""Clips and scenes on disk, and the rules by which a folder appears: written aside, made durable, then renamed.

    data_dir/
    ├── incoming/<job>/   an upload in progress; removed when it fails
    ├── spool/<job>/      accepted clips: clip.mp4, calibration.json, ..., submission.json (the JobRecord as submitted)
    ├── work/<job>.<n>/   what attempt n has written so far
    ├── work/tmp-<name>/  what worker <name> has unpacked; emptied whenever it starts
    ├── scenes/<job>/     finished scenes: manifest.json, scene.safetensors, report.json, curve.csv
    ├── run/              sockets of live workers
    └── valkey/           the embedded queue's log

A folder in spool/ or scenes/ is complete by its mere presence. The data directory is readable by its owner only.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
import uuid
from pathlib import Path

from contract.errors import SceneError
from contract.job import JOB_ID_PATTERN, JobRecord

SUBMISSION = "submission.json"
MANIFEST = "manifest.json"
REPORT = "report.json"
CURVE = "curve.csv"

ABANDONED_AFTER_S = 24 * 3600.0
"""An upload that has received nothing for this long was cut off by the end of its service."""


def new_job_id() -> str:
    """A random id, safe as a file name and unguessable."""
    return uuid.uuid4().hex


def is_job_id(text: str) -> bool:
    """Whether `text` may be used as a part of a path here."""
    return re.fullmatch(JOB_ID_PATTERN, text) is not None


class Store:
    """The folders above, under one data directory that this makes if need be."""

    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir.expanduser().resolve()
        self.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in ("incoming", "spool", "work", "scenes", "run"):
            (self.data_dir / name).mkdir(mode=0o700, exist_ok=True)

    @property
    def run_dir(self) -> Path:
        """Where live workers put their sockets."""
        return self.data_dir / "run"

    def free_bytes(self) -> int:
        """What is left on the data directory's disk."""
        return shutil.disk_usage(self.data_dir).free

    def open_incoming(self, job_id: str) -> Path:
        """A new empty folder to receive an upload."""
        folder = self._folder("incoming", job_id)
        folder.mkdir(mode=0o700)
        return folder

    def discard_incoming(self, job_id: str) -> None:
        """Remove an upload that will not become a job."""
        _remove(self._folder("incoming", job_id))

    def accept(self, record: JobRecord) -> Path:
        """Make an upload a spooled clip: submission written, all of it on disk, then renamed into place."""
        folder = self._folder("incoming", record.job_id)
        (folder / SUBMISSION).write_text(record.model_dump_json(indent=1))
        return _publish(folder, self._folder("spool", record.job_id))

    def spool_folder(self, job_id: str) -> Path:
        """Where the job's clip lies, or lay."""
        return self._folder("spool", job_id)

    def spooled_ids(self) -> list[str]:
        """The jobs whose clips are spooled."""
        return [entry.name for entry in (self.data_dir / "spool").iterdir() if is_job_id(entry.name)]

    def submission(self, job_id: str) -> JobRecord | None:
        """The record of a spooled clip as it was submitted; None if the clip is gone, or its submission unreadable."""
        try:
            return JobRecord.model_validate_json((self.spool_folder(job_id) / SUBMISSION).read_bytes())
        except (FileNotFoundError, ValueError):
            return None

    def incoming_folder(self, upload_id: str) -> Path:
        """Where an upload in progress lies, or lay."""
        return self._folder("incoming", upload_id)

    def work_folder(self, job_id: str, attempt: int, keep: str | None = None) -> Path:
        """The folder for one attempt, empty but for the file `keep` if the attempt before left one to go on from.

        The folders of earlier attempts are removed.
        """
        folder = self._folder("work", job_id, suffix=f".{attempt}")
        earlier = self._attempts(job_id)
        if earlier:
            earlier.pop().rename(folder)
        folder.mkdir(mode=0o700, exist_ok=True)
        for path in (*earlier, *(entry for entry in folder.iterdir() if entry.name != keep)):
            _remove(path)
        return folder

    def publish_scene(self, job_id: str, attempt: int) -> Path:
        """Make the attempt's folder the job's scene, in place of one that an attempt published and could not report."""
        _remove(self._folder("scenes", job_id))
        scene = _publish(self._folder("work", job_id, suffix=f".{attempt}"), self._folder("scenes", job_id))
        for folder in self._attempts(job_id):
            _remove(folder)
        return scene

    def scene_folder(self, job_id: str) -> Path:
        """The finished scene's folder.

        Raises:
            SceneError: there is none of that id.
        """
        folder = self._folder("scenes", job_id) if is_job_id(job_id) else None
        if folder is None or not (folder / MANIFEST).is_file():
            raise SceneError(f"There is no scene {job_id[:40]!r}.")
        return folder

    def scene_ids(self) -> list[str]:
        """Ids of all finished scenes, newest first."""
        born_s = {}
        for entry in (self.data_dir / "scenes").iterdir():
            with contextlib.suppress(FileNotFoundError):  # deleted since it was listed
                if (entry / MANIFEST).is_file():
                    born_s[entry.name] = entry.stat().st_mtime
        return sorted(born_s, key=lambda name: born_s[name], reverse=True)

    def remove_attempt(self, job_id: str, attempt: int) -> None:
        """Remove what one attempt has written and not published."""
        _remove(self._folder("work", job_id, suffix=f".{attempt}"))

    def remove_clip(self, job_id: str) -> None:
        """Remove the job's clip and all unpublished work on it."""
        for folder in (self._folder("spool", job_id), *self._attempts(job_id)):
            _remove(folder)

    def remove(self, job_id: str) -> None:
        """Remove clip, work and scene."""
        self.remove_clip(job_id)
        _remove(self._folder("scenes", job_id))

    def scratch_folder(self, worker_name: str) -> Path:
        """Where one worker unpacks clips, emptied of what an earlier process of that name left."""
        folder = self.data_dir / "work" / f"tmp-{worker_name}"
        _remove(folder)
        folder.mkdir(mode=0o700)
        return folder

    def remove_abandoned_uploads(self) -> None:
        """Remove what is left of uploads that have received nothing for ABANDONED_AFTER_S."""
        for folder in (self.data_dir / "incoming").iterdir():
            with contextlib.suppress(FileNotFoundError):  # its upload has just ended
                touched_s = max(path.stat().st_mtime for path in (folder, *folder.iterdir()))
                if touched_s < time.time() - ABANDONED_AFTER_S:
                    _remove(folder)

    def _attempts(self, job_id: str) -> list[Path]:
        """The folders of the job's attempts, the last attempt's last."""
        folders = (self.data_dir / "work").glob(f"{self._checked(job_id)}.*")
        return sorted(folders, key=lambda folder: int(folder.suffix[1:]))

    def _folder(self, area: str, job_id: str, suffix: str = "") -> Path:
        return self.data_dir / area / (self._checked(job_id) + suffix)

    @staticmethod
    def _checked(job_id: str) -> str:
        if not is_job_id(job_id):
            raise ValueError(f"not a job id: {job_id!r}")
        return job_id


def _remove(path: Path) -> None:
    """Remove a file or a folder with all that is in it, as far as it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _publish(source: Path, target: Path) -> Path:
    """Rename a folder into place only after every byte of it is on disk."""
    for path in source.rglob("*"):
        _flush(path)
    _flush(source)
    source.rename(target)
    _flush(target.parent)
    return target


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
