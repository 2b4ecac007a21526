"""A multipart upload, streamed to disk part by part while it is counted and hashed; never whole in memory."""

from __future__ import annotations

import hashlib
import os
from collections.abc import AsyncIterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.concurrency import run_in_threadpool

from contract.wire.job import JobFiles
from contract.wire.labels import LABEL_FIELD, METADATA_FIELD, Labels, parse_labels
from contract.wire.webhooks import CALLBACK_PART
from intrasplat.errors import InputError, LimitError
from intrasplat.intake.limits import MAX_CALIBRATION_BYTES, MAX_FOV_MASK_BYTES, MAX_POSE_FILE_BYTES
from service.problems import Problem, disk_full_for_upload

CLIP_SUFFIXES = (".mp4", ".mov", ".mkv", ".webm", ".zip")
SUFFIXES = {
    "clip": CLIP_SUFFIXES,
    "left": CLIP_SUFFIXES,
    "right": CLIP_SUFFIXES,
    "calibration": (".json", ".yaml", ".yml", ".xml", ".ini"),
    "masks": CLIP_SUFFIXES,
    "poses_file": (".tum", ".txt", ".csv", ".json"),
    "fov_mask": (".png",),
}
"""File parts and their allowed endings. Only the ending of the caller's file name is stored."""

PARTS = tuple(SUFFIXES)
SCENE_PART = "scene"
SCENE_SUFFIXES = {SCENE_PART: (".zip",)}

OPTIONS = "options"
CLIP_OF = "clip_of"
TEXTS = (OPTIONS, CLIP_OF, LABEL_FIELD, METADATA_FIELD, CALLBACK_PART)
"""Parts that are text."""
MAX_OPTIONS_BYTES = 64 * 1024
MAX_BYTES = {
    OPTIONS: MAX_OPTIONS_BYTES,
    CLIP_OF: 256,
    LABEL_FIELD: 4096,
    CALLBACK_PART: 4096,
    METADATA_FIELD: MAX_OPTIONS_BYTES,
    "calibration": MAX_CALIBRATION_BYTES,
    "poses_file": MAX_POSE_FILE_BYTES,
    "fov_mask": MAX_FOV_MASK_BYTES,
}
"""Maximum bytes of the small parts."""
LIMIT_REMEDY = "Send a shorter clip, or raise INTRASPLAT_MAX_UPLOAD_BYTES."
MAX_HEADER_BYTES = 8 * 1024
FORM_REMEDY = (
    "Send multipart/form-data with clip, or left and right, or clip_of, and optionally calibration, masks, poses_file, "
    "fov_mask, options, label, metadata and callback_url; "
    'options is JSON, such as {"budget_s": 20}, and clip_of the id of a job whose clip is used again.'
)


@dataclass(frozen=True)
class Form:
    """A multipart form: file parts with their allowed endings, text parts, and how to send it."""

    suffixes: Mapping[str, tuple[str, ...]]
    texts: tuple[str, ...]
    remedy: str

    @property
    def main_part(self) -> str:
        """The name of the main part."""
        return next(iter(self.suffixes))


CLIP_FORM = Form(SUFFIXES, TEXTS, FORM_REMEDY)
SCENE_FORM = Form(
    SCENE_SUFFIXES,
    (OPTIONS, LABEL_FIELD, METADATA_FIELD, CALLBACK_PART),
    "Send multipart/form-data with scene, a file of format=scene, and optionally options, label, metadata and "
    "callback_url.",
)

CALIBRATION_PART = "calibration"
FEED_FORM = Form(
    {CALIBRATION_PART: tuple(each for each in SUFFIXES[CALIBRATION_PART] if each != ".xml")},
    (OPTIONS,),
    "Send multipart/form-data with calibration, and options, JSON such as "
    '{"source": "rtsp://camera.example.org/1", "keep_s": 300}.',
)


@dataclass(frozen=True)
class UploadLimits:
    """Limits of an upload: total bytes, and bytes until the disk has less than min_free_bytes left."""

    upload_bytes: int
    available_bytes: int
    min_free_bytes: int


