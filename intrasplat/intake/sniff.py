"""First check of uploaded files without a decoder: files that cannot be a clip are refused on arrival.

It reads only a few bytes. Files that pass are decoded in a confined process (intrasplat/decode/).
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path, PurePosixPath

from intrasplat.errors import InputError, LimitError
from intrasplat.intake.calibration.encoding import decoded_text, named_errors
from intrasplat.intake.calibration.opencv import look_at_calibration
from intrasplat.intake.limits import MAX_CALIBRATION_BYTES, ClipLimits
from intrasplat.intake.nesting import nesting
from intrasplat.intake.video_header import EBML, check_is_video, check_video, is_video
from intrasplat.intake.zips import UNREADABLE, open_zip

ZIP_SUFFIX = ".zip"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
_NPY_MAGIC = b"\x93NUMPY"
_MATROSKA_SUFFIXES = frozenset({".mkv", ".webm"})
_IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
_HEAD_BYTES = 32  # contains a PNG's size
_NPY_HEAD_BYTES = 4096  # NumPy writes 128; larger headers may attack their parser
MAX_NESTING = 64  # of a calibration; valid ones have four levels
_PLAIN_TEXT_REMEDY = "Give numbers only: our JSON, OpenCV YAML or XML, or StereoMIS ini."
_ACTIVE_TEXT = {"<!entity": "declares XML entities", "<!doctype": "has an XML document type", "!!python": "names code"}

_NOT_FINITE = re.compile(r"(?:nan|inf(?:inity)?)(?![\w\"'.=:-])")
_BEFORE_A_NUMBER = re.compile(r"(?<![\w\"'./-])[-+]?\.?\Z")
_COMMENT = re.compile(r"[#;].*|<!--(?:(?!<!--).)*?-->")
"""A comment starts at the last of several starts: a search for the end from each start would take quadratic time."""


def check_file(path: Path, part: str, limits: ClipLimits) -> None:
    """Check one part of an upload. The suffix of its name declares its kind.

    Raises:
        InputError: it is of another kind, damaged, or contains files that no clip needs; its field is the part.
        LimitError: its header declares more than the limits.
    """
    if path.stat().st_size == 0:
        raise InputError(part, f"{path.name} is empty (0 bytes).", "Send the file again.")
    if part == "calibration":
        text = _text_of(path, part)
        check_calibration_file(text, part, path.name)
        with named_errors(path.name):
            look_at_calibration(text)
    elif part == "poses_file":
        if decoded_text(path.read_bytes()) is None:
            raise InputError(part, f"{path.name} is not a text file.", "Send poses as TUM, JSON or text.")
    elif part == "fov_mask":
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
        check_field_head(head, part, path.name)
        _check_image(head, path.name, part, limits)
    elif path.suffix.lower() == ZIP_SUFFIX:
        _check_zip(path, part, limits)
    else:
        with path.open("rb") as file:
            check_head(file.read(_HEAD_BYTES), path.suffix, part, path.name)
        check_video(path, part, path.name, limits)


def png_size(head: bytes) -> tuple[int, int] | None:
    """(width, height) in a PNG's first 24 bytes; None if it is no PNG."""
    if not head.startswith(PNG_MAGIC) or len(head) < 24:
        return None
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def png_bits(head: bytes) -> int | None:
    """Bits of a colour in a PNG's first 25 bytes; None if it is no PNG."""
    return head[24] if head.startswith(PNG_MAGIC) and len(head) > 24 else None


def check_calibration_text(text: str, field: str, label: str) -> None:
    """InputError for text with active content (XML entities, document types, code), or nested too deep for a parser."""
    small = text.lower()
    for sign, problem in _ACTIVE_TEXT.items():
        if sign in small:
            raise InputError(field, f"{label} {problem}.", _PLAIN_TEXT_REMEDY)
    levels = nesting(text)
    if levels > MAX_NESTING:
        problem = f"{label} is nested {levels} levels deep; the limit is {MAX_NESTING}."
        raise InputError(field, problem, _PLAIN_TEXT_REMEDY)


