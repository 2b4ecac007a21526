"""Clips and scenes on disk, and the rules by which a folder appears: written aside, made durable, then renamed.

    data_dir/
    ├── incoming/<job>/   an upload in progress; removed when it fails
    ├── spool/<job>/      accepted clips: clip.mp4, calibration.json, ..., submission.json (the JobRecord as submitted)
    ├── work/<job>.<n>/   what attempt n has written so far
    ├── scenes/<job>/     finished scenes: manifest.json, scene.safetensors, report.json, curve.csv
    ├── run/              sockets of live workers
    └── valkey/           the embedded queue's log

A folder in spool/ or scenes/ is complete by its mere presence. The data directory is readable by its owner only.
"""

from __future__ import annotations

import os
import re
import shutil
import uuid
from pathlib import Path

from contract.errors import SceneError
from contract.job import JOB_ID_PATTERN, JobRecord

SUBMISSION = "submission.json"
MANIFEST = "manifest.json"
REPORT = "report.json"
CURVE = "curve.csv"


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
        shutil.rmtree(self._folder("incoming", job_id), ignore_errors=True)

    def accept(self, record: JobRecord) -> Path:
        """Make an upload a spooled clip: submission written, all of it on disk, then renamed into place."""
        folder = self._folder("incoming", record.job_id)
        (folder / SUBMISSION).write_text(record.model_dump_json(indent=1))
        return _publish(folder, self._folder("spool", record.job_id))

    def spool_folder(self, job_id: str) -> Path:
        """Where the job's clip lies, or lay."""
        return self._folder("spool", job_id)

    def work_folder(self, job_id: str, attempt: int) -> Path:
        """A new empty folder for one attempt; a left-over of the same attempt is removed first."""
        folder = self._folder("work", job_id, suffix=f".{attempt}")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(mode=0o700)
        return folder

    def publish_scene(self, job_id: str, attempt: int) -> Path:
        """Make the attempt's folder the job's scene, in place of one that an attempt published and could not report."""
        shutil.rmtree(self._folder("scenes", job_id), ignore_errors=True)
        return _publish(self._folder("work", job_id, suffix=f".{attempt}"), self._folder("scenes", job_id))

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
        folders = [entry for entry in (self.data_dir / "scenes").iterdir() if (entry / MANIFEST).is_file()]
        return [entry.name for entry in sorted(folders, key=lambda entry: entry.stat().st_mtime, reverse=True)]

    def remove_attempt(self, job_id: str, attempt: int) -> None:
        """Remove what one attempt has written and not published."""
        shutil.rmtree(self._folder("work", job_id, suffix=f".{attempt}"), ignore_errors=True)

    def remove_clip(self, job_id: str) -> None:
        """Remove the job's clip and all unpublished work on it."""
        shutil.rmtree(self._folder("spool", job_id), ignore_errors=True)
        for folder in (self.data_dir / "work").glob(f"{job_id}.*"):
            shutil.rmtree(folder, ignore_errors=True)

    def remove(self, job_id: str) -> None:
        """Remove clip, work and scene."""
        self.remove_clip(job_id)
        shutil.rmtree(self._folder("scenes", job_id), ignore_errors=True)

    def _folder(self, area: str, job_id: str, suffix: str = "") -> Path:
        return self.data_dir / area / (self._checked(job_id) + suffix)

    @staticmethod
    def _checked(job_id: str) -> str:
        if not is_job_id(job_id):
            raise ValueError(f"not a job id: {job_id!r}")
        return job_id


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
