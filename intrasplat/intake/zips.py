"""Opens untrusted zips, after a check of their directory before any member is inflated.

Members are refused that could escape the archive (absolute paths, "..", links), hide their content (encryption, nested
archives, duplicates, overlaps), or exceed the limits. The service checks a zip at upload, the library once more.
"""

from __future__ import annotations

import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from intrasplat.errors import InputError, LimitError
from intrasplat.intake.limits import ClipLimits

ARCHIVE_SUFFIXES = frozenset({".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst", ".7z", ".rar", ".jar"})
MAX_MEMBERS = 20_000  # images, depth, masks and right frames of 1000 frames are 4000
MAX_DIRECTORY_BYTES = 16 << 20  # each member has a record of 46 bytes and a path
MAX_RATIO = 200  # inflated to compressed: about 1 for pictures, 10 for text, 1000 for zeros
MAX_BYTES_OF_ANY_RATIO = 1 << 20  # smaller members may have any ratio

UNREADABLE = (OSError, EOFError, NotImplementedError, RuntimeError, ValueError, zipfile.BadZipFile, zlib.error)
"""Exceptions of zipfile for a damaged member; ValueError is for a name that is not UTF-8."""

_END = struct.Struct("<4s4H2LH")  # end of central directory (APPNOTE 4.3.16)
_END_64 = struct.Struct("<4sQ2H2L4Q")  # (4.3.14)
_LOCATOR_64 = struct.Struct("<4sLQL")  # (4.3.15)
_MAX_COMMENT_BYTES = 1 << 16
_LOCAL_HEADER_BYTES = 30
_AGAIN = "Zip the files again."


def open_zip(
    path: Path, field: str, label: str, limits: ClipLimits, nested: Collection[str] = ()
) -> tuple[zipfile.ZipFile, list[zipfile.ZipInfo]]:
    """The zip, open for reading, and its files without folders. nested: names of members that may be archives.

    Raises:
        InputError: it is damaged, or a member is refused. The error names `field` and `label`.
        LimitError: it has too many members, or their inflated size is too large.
    """
    try:
        _check_directory(path, field, label)
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, struct.error) as error:
        raise InputError(field, f"{label} is not a readable zip ({error}).", _AGAIN) from error
    try:
        return archive, _checked(archive.infolist(), path, field, label, limits, nested)
    except BaseException:
        archive.close()
        raise


def _checked(
    entries: list[zipfile.ZipInfo],
    path: Path,
    field: str,
    label: str,
    limits: ClipLimits,
    nested: Collection[str],
) -> list[zipfile.ZipInfo]:
    check_member_count(len(entries), field, label)
    names: set[str] = set()
    for entry in entries:
        _check_member(entry, field, label, nested)
        known = entry.filename.lower()  # names that differ only in case are one file on some systems
        if known in names:
            raise InputError(field, f"{label} holds {entry.filename!r} twice.", _AGAIN)
        names.add(known)
    _check_overlap(entries, path, field, label)
    files = [entry for entry in entries if not entry.is_dir()]
    _check_inflated(files, field, label, limits)
    return files


def check_member_count(count: int, field: str, label: str) -> None:
    """LimitError for more members of a zip, or files of a folder, than MAX_MEMBERS."""
    if count > MAX_MEMBERS:
        problem = f"{label} holds {count} files or more; the limit is {MAX_MEMBERS}."
        raise LimitError(field, problem, "Keep the clip's own.")


def _check_directory(path: Path, field: str, label: str) -> None:
    """LimitError for a directory that is too large; zipfile would read all of it into memory."""
    with path.open("rb") as file:
        size, count = _directory_size(file, path.stat().st_size)
    check_member_count(count, field, label)
    if size > MAX_DIRECTORY_BYTES:
        problem = f"the directory of {label} has {size} bytes; the limit is {MAX_DIRECTORY_BYTES}."
        raise LimitError(field, problem, "Keep the clip's own files, with short names.")


def _directory_size(file: BinaryIO, file_bytes: int) -> tuple[int, int]:
    """(bytes, members) of the central directory, found by the same rules as in zipfile."""
    tail_bytes = min(file_bytes, _END.size + _MAX_COMMENT_BYTES)
    file.seek(file_bytes - tail_bytes)
    tail = file.read(tail_bytes)
    at = len(tail) - _END.size
    if at < 0 or not (tail[at : at + 4] == b"PK\5\6" and tail.endswith(b"\0\0")):
        at = tail.rfind(b"PK\5\6")
    if at < 0:
        raise zipfile.BadZipFile("it has no directory")
    count, size = _END.unpack_from(tail, at)[4:6]
    locator_at = file_bytes - tail_bytes + at - _LOCATOR_64.size
    if locator_at < _END_64.size:
        return size, count
    file.seek(locator_at - _END_64.size)
    end_64, locator = _END_64.unpack(file.read(_END_64.size)), file.read(4)
    return (end_64[8], end_64[7]) if locator == b"PK\6\7" else (size, count)


def _check_member(entry: zipfile.ZipInfo, field: str, label: str, nested: Collection[str]) -> None:
    """InputError for a member that could escape the archive or hide its content.

    Programs of Windows write backslashes between folders; they become slashes here, before the checks.
    """
    name = entry.filename = entry.filename.replace("\\", "/")
    problem = None
    kind = stat.S_IFMT(entry.external_attr >> 16)
    # zipfile truncates names at NUL, so the stored name is checked, too
    if any(ord(letter) < 32 for letter in entry.orig_filename):
        problem = "has a name with a control character"
    elif name.startswith("/") or re.match(r"[A-Za-z]:", name):
        problem = "has an absolute path"
    elif ".." in name.split("/"):
        problem = 'has ".." in its path'
    elif kind == stat.S_IFLNK:
        problem = "is a symbolic link"
    elif kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        problem = "is not a plain file"
    elif entry.flag_bits & 0x1:
        problem = "is encrypted"
    elif PurePosixPath(name).suffix.lower() in ARCHIVE_SUFFIXES and name not in nested:
        problem = "is an archive inside the archive"
    if problem is not None:
        raise InputError(field, f"{name!r} in {label} {problem}.", "Zip plain files only, without links or passwords.")


def _check_inflated(entries: list[zipfile.ZipInfo], field: str, label: str, limits: ClipLimits) -> None:
    """LimitError if the declared sizes are too large. zipfile reads no more of a member than it declares."""
    total = sum(entry.file_size for entry in entries)
    if total > limits.decoded_bytes:
        problem = f"{label} inflates to {total} bytes; the limit is {limits.decoded_bytes}."
        raise LimitError(field, problem, "Give a shorter clip.")
    for entry in entries:
        if entry.file_size > MAX_BYTES_OF_ANY_RATIO and entry.file_size > MAX_RATIO * entry.compress_size:
            problem = f"{entry.filename!r} in {label} inflates from {entry.compress_size} to {entry.file_size} bytes."
            raise LimitError(field, problem, f"Zip pictures and text only, which shrink less than {MAX_RATIO} times.")


def _check_overlap(entries: list[zipfile.ZipInfo], path: Path, field: str, label: str) -> None:
    """InputError if members share compressed bytes: a small file could then inflate to any size."""
    ordered = sorted(entries, key=lambda entry: entry.header_offset)
    ends = [entry.header_offset + _LOCAL_HEADER_BYTES + entry.compress_size for entry in ordered]
    starts = [entry.header_offset for entry in ordered] + [path.stat().st_size]
    if any(end > start for end, start in zip(ends, starts[1:], strict=True)):
        raise InputError(field, f"members of {label} overlap.", _AGAIN)
