"""The store for many machines: the truth lies in an S3 bucket, and the data directory holds copies of what is in use.

    s3://bucket/prefix/
    ├── spool/<job>/        as on disk; submission.json is written last and removed first: without it there is no clip
    ├── scenes/<job>.<n>/   as on disk; the same holds of manifest.json
    └── resume/<job>.<n>/   what attempt n can be gone on from, handed over when its worker gave the job back

Address and credentials are the customary AWS_* variables (AWS_ENDPOINT_URL for a server that is not Amazon's). Uploads
in progress stay with the service that receives them. A copy is shown only while its original is there, so that a
purge on one machine holds on all.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from contract.store.store import (
    ABANDONED_AFTER_S,
    NO_ROOM,
    Removed,
    Store,
    disk_errors,
    is_job_id,
    new_job_id,
    remove_tree,
)
from contract.wire.errors import SceneError, UnavailableError
from contract.wire.job import JobRecord
from contract.wire.names import MANIFEST, SUBMISSION

LOOKED_FOR_S = 2.0
"""What was there is taken to be there for so long: a purge on another machine takes effect as late."""

CONNECT_TIMEOUT_S = 5
READ_TIMEOUT_S = 60
RETRIES = {"mode": "standard", "total_max_attempts": 2}
"""Who calls tries again anyway, or tells its own caller to."""
LISTING_PAGE = 1000
"""S3 lists and deletes so many objects with one call."""

BUCKET_REMEDY = "Look at INTRASPLAT_STORE_URL, the AWS_* variables and the bucket's own state."


@dataclass(frozen=True)
class Stored:
    """An object of the bucket; its key counts from the prefix."""

    key: str
    size_bytes: int
    written_at_s: float


class Bucket:
    """The few calls of S3 that a store needs, under one prefix.

    All, the constructor among them, raise UnavailableError when the bucket cannot be reached or refuses.
    """

    def __init__(self, url: str) -> None:
        try:
            s3fs = importlib.import_module("s3fs")  # only here: it is an extra, and slow to import
        except ImportError as error:
            remedy = "pip install 'intrasplat[s3]'"
            raise UnavailableError("A store in a bucket needs the package s3fs.", remedy) from error
        self._name, _, prefix = url.removeprefix("s3://").strip("/").partition("/")
        self._prefix = f"{prefix}/" if prefix else ""
        calls = {"connect_timeout": CONNECT_TIMEOUT_S, "read_timeout": READ_TIMEOUT_S, "retries": RETRIES}
        self._files: Any = s3fs.S3FileSystem(skip_instance_cache=True, use_listings_cache=False, config_kwargs=calls)
        self._call("head_bucket")  # from here on, what is not found is an object

    def put(self, path: Path, key: str) -> None:
        """Store a file; it appears whole or not at all."""
        with _bucket_errors():
            self._files.put_file(str(path), self._path(key))

    def get(self, key: str, path: Path) -> None:
        """Bring an object here."""
        with _bucket_errors():
            self._files.get_file(self._path(key), str(path))

    def read(self, key: str) -> bytes | None:
        """An object's content; None if it is not there."""
        with _bucket_errors(), contextlib.suppress(FileNotFoundError):
            content: bytes = self._files.cat_file(self._path(key))
            return content
        return None

    def holds(self, key: str) -> bool:
        """Whether the object is there."""
        with _bucket_errors():
            return bool(self._files.exists(self._path(key)))

    def objects(self, start: str) -> list[Stored]:
        """The objects whose keys begin so."""
        found = []
        for page in self._pages("list_objects_v2", {"ContinuationToken": "NextContinuationToken"}, start):
            for each in page.get("Contents", ()):
                key = each["Key"].removeprefix(self._prefix)
                found.append(Stored(key, each["Size"], each["LastModified"].timestamp()))
        return found

    def remove(self, start: str, first: str | None = None) -> Removed:
        """Remove the objects whose keys begin so in every version the bucket keeps; those named `first` go first."""
        files, size_bytes = 0, 0
        markers = {"KeyMarker": "NextKeyMarker", "VersionIdMarker": "NextVersionIdMarker"}
        while True:
            pages = list(self._pages("list_object_versions", markers, start))
            versions = [each for page in pages for each in page.get("Versions", ())]
            files += sum(1 for each in versions if each["IsLatest"])
            size_bytes += sum(each["Size"] for each in versions)
            everything = versions + [each for page in pages for each in page.get("DeleteMarkers", ())]
            if not everything:
                return Removed({"bucket": files}, {"bucket": size_bytes})
            everything.sort(key=lambda each: not each["Key"].endswith(f"/{first}"))
            for each in everything:
                self._call("delete_object", Key=each["Key"], VersionId=each["VersionId"])

    def _pages(self, method: str, markers: dict[str, str], start: str) -> Iterator[dict[str, Any]]:
        """The pages of a listing; markers: which value of an answer is which argument for the next page."""
        arguments: dict[str, Any] = {"Prefix": self._prefix + start, "MaxKeys": LISTING_PAGE}
        while True:
            page = self._call(method, **arguments)
            yield page
            if not page.get("IsTruncated"):
                return
            arguments |= {name: page[value] for name, value in markers.items() if page.get(value)}

    def _call(self, method: str, **arguments: Any) -> dict[str, Any]:
        with _bucket_errors():
            answer: dict[str, Any] = self._files.call_s3(method, Bucket=self._name, **arguments)
            return answer

    def _path(self, key: str) -> str:
        return f"{self._name}/{self._prefix}{key}"


