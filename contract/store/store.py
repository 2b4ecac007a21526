"""The store of clips and scenes: a data directory on each machine and, for many machines, one bucket.

    data_dir/
    ├── incoming/<id>/      an upload, whole or resumable, before it is a job; removed when it is refused or given up
    ├── spool/<job>/        an accepted clip: clip.mp4, calibration.json, ..., submission.json (the first JobRecord),
    │                       and labels.json if its caller has labelled the job
    ├── work/<job>.<n>/     what attempt n has written of its scene so far
    ├── kept/<job>.<n>/     what a later attempt resumes from: resume.safetensors, and prepared/, the clip with depth
    ├── work/tmp-<name>/    what worker <name> has unpacked; emptied whenever it starts
    ├── scenes/<job>.<n>/   what attempt n has finished: manifest.json, scene.safetensors, report.json, curve.csv
    │                       and, if there are any, recorded.zip, masks.zip (found masks) and thumbnail.jpg
    ├── unscored/<name>/    an empty file <job>.<n> for each scene that worker <name> has finished and not scored yet
    ├── purging/<job>       an empty file for each job whose removal has started and not ended (service/purge.py)
    ├── feeds/<id>/         of a live feed: its recording and the past of its model (contract/store/feed_files.py)
    ├── restoring           exists while the data directory is filled from a backup
    ├── run/                of live processes: sockets, locks, claims, last words, the workers' known addresses
    └── valkey/             the embedded queue's log

A folder in spool/ or scenes/ is always complete. The job's record in the queue says which attempt's scene is THE scene
of the job. An attempt writes only to folders of its own number, and removes those of earlier attempts; the attempt that
the queue has accepted removes all others. So a worker that was assumed dead cannot damage a later attempt. Only its
owner can read the data directory.

Every method raises UnavailableError when the disk is full (StoreFullError), read-only, missing or failing, and when the
bucket does not answer.
"""

from __future__ import annotations

import contextlib
import shutil
import threading
import time
from pathlib import Path

from pydantic import ValidationError

from contract.runtime.settings import Settings
from contract.store.local import LocalShelf, remove_tree
from contract.store.s3 import S3Shelf
from contract.store.shelf import ABANDONED_AFTER_S, Area, Removed, Shelf, ShelfEntry, entry_of, is_job_id
from contract.wire.job import JobRecord
from contract.wire.labels import Labels
from intrasplat.errors import SceneError, UnavailableError
from intrasplat.files.disk_errors import disk_errors
from intrasplat.files.durable import replace_file
from intrasplat.names import LABELS, REPORT, RESUME_STATE, SUBMISSION, THUMBNAIL
from intrasplat.report import Report
from intrasplat.scene.results import RESULTS, add_scores

UNSCORED = "unscored"
PURGING = "purging"
RESTORING = "restoring"


def open_store(settings: Settings) -> Store:
    """The store that the settings name.

    Raises:
        UnavailableError: the data directory cannot be created or its restore is unfinished, the bucket does not answer,
            or the package for buckets is not installed.
    """
    if (settings.data_dir.expanduser() / RESTORING).exists():
        problem = f"A restore into {settings.data_dir} was cut off, or goes on."
        raise UnavailableError(problem, "Wait for it; if it was cut off, restore again: it goes on.")
    return Store(settings.data_dir, settings.store_url)


