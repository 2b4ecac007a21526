"""A scene as one zip file, to move it from one installation to another.

    JOB.scene.zip       stored, not compressed
    ├── manifest.json, scene.safetensors, report.json, curve.csv
    ├── masks.zip, recorded.zip, thumbnail.jpg      if the scene has them; recorded.zip with all recorded frames
    └── archive.json    written last: where it came from; size and SHA-256 of each other file

archive_parts() writes an archive. read_archive() checks one from outside, except the numbers in scene.safetensors: the
worker that imports the scene checks those (intrasplat/scene/imported.py).
"""

from __future__ import annotations

import csv
import hashlib
import math
import re
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, JsonValue, TypeAdapter, ValidationError

from intrasplat.errors import InputError, LimitError, SceneError
from intrasplat.files.zipped import zip_parts
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.nesting import nesting
from intrasplat.intake.zips import UNREADABLE, open_zip
from intrasplat.names import (
    CURVE,
    JOB_ID_PATTERN,
    LABORATORY_PRESETS,
    MANIFEST,
    MASKS,
    RECORDED,
    REPORT,
    SCENE,
    THUMBNAIL,
    PresetName,
)
from intrasplat.report import Report, VersionText
from intrasplat.scene.recorded_file import complete_zip
from intrasplat.version import version

FIELD = "scene"
"""Name of the upload's form field, and the field of the errors."""
ARCHIVE = "archive.json"
NEEDED = (SCENE, REPORT, CURVE, MANIFEST)
NESTED = (MASKS, RECORDED)
"""Zip files of pictures inside the archive."""
TEXTS = (ARCHIVE, MANIFEST, REPORT, CURVE)
MAX_TEXT_BYTES = 8 << 20
"""Limit of a JSON or CSV file. The manifest of a clip of 1,000 frames has half a megabyte, its report less."""
MAX_SCENE_BYTES = 2 << 30
"""Size of the numbers and weights that intrasplat/scene/compact.py allows a scene, stored as floats."""
MAX_NESTING = 32
MAX_CHARACTERS = 4000
"""Limit of one text in a report."""
PIECE_BYTES = 1 << 20
AGAIN = "Export the scene again, with format=scene, and send the file as it is."

Model = TypeVar("Model", bound=BaseModel)


class ArchivedFile(BaseModel):
    """A file of the archive."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bytes: int = Field(ge=0)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class ArchiveHead(BaseModel):
    """archive.json."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: Literal["intrasplat-archive"] = "intrasplat-archive"
    version: Literal[1] = 1
    intrasplat: VersionText
    scene_id: str | None = Field(default=None, pattern=JOB_ID_PATTERN)
    exported_at_s: float = Field(ge=0, le=1e11)
    label: str | None = Field(default=None, exclude_if=lambda label: label is None)
    """What it was called there, unchecked."""
    files: dict[str, ArchivedFile]


def _offered(preset: object) -> object:
    """Return the preset; raise ValueError if only the laboratory trains it."""
    if preset in LABORATORY_PRESETS:
        raise ValueError(f"{preset} is a variant of the laboratory, and services take in no scene of it")
    return preset


