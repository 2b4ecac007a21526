"""A shelf in an S3 bucket, for many machines. The data directory holds copies of what is in use.

    s3://bucket/prefix/
    ├── spool/<job>/        as on disk; submission.json is written last and removed first: without it there is no clip
    ├── scenes/<job>.<n>/   as on disk; manifest.json is likewise written last and removed first
    └── resume/<job>.<n>/   the state from which attempt n can be continued, put there when its worker released the job

The customary AWS_* variables give address and credentials (AWS_ENDPOINT_URL for a server that is not Amazon's). Uploads
in progress stay with the service that receives them. A copy is shown only while its original is there, so a purge on
one machine takes effect on all.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contract.store.local import LocalShelf, remove_tree
from contract.store.shelf import (
    ABANDONED_AFTER_S,
    MARKERS,
    Area,
    Removed,
    ShelfEntry,
    checked,
    entry_of,
    new_job_id,
)
from intrasplat.errors import SceneError, UnavailableError
from intrasplat.files.disk_errors import DISK_FULL_ERRNOS, disk_errors
from intrasplat.names import MANIFEST
from intrasplat.scene.results import listed_files

SEEN_FOR_S = 2.0
"""How long an entry that was found counts as present. A purge on another machine takes effect with this delay."""

FOLDERS = {Area.SPOOL: "spool", Area.KEPT: "resume", Area.SCENES: "scenes"}
"""The areas that a bucket stores, and the prefixes of their keys.

Of KEPT it stores only the marker: a clip is prepared anew in seconds, and its frames are some ten times as large.
"""

CONNECT_TIMEOUT_S = 5
READ_TIMEOUT_S = 60
RETRIES = {"mode": "standard", "total_max_attempts": 2}
"""Few retries here: callers retry themselves, or ask their own caller to."""
LISTING_PAGE = 1000
"""How many objects S3 lists with one call."""

BUCKET_REMEDY = "Check INTRASPLAT_STORE_URL, the AWS_* variables and the bucket itself."


@dataclass(frozen=True)
class Stored:
    """An object of the bucket. The key lacks the prefix."""

    key: str
    written_at_s: float


class Bucket:
    """The calls of S3 that a shelf needs, under one prefix.

    All methods and the constructor raise UnavailableError when the bucket cannot be reached or refuses.
    """

    def __init__(self, url: str) -> None:
        try:
            s3fs = importlib.import_module("s3fs")  # not at the top: an extra, and slow to import
        except ImportError as error:
            remedy = "pip install 'intrasplat-server[s3]'"
            raise UnavailableError("A store in a bucket needs the package s3fs.", remedy) from error
        self._name, _, prefix = url.removeprefix("s3://").strip("/").partition("/")
        self._prefix = f"{prefix}/" if prefix else ""
        calls = {"connect_timeout": CONNECT_TIMEOUT_S, "read_timeout": READ_TIMEOUT_S, "retries": RETRIES}
        self._files: Any = s3fs.S3FileSystem(skip_instance_cache=True, use_listings_cache=False, config_kwargs=calls)
        self._call("head_bucket")  # the bucket exists: from here on, "not found" means an object

    def put(self, path: Path, key: str) -> None:
        """Upload a file; the object appears complete or not at all."""
        with _bucket_errors():
            self._files.put_file(str(path), self._path(key))

    def write(self, key: str, content: bytes) -> None:
        """Write an object of a few bytes."""
        with _bucket_errors():
            self._files.pipe_file(self._path(key), content)

    def get(self, key: str, path: Path) -> None:
        """Download an object."""
        with _bucket_errors():
            self._files.get_file(self._path(key), str(path))

    def read(self, key: str) -> bytes | None:
        """An object's content; None if it does not exist."""
        with _bucket_errors(), contextlib.suppress(FileNotFoundError):
            content: bytes = self._files.cat_file(self._path(key))
            return content
        return None

    def holds(self, key: str) -> bool:
        """Whether the object exists."""
        with _bucket_errors():
            return bool(self._files.exists(self._path(key)))

    def objects(self, start: str) -> list[Stored]:
        """The objects whose keys begin with `start`."""
        found = []
        for page in self._pages("list_objects_v2", {"ContinuationToken": "NextContinuationToken"}, start):
            for each in page.get("Contents", ()):
                key = each["Key"].removeprefix(self._prefix)
                found.append(Stored(key, each["LastModified"].timestamp()))
        return found

    def remove(self, start: str, first: str | None = None) -> Removed:
        """Remove all versions of the objects whose keys begin with `start`; those named `first` go first."""
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
        """The pages of a listing. markers: the next page's arguments, by the values of this page that they take."""
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
    """Raise errors of S3 and of the connection to it as UnavailableError."""
    botocore: Any = importlib.import_module("botocore.exceptions")
    try:
        yield
    except (OSError, botocore.BotoCoreError, botocore.ClientError) as error:
        if isinstance(error, OSError) and error.errno in DISK_FULL_ERRNOS:
            raise  # this machine's disk has no space for the copy
        problem = f"The bucket does not answer ({type(error).__name__})."
        raise UnavailableError(problem, BUCKET_REMEDY, may_return=True) from error