class Store:
    """Clips and scenes of an installation. store_url: the bucket that keeps them; None: the data directory does."""

    @disk_errors()
    def __init__(self, data_dir: Path, store_url: str | None = None) -> None:
        self.data_dir = data_dir.expanduser().resolve()
        self._here = LocalShelf(self.data_dir)
        self._shelf: Shelf = self._here if store_url is None else S3Shelf(self._here, store_url)
        self.run_dir.mkdir(mode=0o700, exist_ok=True)
        self._keeping = threading.Lock()

    @property
    def run_dir(self) -> Path:
        """The folder of what live processes share: sockets, locks, claims."""
        return self.data_dir / "run"

    @disk_errors()
    def free_bytes(self) -> int:
        """Free space on the data directory's disk, bytes."""
        return shutil.disk_usage(self.data_dir).free

    # what comes in

    @disk_errors()
    def open_incoming(self, job_id: str) -> Path:
        """Create an empty folder for an upload."""
        folder = self.incoming_folder(job_id)
        folder.mkdir(mode=0o700)
        return folder

    def incoming_folder(self, job_id: str) -> Path:
        """The folder of the upload with that id, which need not exist."""
        return self._here.path(ShelfEntry(Area.INCOMING, job_id))

    @disk_errors()
    def discard_incoming(self, job_id: str) -> None:
        """Remove an upload that will not become a job."""
        remove_tree(self.incoming_folder(job_id))

    def accept(self, record: JobRecord) -> None:
        """Turn an upload into an accepted clip. When this returns, the clip survives a crash and a power failure.

        After an error nothing is accepted, and the upload is still there.
        """
        folder, clip = self.incoming_folder(record.job_id), ShelfEntry(Area.SPOOL, record.job_id)
        with disk_errors():
            # An earlier version that reads this file refuses fields that it does not know.
            absent = {"labels"} if record.callback_url else {"labels", "callback_url"}
            (folder / SUBMISSION).write_text(record.model_dump_json(indent=1, exclude=absent))
            if record.labels != Labels():
                (folder / LABELS).write_text(record.labels.model_dump_json())
        self._shelf.put(folder, clip)
        with contextlib.suppress(UnavailableError):  # tidy() drops it later
            self._shelf.drop_copy(clip)  # the worker that needs it may be on another machine

    def spooled_ids(self) -> list[str]:
        """Ids of all accepted clips."""
        return [entry.job_id for entry in self._shelf.entries(Area.SPOOL)]

    def submission(self, job_id: str) -> JobRecord | None:
        """The record with which a clip was accepted; None if it does not exist or cannot be read."""
        content = self._shelf.read_marker(ShelfEntry(Area.SPOOL, job_id))
        with contextlib.suppress(ValidationError):
            return JobRecord.model_validate_json(content) if content is not None else None
        return None

    def labels(self, job_id: str) -> Labels:
        """The labels of a job; empty if its clip is gone or they cannot be read."""
        content = self._shelf.read(ShelfEntry(Area.SPOOL, job_id), LABELS)
        with contextlib.suppress(ValidationError):
            return Labels.model_validate_json(content) if content is not None else Labels()
        return Labels()

    def keep_labels(self, job_id: str, labels: Labels) -> None:
        """Replace a job's labels in the spool; nothing happens if the clip is gone."""
        self._shelf.put_text(ShelfEntry(Area.SPOOL, job_id), LABELS, labels.model_dump_json().encode())

    def labelled_submission(self, job_id: str) -> JobRecord | None:
        """submission() with the job's present labels."""
        record = self.submission(job_id)
        return record and record.model_copy(update={"labels": self.labels(job_id)})

    def spool_folder(self, job_id: str) -> Path:
        """The folder of the job's clip on this machine, which need not exist."""
        return self._here.path(ShelfEntry(Area.SPOOL, job_id))

    def fetch_clip(self, job_id: str) -> Path:
        """The folder with the job's clip, downloaded if necessary.

        Raises:
            UnavailableError: there is no such clip.
        """
        folder = self._shelf.get(ShelfEntry(Area.SPOOL, job_id))
        if folder is None:
            raise UnavailableError(f"The clip of job {job_id} is not there.", "It was purged. Send it again.")
        return folder

    # attempts

    def work_folder(self, job_id: str, attempt: int) -> Path:
        """Create an empty folder for the scene of one attempt. Removes those of earlier attempts, not later ones."""
        folder = self._here.path(ShelfEntry(Area.WORK, job_id, attempt))
        with disk_errors():
            remove_tree(folder)
            folder.mkdir(mode=0o700)
            for entry in self._earlier(Area.WORK, job_id, attempt):
                remove_tree(self._here.path(entry))
        return folder

    def resume_folder(self, job_id: str, attempt: int) -> Path:
        """The folder from which a later attempt resumes, with the newest state that this or an earlier attempt stored.

        The folders of earlier attempts are removed; a later attempt's is not touched.
        """
        self._fetch_resume(job_id, attempt)
        folder = self._here.path(ShelfEntry(Area.KEPT, job_id, attempt))
        with disk_errors():
            folder.mkdir(mode=0o700, exist_ok=True)
            for path in [path for path in folder.iterdir() if path.name not in RESUME_STATE]:
                remove_tree(path)
            for entry in self._earlier(Area.KEPT, job_id, attempt):
                for name in RESUME_STATE:
                    if not (folder / name).exists():
                        with contextlib.suppress(FileNotFoundError):
                            (self._here.path(entry) / name).rename(folder / name)
                remove_tree(self._here.path(entry))
        return folder

    def hand_over(self, job_id: str, attempt: int) -> None:
        """Let an attempt on any machine continue from this one's resume state; call it before releasing the job.

        A store on this machine's disk needs nothing for that. A prepared clip stays on this machine.
        """
        entry = ShelfEntry(Area.KEPT, job_id, attempt)
        if self._here.holds(entry):
            self._shelf.put(self._here.path(entry), entry)

    def publish_scene(self, job_id: str, attempt: int) -> Path:
        """Make the attempt's work folder its finished scene. May be repeated.

        Raises:
            SceneError: there is no work folder, because a later attempt has removed it.
        """
        work = self._here.path(ShelfEntry(Area.WORK, job_id, attempt))
        if work.is_dir():
            self._shelf.put(work, ShelfEntry(Area.SCENES, job_id, attempt))
        return self.scene_folder(job_id, attempt)

    @disk_errors()
    def expect_scores(self, worker_name: str, job_id: str, attempt: int) -> None:
        """Note that the worker has to score a scene that it publishes."""
        folder = self.data_dir / UNSCORED / worker_name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        replace_file(folder / ShelfEntry(Area.SCENES, job_id, attempt).name, b"")

    @disk_errors()
    def unscored(self, worker_name: str) -> list[tuple[str, int]]:
        """Job and attempt of the scenes that the worker has to score."""
        folder = self.data_dir / UNSCORED / worker_name
        names = sorted(each.name for each in folder.iterdir()) if folder.is_dir() else []
        found = (entry_of(Area.SCENES, name) for name in names)
        return [(entry.job_id, entry.attempt) for entry in found if entry is not None and entry.attempt is not None]

    def add_scores(self, worker_name: str, job_id: str, attempt: int, report: Report) -> None:
        """Put the scored report into a published scene. A removed scene does not come back."""
        entry = ShelfEntry(Area.SCENES, job_id, attempt)
        if (folder := self._shelf.get(entry)) is not None:
            with disk_errors(), contextlib.suppress(FileNotFoundError):
                add_scores(folder, report)
                self._shelf.put_files(entry, RESULTS)
        self.expect_no_scores(worker_name, job_id, attempt)

    @disk_errors()
    def expect_no_scores(self, worker_name: str, job_id: str, attempt: int) -> None:
        """Remove the note of expect_scores()."""
        name = ShelfEntry(Area.SCENES, job_id, attempt).name
        (self.data_dir / UNSCORED / worker_name / name).unlink(missing_ok=True)

    def newest_report(self, job_id: str, attempt: int) -> Report:
        """The report of the attempt's finished scene.

        Raises:
            SceneError: the scene does not exist, or its report cannot be read.
        """
        report, entry = self._report(job_id, attempt), ShelfEntry(Area.SCENES, job_id, attempt)
        if report.scored or self._here.read_marker(entry) == self._shelf.read_marker(entry):
            return report
        self._shelf.drop_copy(entry)  # the copy is older than the scores that another machine has added in the bucket
        return self._report(job_id, attempt)

    def _report(self, job_id: str, attempt: int) -> Report:
        path = self.scene_folder(job_id, attempt) / REPORT
        try:
            # a worker of a later version may report fields that this version does not know
            return Report.model_validate_json(path.read_bytes(), extra="ignore")
        except (OSError, ValidationError) as error:
            raise SceneError(f"The report of scene {job_id} cannot be read ({type(error).__name__}).") from error

    def scene_folder(self, job_id: str, attempt: int) -> Path:
        """The folder of the attempt's finished scene, downloaded if necessary.

        Raises:
            SceneError: the scene does not exist, or the bucket's copy is damaged.
        """
        folder = self._shelf.get(ShelfEntry(Area.SCENES, job_id, attempt)) if is_job_id(job_id) else None
        if folder is None:
            raise SceneError(f"There is no scene {job_id[:40]!r}.")
        return folder

    def thumbnail(self, job_id: str, attempt: int) -> bytes | None:
        """The stored thumbnail of the attempt's scene; None if there is none yet.

        Raises:
            SceneError: the scene does not exist, or the bucket's copy is damaged.
        """
        path = self.scene_folder(job_id, attempt) / THUMBNAIL
        with disk_errors(), contextlib.suppress(FileNotFoundError):
            return path.read_bytes()
        return None

    def keep_thumbnail(self, job_id: str, attempt: int, content: bytes) -> None:
        """Store a thumbnail in a published scene. A removed scene does not come back."""
        entry = ShelfEntry(Area.SCENES, job_id, attempt)
        if (folder := self._shelf.get(entry)) is not None:
            with self._keeping, disk_errors(), contextlib.suppress(FileNotFoundError, FileExistsError):
                replace_file(folder / THUMBNAIL, content)  # another process may write the same file now
                self._shelf.put_files(entry, (THUMBNAIL,))

    def has_scene(self, job_id: str, attempt: int) -> bool:
        """Whether the attempt's scene exists."""
        return self._shelf.holds(ShelfEntry(Area.SCENES, job_id, attempt))

    def scene_attempts(self, job_id: str) -> list[int]:
        """The attempts whose scenes exist. There may be several until remove_other_attempts()."""
        return [entry.attempt for entry in self._shelf.entries(Area.SCENES, job_id) if entry.attempt is not None]

    def finished_scenes(self) -> dict[str, list[int]]:
        """The attempts whose scenes exist, by job; see scene_attempts()."""
        found: dict[str, list[int]] = {}
        for entry in self._shelf.entries(Area.SCENES):
            if entry.attempt is not None:
                found.setdefault(entry.job_id, []).append(entry.attempt)
        return found

    def published_attempt(self, job_id: str) -> int | None:
        """The last attempt whose scene exists; None if there is no scene. For a job whose record was lost."""
        return max(self.scene_attempts(job_id), default=None)

    def remove_attempt(self, job_id: str, attempt: int) -> None:
        """Remove all that one attempt has written, its published scene included."""
        for area in (Area.WORK, Area.KEPT, Area.SCENES):
            self._shelf.remove(area, job_id, attempt)

    def remove_failed(self, job_id: str, attempt: int) -> None:
        """Remove the files of this attempt and earlier ones of a failed job on this machine."""
        for area in (Area.WORK, Area.KEPT, Area.SCENES):
            for entry in self._here.folders(area, job_id):
                if entry.attempt is not None and entry.attempt <= attempt:
                    self._shelf.remove(area, job_id, entry.attempt)

    def has_unfinished_work(self, job_id: str) -> bool:
        """Whether this machine has work on the job, or a state from which an attempt could resume."""
        return any(self._here.folders(area, job_id) for area in (Area.WORK, Area.KEPT))

    def remove_other_attempts(self, job_id: str, attempt: int) -> None:
        """Remove all work on the job and all scenes but that of the attempt, which the queue has accepted."""
        for area in (Area.WORK, Area.KEPT):
            self._shelf.remove(area, job_id)
        for other in {*self._shelf.entries(Area.SCENES, job_id), *self._here.folders(Area.SCENES, job_id)}:
            if other.attempt != attempt:
                self._shelf.remove(Area.SCENES, job_id, other.attempt)
        self._shelf.drop_copy(ShelfEntry(Area.SPOOL, job_id))

    @disk_errors()
    def scratch_folder(self, worker_name: str) -> Path:
        """An empty folder in which a worker unpacks clips; what an earlier process of that name left is removed."""
        folder = self.data_dir / Area.WORK / f"tmp-{worker_name}"
        remove_tree(folder)
        folder.mkdir(mode=0o700)
        return folder

    # removal

    def purge(self, job_id: str) -> Removed:
        """Remove clip, work and scenes of a job, and check that nothing is left. May be repeated.

        A bucket loses every version. Other machines stop showing their copies within seconds, and remove them later.

        Raises:
            UnavailableError: something could not be removed.
        """
        removed = Removed({}, {})
        for area in Area:
            removed += self._shelf.remove(area, job_id)
        with disk_errors():
            # no pattern with the id in it, because Python caches hundreds of patterns
            for path in (each for each in (self.data_dir / UNSCORED).glob("*/*") if each.name.startswith(f"{job_id}.")):
                path.unlink(missing_ok=True)
        left = sum(len(self._here.folders(area, job_id)) for area in Area)
        if left:
            raise UnavailableError(f"{left} folders of job {job_id} could not be removed.", "Purge it once more.")
        return removed

    def tidy(self) -> None:
        """Remove the files of processes that have ended.

        These are uploads and unpacked clips that have not changed for ABANDONED_AFTER_S, the rest of interrupted
        removals, unused copies, and copies whose original is gone.
        """
        with disk_errors():
            for path in [*(self.data_dir / Area.INCOMING).iterdir(), *(self.data_dir / Area.WORK).glob("tmp-*/*")]:
                with contextlib.suppress(FileNotFoundError):  # its user has just ended
                    changed_s = max(each.stat().st_mtime for each in (path, *path.rglob("*")))
                    if changed_s < time.time() - ABANDONED_AFTER_S:
                        remove_tree(path)
        self._shelf.tidy()

    def _fetch_resume(self, job_id: str, attempt: int) -> None:
        """Download the resume state that an earlier attempt handed over, unless this machine has one as new."""
        here = [entry.attempt for entry in self._here.entries(Area.KEPT, job_id) if entry.attempt is not None]
        for entry in reversed(self._shelf.entries(Area.KEPT, job_id)):
            if entry.attempt is not None and entry.attempt < attempt:
                if entry.attempt > max(here, default=0):
                    self._shelf.get(entry)
                return

    def _earlier(self, area: Area, job_id: str, attempt: int) -> list[ShelfEntry]:
        """The folders of earlier attempts on this machine, newest first."""
        found = self._here.folders(area, job_id)
        return [entry for entry in reversed(found) if entry.attempt is not None and entry.attempt < attempt]