@dataclass
class Received:
    """The received parts: stored names and digests by part, options as text, labels, the job whose clip is used again,
    and the webhook's URL."""

    names: dict[str, str] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    options: str = "{}"
    clip_of: str | None = None
    callback_url: str | None = None
    labels: Labels = field(default_factory=Labels)
    total_bytes: int = 0

    def check_clip(self) -> None:
        """Return if there is one clip.

        Raises:
            InputError: there is none, or it is given in several ways, or one eye is missing.
        """
        given = set(self.names)
        if self.clip_of is not None:
            if came := [part for part in ("clip", "left", "right") if part in given]:
                problem = f"it came together with {' and '.join(came)}."
                raise InputError(
                    CLIP_OF, problem, "Send either a clip, or clip_of to use that of an earlier job again."
                )
            return
        if "clip" in given and given & {"left", "right"}:
            raise InputError("clip", "it came together with left or right.", "Send either clip, or left and right.")
        if "clip" not in given:
            for eye, other in (("left", "right"), ("right", "left")):
                if eye not in given:
                    problem = f"there is {other} but no {eye}." if other in given else "there is no clip."
                    raise InputError(eye if other in given else "clip", problem, FORM_REMEDY)

    def files(self) -> JobFiles:
        """The stored names of the parts, once all files have arrived."""
        return JobFiles(
            clip=self.names.get("clip") or self.names["left"],
            right=self.names.get("right"),
            calibration=self.names.get("calibration"),
            masks=self.names.get("masks"),
            poses_file=self.names.get("poses_file"),
            fov_mask=self.names.get("fov_mask"),
        )

    def sha256(self) -> str:
        """The digest of the only file, or of one line `part digest` per file, sorted by part."""
        if len(self.digests) == 1:
            return next(iter(self.digests.values()))
        lines = "".join(f"{part} {digest}\n" for part, digest in sorted(self.digests.items()))
        return hashlib.sha256(lines.encode()).hexdigest()


def checked_suffix(part: str, suffix: str, suffixes: Mapping[str, tuple[str, ...]] = SUFFIXES) -> str:
    """The ending of a part's file in lower case.

    Raises:
        InputError: this part may not have it.
    """
    if suffix.lower() not in suffixes[part]:
        accepted = ", ".join(suffixes[part])
        raise InputError(part, f"a file that ends in {suffix[:20]!r} is not accepted.", f"Send {accepted}.")
    return suffix.lower()


def check_part_size(part: str, part_bytes: int) -> None:
    """Raise LimitError if a part has more bytes than its kind may have."""
    if part_bytes > MAX_BYTES.get(part, part_bytes):
        raise LimitError(part, f"it is larger than {MAX_BYTES[part]} bytes.", "Send a smaller one.")


async def receive_upload(
    content_type: str, body: AsyncIterator[bytes], folder: Path, limits: UploadLimits, form: Form = CLIP_FORM
) -> Received:
    """Write the parts of a multipart body into folder.

    Raises:
        Problem: 400: the body is not a valid multipart form. 507: the disk has no space for it.
        InputError: an unknown, repeated or empty part, or an ending that is not accepted.
        LimitError: more than limits.upload_bytes, counted as they arrive.
    """
    kind, parameters = parse_options_header(content_type)
    if kind != b"multipart/form-data" or not parameters.get(b"boundary"):
        raise Problem(400, f"The content type is {content_type[:80]!r}.", field="Content-Type", remedy=form.remedy)
    try:
        with closing(_Receiver(parameters[b"boundary"], folder, limits, form)) as receiver:
            async for chunk in body:
                await run_in_threadpool(receiver.write, chunk)
            return receiver.finish()
    except FormParserError as error:
        raise Problem(400, f"The multipart body is malformed: {error}", field="body", remedy=form.remedy) from error