class ManifestHead(BaseModel):
    """What the service needs of a scene's manifest; the worker reads all of it."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    format: Literal["intrasplat-scene"]
    version: int
    preset: Annotated[PresetName, BeforeValidator(_offered)]


@dataclass(frozen=True)
class Archived:
    """An archive that has passed the checks."""

    head: ArchiveHead
    manifest: ManifestHead
    report: Report


def archive_parts(folder: Path, scene_id: str | None = None, label: str | None = None) -> Iterator[bytes]:
    """The archive of the scene in a folder, piece by piece. If the scene is removed meanwhile, it is still complete.

    Raises, before the first part:
        SceneError: there is no scene.
    """
    with ExitStack() as opening:
        # Open the manifest first: add_scores(), which may run meanwhile, replaces it last.
        names = (MANIFEST, SCENE, REPORT, CURVE, MASKS, RECORDED, THUMBNAIL)
        found = {name: folder / name for name in names if name in NEEDED or (folder / name).is_file()}
        try:
            files = {
                name: opening.enter_context(complete_zip(folder) if name == RECORDED else path.open("rb"))
                for name, path in found.items()
            }
        except OSError as error:
            raise SceneError(f"The scene cannot be read ({type(error).__name__}).") from error
        head = partial(ArchiveHead, intrasplat=version(), scene_id=scene_id, label=label)
        return _written(files, head, opening.pop_all())


def _written(files: Mapping[str, BinaryIO], head: Callable[..., ArchiveHead], closing: ExitStack) -> Iterator[bytes]:
    listed: dict[str, ArchivedFile] = {}

    def content(name: str, file: BinaryIO) -> Iterator[bytes]:
        digest, size = hashlib.sha256(), 0
        while piece := file.read(PIECE_BYTES):
            digest.update(piece)
            size += len(piece)
            yield piece
        listed[name] = ArchivedFile(bytes=size, sha256=digest.hexdigest())

    def members() -> Iterator[tuple[str, Iterator[bytes]]]:
        for name, file in files.items():
            yield name, content(name, file)
        yield ARCHIVE, iter((head(exported_at_s=time.time(), files=listed).model_dump_json(indent=1).encode(),))

    with closing:
        yield from zip_parts(members())


def read_archive(path: Path, max_bytes: int, into: Path | None = None) -> Archived:
    """Check an archive from outside; with `into`, write its files there while they are read.

    Raises:
        InputError: the file is no archive of a scene, was damaged or changed, or contains a file that does not belong
            there. The field is FIELD.
        LimitError: the archive, or a file in it, is larger than accepted.
    """
    limits = replace(ClipLimits(), decoded_bytes=max_bytes)
    archive, members = open_zip(path, FIELD, path.name, limits, nested=NESTED)
    with archive:
        by_name = {member.filename: member for member in members}
        for name in by_name.keys() - {ARCHIVE, *NEEDED, *NESTED, THUMBNAIL}:
            raise InputError(FIELD, f"{path.name} holds {name[:80]!r}, which is no file of a scene.", AGAIN)
        for name in (ARCHIVE, *NEEDED):
            if name not in by_name:
                raise InputError(FIELD, f"{path.name} has no {name}.", AGAIN)
        for member in members:
            _check_size(member)
        texts = {name: _text(archive, by_name[name]) for name in TEXTS}
        head = _parsed(ArchiveHead, texts[ARCHIVE], ARCHIVE)
        if head.files.keys() != by_name.keys() - {ARCHIVE}:
            raise InputError(FIELD, f"{ARCHIVE} does not list the files that are there.", AGAIN)
        report = _parsed(Report, texts[REPORT], REPORT)
        check_words(REPORT, report.model_dump(mode="json"))
        _check_curve(texts[CURVE])
        manifest = _parsed(ManifestHead, texts[MANIFEST], MANIFEST)
        for name, listed in head.files.items():
            found = _copied(archive, by_name[name], into and into / name)
            if found != listed:
                problem = f"{name} is not what was exported: its hash differs from the one in {ARCHIVE}."
                raise InputError(FIELD, problem, AGAIN)
    return Archived(head, manifest, report)


def _check_size(member: zipfile.ZipInfo) -> None:
    name, size = member.filename, member.file_size
    if member.compress_type != zipfile.ZIP_STORED or size != member.compress_size:
        raise InputError(FIELD, f"{name} is compressed; the files of a scene are stored as they are.", AGAIN)
    limit = MAX_TEXT_BYTES if name in (*TEXTS, THUMBNAIL) else MAX_SCENE_BYTES
    if size > limit:
        raise LimitError(
            FIELD, f"{name} has {size} bytes; the limit is {limit}.", "No scene of this program is so large."
        )


def _text(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> str:
    name = member.filename
    try:
        text = archive.read(member).decode()
    except UnicodeDecodeError:
        raise InputError(FIELD, f"{name} is not UTF-8 text.", AGAIN) from None
    except UNREADABLE as error:
        raise InputError(FIELD, f"{name} is damaged ({type(error).__name__}).", AGAIN) from error
    if (levels := nesting(text)) > MAX_NESTING:
        raise InputError(FIELD, f"{name} is nested {levels} levels deep; the limit is {MAX_NESTING}.", AGAIN)
    return text


def _parsed(model: type[Model], text: str, name: str) -> Model:
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(str(part)[:40] for part in first["loc"])
        remedy = f"{AGAIN} A newer version of intrasplat may have written it: update this one."
        raise InputError(FIELD, f"{name}: {place or 'it'}: {first['msg'][:200]}.", remedy) from error


def check_words(name: str, content: object) -> None:
    """Raise InputError if a text in a file's JSON, which people will see, is too long or has control characters."""
    waiting: list[JsonValue] = [TypeAdapter(JsonValue).validate_python(content)]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict):
            waiting += [*each.keys(), *each.values()]
        elif isinstance(each, list):
            waiting += each
        elif isinstance(each, str) and (
            len(each) > MAX_CHARACTERS or re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", each)
        ):
            problem = f"a text in {name} is longer than {MAX_CHARACTERS} characters or holds control characters."
            raise InputError(FIELD, problem, AGAIN)


def _check_curve(text: str) -> None:
    """Raise InputError unless curve.csv has a line of names, then lines of numbers or empty cells."""
    head, *rows = csv.reader(text.splitlines()) if text.strip() else [[]]
    is_named = bool(head) and all(re.fullmatch(r"[a-z0-9_]{1,40}", name) for name in head)
    if not is_named or any(len(row) != len(head) or not all(map(_is_number, row)) for row in rows):
        raise InputError(FIELD, f"{CURVE} is not a table of finite numbers under a line of names.", AGAIN)


def _is_number(cell: str) -> bool:
    try:
        return cell == "" or math.isfinite(float(cell))
    except ValueError:
        return False


def _copied(archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path | None) -> ArchivedFile:
    """Read a member, write it to `target` if that is given, and return its size and hash."""
    digest, size = hashlib.sha256(), 0
    with ExitStack() as opened:
        writing = target and opened.enter_context(target.open("xb"))
        try:
            source: Any = opened.enter_context(archive.open(member))
            while piece := source.read(PIECE_BYTES):
                digest.update(piece)
                size += len(piece)
                if writing:
                    writing.write(piece)
        except zipfile.BadZipFile as error:
            raise InputError(FIELD, f"{member.filename} is damaged ({error}).", AGAIN) from error
    return ArchivedFile(bytes=size, sha256=digest.hexdigest())
