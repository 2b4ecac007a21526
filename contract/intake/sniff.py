"""A first look at files from outside, without any decoder: what cannot be a clip is refused where it arrives.

Everything here reads a few bytes by rules of its own. What passes is still read by a process that has nothing else.
"""

from __future__ import annotations

import zipfile
from pathlib import Path, PurePosixPath

from contract.intake.limits import MAX_CALIBRATION_BYTES, ClipLimits
from contract.intake.video_header import EBML, check_video, is_video
from contract.intake.zips import UNREADABLE, open_zip
from contract.wire.errors import InputError, LimitError

ZIP_SUFFIX = ".zip"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
_NPY_MAGIC = b"\x93NUMPY"
_MATROSKA_SUFFIXES = frozenset({".mkv", ".webm"})
_IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
_HEAD_BYTES = 32  # holds a PNG's size
_NPY_HEAD_BYTES = 4096  # NumPy writes 128; larger headers are only good for attacks on what parses them
_PLAIN_TEXT_REMEDY = "Give numbers only: our JSON, OpenCV YAML or XML, or StereoMIS ini."
_ACTIVE_TEXT = {"<!entity": "declares XML entities", "<!doctype": "has an XML document type", "!!python": "names code"}


def check_file(path: Path, part: str, limits: ClipLimits) -> None:
    """Look at one part of an upload; its name's ending is what the sender says it is.

    Raises:
        InputError: it is something else, damaged, or holds what no clip needs; its field is the part.
        LimitError: it says of itself that it is larger than accepted.
    """
    if path.stat().st_size == 0:
        raise InputError(part, f"{path.name} is empty (0 bytes).", "Send the file again.")
    if part == "calibration":
        check_calibration_text(_text_of(path, part), part, path.name)
    elif path.suffix.lower() == ZIP_SUFFIX:
        _check_zip(path, part, limits)
    else:
        _check_ending(path, part)
        check_video(path, part, path.name, limits)


def png_size(head: bytes) -> tuple[int, int] | None:
    """(width, height) that a PNG's first 24 bytes tell; None when it is no PNG."""
    if not head.startswith(PNG_MAGIC) or len(head) < 24:
        return None
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def check_calibration_text(text: str, field: str, label: str) -> None:
    """InputError for text that wants more of its reader than to be read: entities, document types, code."""
    small = text.lower()
    for sign, problem in _ACTIVE_TEXT.items():
        if sign in small:
            raise InputError(field, f"{label} {problem}.", _PLAIN_TEXT_REMEDY)


def _text_of(path: Path, part: str) -> str:
    size = path.stat().st_size
    if size > MAX_CALIBRATION_BYTES:
        problem = f"{path.name} has {size} bytes; the limit is {MAX_CALIBRATION_BYTES}."
        raise LimitError(part, problem, _PLAIN_TEXT_REMEDY)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise InputError(part, f"{path.name} is not a text file.", _PLAIN_TEXT_REMEDY)
    return text


def _check_ending(path: Path, part: str) -> None:
    """InputError when a file of one kind bears the ending of another."""
    with path.open("rb") as file:
        head = file.read(12)
    found = "a zip" if head.startswith(b"PK") else "a Matroska or WebM file" if head.startswith(EBML) else None
    if found is None and is_video(head):
        found = "an mp4 or mov file"
    wanted = "a Matroska or WebM file" if path.suffix.lower() in _MATROSKA_SUFFIXES else "an mp4 or mov file"
    if found is not None and found != wanted:
        raise InputError(part, f"{path.name} is {found}.", "Give the file the ending of what it is.")


def _check_zip(path: Path, part: str, limits: ClipLimits) -> None:
    """Every member by its name, its sizes, and its first bytes."""
    if not zipfile.is_zipfile(path):
        raise InputError(part, f"{path.name} is not a zip, or was cut short.", "Zip the files again.")
    archive, members = open_zip(path, part, path.name, limits)
    with archive:
        for member in members:
            suffix = PurePosixPath(member.filename).suffix.lower()
            if suffix in _IMAGE_SUFFIXES:
                _check_image(_head(archive, member, part, _HEAD_BYTES), member.filename, part, limits)
            elif suffix == ".npy":
                _check_npy(_head(archive, member, part, _NPY_HEAD_BYTES), member.filename, part)


def _head(archive: zipfile.ZipFile, member: zipfile.ZipInfo, part: str, size: int) -> bytes:
    try:
        with archive.open(member) as stream:
            return stream.read(size)
    except UNREADABLE as error:
        raise InputError(part, f"{member.filename} cannot be read ({error}).", "Zip the files again.") from error


def _check_image(head: bytes, name: str, part: str, limits: ClipLimits) -> None:
    if _is_litter(name):
        return
    size = png_size(head)
    if size is not None:
        limits.check_frame(part, name, *size)
    elif not head.startswith(JPEG_MAGIC):
        raise InputError(part, f"{name} is not a PNG or JPEG image.", "Write the image again, as PNG.")


def _is_litter(name: str) -> bool:
    """Whether file managers left it; the worker leaves such files out."""
    return "__MACOSX" in name or PurePosixPath(name).name.startswith(".")


def _check_npy(head: bytes, name: str, part: str) -> None:
    """InputError for an array of pickled objects, which run code when they are loaded, or with an odd header."""
    if _is_litter(name):
        return
    header_bytes = int.from_bytes(head[8:10] if head[6:7] == b"\1" else head[8:12], "little")
    remedy = "Save it with numpy.save as floating-point numbers."
    if not head.startswith(_NPY_MAGIC) or header_bytes + 12 > _NPY_HEAD_BYTES:
        raise InputError(part, f"{name} is not an array as NumPy writes it.", remedy)
    if b"O" in head[12 : 12 + header_bytes]:
        raise InputError(part, f"{name} holds Python objects.", remedy)