class _Receiver:
    """The parser's callbacks, and the part that is being received."""

    def __init__(self, boundary: bytes, folder: Path, limits: UploadLimits, form: Form) -> None:
        self._form = form
        self._folder = folder
        self._limits = limits
        self._received = Received()
        self._ended = False
        self._header_name = b""
        self._header_value = b""
        self._headers: dict[bytes, bytes] = {}
        self._part = ""
        self._part_bytes = 0
        self._file: BinaryIO | None = None
        self._digest = hashlib.sha256()
        self._texts: dict[str, bytes] = {}
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._on_part_begin,
                "on_header_field": self._on_header_field,
                "on_header_value": self._on_header_value,
                "on_header_end": self._on_header_end,
                "on_headers_finished": self._on_headers_finished,
                "on_part_data": self._on_part_data,
                "on_part_end": self._on_part_end,
                "on_end": self._on_end,
            },
        )

    def write(self, chunk: bytes) -> None:
        """Parse the next piece of the body."""
        self._received.total_bytes += len(chunk)
        if self._received.total_bytes > self._limits.upload_bytes:
            problem = f"the upload is larger than {self._limits.upload_bytes} bytes."
            raise LimitError(self._form.main_part, problem, LIMIT_REMEDY)
        if self._received.total_bytes > self._limits.available_bytes:
            limits = self._limits
            raise disk_full_for_upload(self._received.total_bytes, limits.available_bytes, limits.min_free_bytes)
        self._parser.write(chunk)

    def finish(self) -> Received:
        """The received parts, once the body is complete."""
        self._parser.finalize()
        if not self._ended:
            detail = "The body ended before its last boundary."
            raise Problem(400, detail, field="body", remedy="Send the upload again.")
        texts = {name: self._text(name) for name in self._texts}
        self._received.options = texts.get(OPTIONS, self._received.options)
        self._received.clip_of = texts.get(CLIP_OF)
        self._received.callback_url = texts.get(CALLBACK_PART)
        self._received.labels = parse_labels(texts.get(LABEL_FIELD), texts.get(METADATA_FIELD))
        return self._received

    def close(self) -> None:
        """Close a file that was cut off."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _on_part_begin(self) -> None:
        self._headers = {}
        self._part_bytes = 0

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]
        self._check_header()

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]
        self._check_header()

    def _on_header_end(self) -> None:
        self._headers[self._header_name.lower()] = self._header_value
        self._header_name = self._header_value = b""

    def _check_header(self) -> None:
        if len(self._header_name) + len(self._header_value) > MAX_HEADER_BYTES:
            raise Problem(400, "A part's header is too long.", field="body", remedy=self._form.remedy)

    def _on_headers_finished(self) -> None:
        _, parameters = parse_options_header(self._headers.get(b"content-disposition", b""))
        part = parameters.get(b"name", b"").decode("utf-8", "replace")
        if part not in (*self._form.texts, *self._form.suffixes):
            raise InputError(part[:40] or "clip", "there is no such part.", self._form.remedy)
        if part in self._received.names or part in self._texts:
            raise InputError(part, "it came twice.", "Send each part once.")
        self._part = part
        if part in self._form.texts:
            self._texts[part] = b""
        else:
            self._open_file(part, parameters.get(b"filename", b"").decode("utf-8", "replace"))

    def _open_file(self, part: str, filename: str) -> None:
        name = part + checked_suffix(part, PurePosixPath(filename).suffix, self._form.suffixes)
        self._file = (self._folder / name).open("xb")
        self._digest = hashlib.sha256()
        self._received.names[part] = name

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self._part_bytes += end - start
        check_part_size(self._part, self._part_bytes)
        piece = data[start:end]
        if self._file is None:
            self._texts[self._part] += piece
        else:
            self._file.write(piece)
            self._digest.update(piece)

    def _on_part_end(self) -> None:
        if self._file is None:
            self._text(self._part)
            return
        if self._part_bytes == 0:
            raise InputError(self._part, "the file is empty.", "Send a file with content.")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.close()
        self._received.digests[self._part] = self._digest.hexdigest()

    def _text(self, part: str) -> str:
        try:
            return self._texts[part].decode()
        except UnicodeDecodeError:
            raise InputError(part, "it is not UTF-8 text.", self._form.remedy) from None

    def _on_end(self) -> None:
        self._ended = True