@contextlib.contextmanager
def _bucket_errors() -> Iterator[None]:
    """What S3 or the way to it refuses, as an UnavailableError."""
    botocore: Any = importlib.import_module("botocore.exceptions")
    try:
        yield
    except (OSError, botocore.BotoCoreError, botocore.ClientError) as error:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            raise  # of this machine's disk, where a copy was to be
        problem = f"The bucket does not answer ({type(error).__name__})."
        raise UnavailableError(problem, BUCKET_REMEDY, may_return=True) from error


class BucketStore(Store):
    """A Store whose accepted clips and finished scenes lie in a bucket."""

    def __init__(self, data_dir: Path, url: str) -> None:
        super().__init__(data_dir)
        self._bucket = Bucket(url)
        self._seen_s: dict[Path, float] = {}
        """When, on the monotonic clock, the original of a folder here was last known to be there."""

    def accept(self, record: JobRecord) -> None:
        """As Store.accept; the clip is in the bucket when this returns, and no longer here."""
        folder = self.incoming_folder(record.job_id)
        key = f"spool/{record.job_id}/"
        with disk_errors():
            (folder / SUBMISSION).write_text(record.model_dump_json(indent=1))
        try:
            self._put_folder(folder, key, last=SUBMISSION)
        except UnavailableError:
            with contextlib.suppress(UnavailableError):  # what stays has no submission, and goes as abandoned
                self._bucket.remove(key, first=SUBMISSION)
            raise
        self.discard_incoming(record.job_id)

    def spooled_ids(self) -> list[str]:
        """As Store.spooled_ids, of the bucket."""
        names = [each.key.split("/") for each in self._bucket.objects("spool/")]
        return sorted(name[1] for name in names if name[2:] == [SUBMISSION] and is_job_id(name[1]))

    def submission(self, job_id: str) -> JobRecord | None:
        """As Store.submission, from the bucket."""
        with contextlib.suppress(ValidationError):
            content = self._bucket.read(f"spool/{self._checked(job_id)}/{SUBMISSION}")
            return JobRecord.model_validate_json(content) if content is not None else None
        return None

    def fetch_clip(self, job_id: str) -> Path:
        """As Store.fetch_clip: a copy, which is removed with the job's work."""
        folder = self.spool_folder(job_id)
        if not self._copy(folder, f"spool/{job_id}/", SUBMISSION):
            raise UnavailableError(f"The clip of job {job_id} is not there.", "It was purged: send it again.")
        return folder

    def work_folder(self, job_id: str, attempt: int, keep: str | None = None) -> Path:
        """As Store.work_folder; what an attempt on another machine handed over counts as left here."""
        if keep:
            start = f"resume/{self._checked(job_id)}."
            handed = [int(each.key.removeprefix(start).split("/")[0]) for each in self._bucket.objects(start)]
            left = [each for each in self._attempts("work", job_id) if (self._work(job_id, each) / keep).is_file()]
            latest = max((each for each in handed if each < attempt), default=0)
            if latest > max(left, default=0):
                with disk_errors():
                    self._work(job_id, latest).mkdir(mode=0o700, exist_ok=True)
                    self._bucket.get(f"{start}{latest}/{keep}", self._work(job_id, latest) / keep)
        return super().work_folder(job_id, attempt, keep)

    def hand_over(self, job_id: str, attempt: int, keep: str) -> None:
        """As Store.hand_over."""
        if (self._work(job_id, attempt) / keep).is_file():
            self._bucket.put(self._work(job_id, attempt) / keep, f"resume/{job_id}.{attempt}/{keep}")

    def publish_scene(self, job_id: str, attempt: int) -> Path:
        """As Store.publish_scene; the scene is in the bucket before it is here."""
        if self._work(job_id, attempt).is_dir():
            self._bucket.remove(f"scenes/{job_id}.{attempt}/", first=MANIFEST)
            self._put_folder(self._work(job_id, attempt), f"scenes/{job_id}.{attempt}/", last=MANIFEST)
        return super().publish_scene(job_id, attempt)

    def scene_folder(self, job_id: str, attempt: int) -> Path:
        """As Store.scene_folder: a copy, checked against the hashes in its manifest when it was made.

        Raises:
            SceneError: there is none, or what came is not what was published.
        """
        folder = self._folder("scenes", job_id, attempt) if is_job_id(job_id) else None
        if folder is None or not self._copy(folder, f"scenes/{job_id}.{attempt}/", MANIFEST):
            raise SceneError(f"There is no scene {job_id[:40]!r}.")
        return folder

    def has_scene(self, job_id: str, attempt: int) -> bool:
        """As Store.has_scene, of the bucket."""
        return self._is_there(self._folder("scenes", job_id, attempt), f"scenes/{job_id}.{attempt}/{MANIFEST}")

    def scene_attempts(self, job_id: str) -> list[int]:
        """As Store.scene_attempts, of the bucket."""
        start = f"scenes/{self._checked(job_id)}."
        names = [each.key.removeprefix(start).split("/") for each in self._bucket.objects(start)]
        return sorted(int(name[0]) for name in names if name[1:] == [MANIFEST])

    def remove_attempt(self, job_id: str, attempt: int) -> None:
        """As Store.remove_attempt, in the bucket and here."""
        for area in ("scenes", "resume"):
            self._bucket.remove(f"{area}/{self._checked(job_id)}.{attempt}/", first=MANIFEST)
        self._forget(job_id)
        super().remove_attempt(job_id, attempt)

    def remove_other_attempts(self, job_id: str, attempt: int) -> None:
        """As Store.remove_other_attempts, in the bucket and here; the copy of the clip goes too."""
        for number in self.scene_attempts(job_id):
            if number != attempt:
                self._bucket.remove(f"scenes/{job_id}.{number}/", first=MANIFEST)
        self._bucket.remove(f"resume/{self._checked(job_id)}.")
        self._forget(job_id)
        with disk_errors():
            remove_tree(self.spool_folder(job_id))
        super().remove_other_attempts(job_id, attempt)

    def purge(self, job_id: str) -> Removed:
        """As Store.purge, in the bucket and here; other machines' copies are shown no more, and removed in time."""
        files, sizes = {"bucket": 0}, {"bucket": 0}
        name = self._checked(job_id)
        for start, first in ((f"spool/{name}/", SUBMISSION), (f"scenes/{name}.", MANIFEST), (f"resume/{name}.", None)):
            removed = self._bucket.remove(start, first)
            files["bucket"] += removed.files["bucket"]
            sizes["bucket"] += removed.bytes["bucket"]
        self._forget(job_id)
        here = super().purge(job_id)
        return Removed(here.files | files, here.bytes | sizes)

    def tidy(self) -> None:
        """As Store.tidy; also copies that are out of use, or whose original is gone."""
        super().tidy()
        then_s = time.time() - ABANDONED_AFTER_S
        for area, marker in (("spool", SUBMISSION), ("scenes", MANIFEST)):
            with disk_errors():
                copies = list((self.data_dir / area).iterdir())  # first: an original is older than its copy
            stored = self._bucket.objects(f"{area}/")
            whole = {each.key.split("/")[1] for each in stored if each.key.endswith(f"/{marker}")}
            for each in stored:  # of an acceptance, a publication or a purge that was cut off
                if each.key.split("/")[1] not in whole and each.written_at_s < then_s:
                    self._bucket.remove(each.key)
            for copy in copies:
                with disk_errors(), contextlib.suppress(FileNotFoundError):
                    if copy.name not in whole or copy.stat().st_mtime < then_s:
                        remove_tree(copy)

    def _copy(self, folder: Path, key: str, marker: str) -> bool:
        """Have the objects under `key` in the folder; False, and no folder, if they are not in the bucket."""
        with disk_errors():
            if not self._is_there(folder, key + marker):
                remove_tree(folder)
                return False
            if (folder / marker).is_file():
                os.utime(folder)  # in use, for tidy
            else:
                self._get_folder(key, folder, marker)
            return (folder / marker).is_file()

    def _is_there(self, folder: Path, key: str) -> bool:
        """Whether the bucket holds the object by which the folder's original is complete; asked now and then."""
        if time.monotonic() < self._seen_s.get(folder, -LOOKED_FOR_S) + LOOKED_FOR_S:
            return True
        if not self._bucket.holds(key):
            return False
        self._seen_s[folder] = time.monotonic()
        return True

    def _forget(self, job_id: str) -> None:
        """What was there of the job may be gone."""
        for folder in [folder for folder in tuple(self._seen_s) if job_id in folder.name]:
            self._seen_s.pop(folder, None)

    def _get_folder(self, key: str, folder: Path, marker: str) -> None:
        """Bring the objects here aside, check them, and rename them into place."""
        aside = self.open_incoming(new_job_id())
        try:
            for each in self._bucket.objects(key):
                path = aside / each.key.removeprefix(key)
                if not path.resolve().is_relative_to(aside):
                    raise SceneError(f"The bucket holds an object with a name that is none of ours under {key}.")
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                self._bucket.get(each.key, path)
            _check(aside)
            if (aside / marker).is_file() and not (folder / marker).is_file():
                remove_tree(folder)
                aside.rename(folder)
        except OSError:
            if not (folder / marker).is_file():  # else another process was faster
                raise
        finally:
            remove_tree(aside)

    def _put_folder(self, folder: Path, key: str, last: str) -> None:
        """Store the folder's files, the marker of their completeness at the end."""
        for path in sorted((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.name == last):
            self._bucket.put(path, key + path.relative_to(folder).as_posix())

    def _work(self, job_id: str, attempt: int) -> Path:
        return self._folder("work", job_id, attempt)


def _check(folder: Path) -> None:
    """Return if the files are those that the folder's manifest names, or it has none.

    Raises:
        SceneError: one of them is not.
    """
    if not (folder / MANIFEST).is_file():
        return
    try:
        files = json.loads((folder / MANIFEST).read_bytes()).get("files", {})
        for name, expected in files.items():
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != expected["sha256"]:
                raise ValueError(name)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SceneError("The scene in the bucket is damaged: it is not what was published.") from error