class S3Shelf:
    """A Shelf in a bucket; `here` stores this machine's copies."""

    def __init__(self, here: LocalShelf, url: str) -> None:
        self._here = here
        self._bucket = Bucket(url)
        self._seen_s: dict[ShelfEntry, float] = {}
        """When, on the monotonic clock, an entry was last known to exist."""

    def put(self, folder: Path, entry: ShelfEntry) -> None:
        self._seen_s.pop(entry, None)
        try:
            with disk_errors():
                self._bucket.remove(_key(entry), first=entry.marker)
                for path in _files_to_put(folder, entry):
                    self._bucket.put(path, _key(entry) + path.relative_to(folder).as_posix())
                self._here.put(folder, entry)
        except UnavailableError:
            with contextlib.suppress(UnavailableError):  # the rest has no marker, so tidy() removes it
                self._bucket.remove(_key(entry), first=entry.marker)
            raise

    @disk_errors()
    def put_files(self, entry: ShelfEntry, names: Sequence[str]) -> None:
        for name in names:
            self._bucket.put(self._here.path(entry) / name, _key(entry) + name)
        if all(each.key.rpartition("/")[2] in names for each in self._bucket.objects(_key(entry))):
            self.remove(entry.area, entry.job_id, entry.attempt)  # the rest has been removed, before or meanwhile

    def put_text(self, entry: ShelfEntry, name: str, content: bytes) -> None:
        if not self._bucket.holds(_key(entry) + entry.marker):
            return
        self._bucket.write(_key(entry) + name, content)
        if not self._bucket.holds(_key(entry) + entry.marker):
            self._bucket.remove(_key(entry) + name)  # the rest has been removed meanwhile

    @disk_errors()
    def get(self, entry: ShelfEntry) -> Path | None:
        if not self.holds(entry):
            self._here.remove(entry.area, entry.job_id, entry.attempt)
            return None
        copy = self._here.get(entry)
        if copy is None:
            self._fetch(entry)
            return self._here.get(entry)
        os.utime(copy)  # shows tidy() that the copy is in use
        return copy

    def holds(self, entry: ShelfEntry) -> bool:
        if time.monotonic() < self._seen_s.get(entry, -SEEN_FOR_S) + SEEN_FOR_S:
            return True
        if not self._bucket.holds(_key(entry) + entry.marker):
            return False
        self._seen_s[entry] = time.monotonic()
        return True

    def read_marker(self, entry: ShelfEntry) -> bytes | None:
        return self.read(entry, entry.marker)

    def read(self, entry: ShelfEntry, name: str) -> bytes | None:
        return self._bucket.read(_key(entry) + name)

    def entries(self, area: Area, job_id: str | None = None) -> list[ShelfEntry]:
        start = f"{FOLDERS[area]}/{checked(job_id) if job_id is not None else ''}"
        names = [each.key.split("/") for each in self._bucket.objects(start)]
        found = [entry_of(area, name[1]) for name in names if name[2:] == [MARKERS[area]]]
        return sorted((each for each in found if each), key=lambda entry: (entry.job_id, entry.attempt or 0))

    def remove(self, area: Area, job_id: str, attempt: int | None = None) -> Removed:
        removed = Removed({}, {})
        if area in FOLDERS:
            start = f"{FOLDERS[area]}/{checked(job_id)}" if attempt is None else _key(ShelfEntry(area, job_id, attempt))
            removed = self._bucket.remove(start, first=MARKERS[area])
        for entry in [entry for entry in tuple(self._seen_s) if entry.job_id == job_id]:
            self._seen_s.pop(entry, None)
        return self._here.remove(area, job_id, attempt) + removed

    def drop_copy(self, entry: ShelfEntry) -> None:
        self._here.remove(entry.area, entry.job_id, entry.attempt)

    def tidy(self) -> None:
        self._here.tidy()
        then_s = time.time() - ABANDONED_AFTER_S
        work = [entry for area in (Area.WORK, Area.KEPT) for entry in self._here.folders(area)]  # of accepted jobs
        accepted = {entry.job_id for entry in self.entries(Area.SPOOL)}
        for entry in work:
            if entry.job_id not in accepted:  # it was purged on another machine
                self._here.remove(entry.area, entry.job_id, entry.attempt)
        for area in (Area.SPOOL, Area.SCENES):
            copies = self._here.entries(area)  # before the originals, because an original is older than its copy
            stored = self._bucket.objects(f"{FOLDERS[area]}/")
            whole = {each.key.split("/")[1] for each in stored if each.key.endswith(f"/{MARKERS[area]}")}
            for each in stored:
                if each.key.split("/")[1] not in whole and each.written_at_s < then_s:
                    self._bucket.remove(each.key)  # a put or a removal was interrupted
            for entry in copies:
                with disk_errors(), contextlib.suppress(FileNotFoundError):
                    if entry.name not in whole or self._here.path(entry).stat().st_mtime < then_s:
                        self._here.remove(entry.area, entry.job_id, entry.attempt)

    def _fetch(self, entry: ShelfEntry) -> None:
        """Copy the entry to this machine. Try again if its hashes differ: its scores may just have been added."""
        try:
            self._fetch_once(entry)
        except SceneError:
            self._fetch_once(entry)

    def _fetch_once(self, entry: ShelfEntry) -> None:
        """Copy the entry to a temporary folder, check it, and move it to its path on this machine."""
        temporary = self._here.path(ShelfEntry(Area.INCOMING, new_job_id()))
        temporary.mkdir(mode=0o700)
        try:
            for each in self._bucket.objects(_key(entry)):
                path = temporary / each.key.removeprefix(_key(entry))
                if not path.resolve().is_relative_to(temporary):
                    raise SceneError(f"The bucket holds a foreign object under {_key(entry)}: its name is not ours.")
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                self._bucket.get(each.key, path)
            _check(temporary)
            if (temporary / entry.marker).is_file() and not self._here.holds(entry):
                self._here.put(temporary, entry)
        except UnavailableError:
            if not self._here.holds(entry):  # else another process was faster
                raise
        finally:
            remove_tree(temporary)


def _key(entry: ShelfEntry) -> str:
    """The prefix of the keys of the entry's files."""
    return f"{FOLDERS[entry.area]}/{entry.name}/"


def _files_to_put(folder: Path, entry: ShelfEntry) -> list[Path]:
    """The files of the entry that a bucket stores, the marker last."""
    if entry.area is Area.KEPT:
        return [folder / entry.marker]
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return sorted(files, key=lambda path: path.relative_to(folder) == Path(entry.marker))


def _check(folder: Path) -> None:
    """Compare the files with the hashes in the folder's manifest, if it has one.

    Raises:
        SceneError: a file is missing or differs.
    """
    if not (folder / MANIFEST).is_file():
        return
    try:
        for name, expected in listed_files(json.loads((folder / MANIFEST).read_bytes())).items():
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != expected["sha256"]:
                raise ValueError(name)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SceneError("The scene in the bucket is damaged: it is not what was published.") from error