def check_calibration_file(text: str, field: str, label: str) -> None:
    """InputError for data that is no text, text that check_calibration_text() refuses, and non-finite numbers."""
    if "\0" in text:
        raise InputError(field, f"{label} is not a text file.", _PLAIN_TEXT_REMEDY)
    check_calibration_text(text, field, label)
    _check_numbers(text, field, label)


def _check_numbers(text: str, field: str, label: str) -> None:
    """InputError for NaN or an infinite number, as failed calibrations contain.

    A pattern search blocks other threads, so a plain search for the letters comes first.
    """
    small = text.lower()
    if "nan" not in small and "inf" not in small:
        return
    small = _COMMENT.sub("", "\n".join(small.splitlines()))
    for found in _NOT_FINITE.finditer(small):
        if (sign := _BEFORE_A_NUMBER.search(small, max(0, found.start() - 3), found.start())) is None:
            continue
        line = small.count("\n", 0, found.start()) + 1
        problem = f"{label} holds {sign.group()}{found.group()}, which is not a finite number, in line {line}."
        raise InputError(field, problem, "Calibrate again, or give the calibration of this recording.")


def _text_of(path: Path, part: str) -> str:
    size = path.stat().st_size
    if size > MAX_CALIBRATION_BYTES:
        problem = f"{path.name} has {size} bytes; the limit is {MAX_CALIBRATION_BYTES}."
        raise LimitError(part, problem, _PLAIN_TEXT_REMEDY)
    return decoded_text(path.read_bytes()) or "\0"


def check_head(head: bytes, suffix: str, part: str, label: str) -> None:
    """InputError if a file is no video, or if its first bytes contradict its suffix.

    head: the first 12 bytes or more.
    """
    found = "a zip" if head.startswith(b"PK") else "a Matroska or WebM file" if head.startswith(EBML) else None
    if found is None and is_video(head):
        found = "an mp4 or mov file"
    wanted = "a Matroska or WebM file" if suffix.lower() in _MATROSKA_SUFFIXES else "an mp4 or mov file"
    if found is not None and found != wanted:
        raise InputError(part, f"{label} is {found}.", "Give the file the ending of what it is.")
    check_is_video(head, part, label)


def check_field_head(head: bytes, part: str, label: str) -> None:
    """InputError if the first bytes of a field of view are not those of a PNG: JPEG blurs the border into the black.

    head: the first 8 bytes or more.
    """
    if not head.startswith(PNG_MAGIC):
        raise InputError(part, f"{label} is not a PNG image.", "Write it as PNG, white inside and black outside.")


def _check_zip(path: Path, part: str, limits: ClipLimits) -> None:
    """Check every member by its name, its sizes and its first bytes."""
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
    if _is_system_file(name):
        return
    size = png_size(head)
    if size is not None:
        limits.check_frame(part, name, *size)
    elif not head.startswith(JPEG_MAGIC):
        raise InputError(part, f"{name} is not a PNG or JPEG image.", "Write the image again, as PNG.")


def _is_system_file(name: str) -> bool:
    """Whether it is a file manager's own file, which clips ignore."""
    return "__MACOSX" in name or PurePosixPath(name).name.startswith(".")


def _check_npy(head: bytes, name: str, part: str) -> None:
    """InputError for an array with an unusual header or of pickled objects, which run code on loading."""
    if _is_system_file(name):
        return
    header_bytes = int.from_bytes(head[8:10] if head[6:7] == b"\1" else head[8:12], "little")
    remedy = "Save it with numpy.save as floating-point numbers."
    if not head.startswith(_NPY_MAGIC) or header_bytes + 12 > _NPY_HEAD_BYTES:
        raise InputError(part, f"{name} is not an array as NumPy writes it.", remedy)
    if b"O" in head[12 : 12 + header_bytes]:
        raise InputError(part, f"{name} holds Python objects.", remedy)
