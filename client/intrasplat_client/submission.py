"""Sends a clip: small files in one form, large ones in pieces that survive a lost connection (tus 1.0.0, tus.io).

The service learns only the endings of file names, because a name may identify a patient.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import json
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from pydantic import TypeAdapter, ValidationError

from intrasplat_client.connection import Body, Call
from intrasplat_client.errors import InputError, IntrasplatError, NotFound, ServiceUnavailable, Unreachable
from intrasplat_client.models import EXCLUSIVE_OPTIONS, GivenOptions, JobView
from intrasplat_client.session import Patience, Session, error_of, parsed

IN_PIECES_FROM_BYTES = 64 * 2**20
"""Uploads of this size are resumable. Losing a smaller one costs only seconds."""
PIECE_BYTES = 32 * 2**20
"""The size of one request: small enough for proxies, and the most that a lost connection can cost."""
READ_BYTES = 2**18

TUS = {"Tus-Resumable": "1.0.0"}
TUS_CONTENT_TYPE = "application/offset+octet-stream"

RESUME_AFTER = frozenset({httpx.codes.REQUEST_TIMEOUT, httpx.codes.CONFLICT, httpx.codes.LOCKED})
"""Statuses after which an upload resumes: it stalled, the offset differs, or the lost connection is still open."""

OnUpload = Callable[[int, int], object]
"""Called with the bytes sent and the total. After a lost connection the bytes sent can decrease."""


@dataclass(frozen=True)
class Submission:
    """A clip that is ready to send: files and their sizes by part, options and labels as JSON values.

    texts: parts that are sent as text: clip_of, if there is no clip file, and callback_url.
    """

    paths: dict[str, Path]
    sizes: dict[str, int]
    texts: dict[str, str]
    options: dict[str, Any]
    labels: dict[str, Any]
    idempotency_key: str
    in_pieces: bool
    on_upload: OnUpload | None
    route: str = "/reconstruct"

    @property
    def total_bytes(self) -> int:
        """The size of all files."""
        return sum(self.sizes.values())

    def report(self, sent_bytes: int) -> None:
        """Call on_upload."""
        if self.on_upload is not None and self.total_bytes:
            self.on_upload(min(sent_bytes, self.total_bytes), self.total_bytes)


def prepare(
    clip: Path | None,
    right: Path | None,
    texts: dict[str, str],
    others: Mapping[str, Path | None],
    options: Mapping[str, Any],
    labels: dict[str, Any],
    *,
    idempotency_key: str | None,
    in_pieces: bool | None,
    on_upload: OnUpload | None,
) -> Submission:
    """Check everything before anything is sent.

    Raises:
        InputError: a file cannot be read or is empty, there is not one clip, or an option cannot be used.
    """
    document, clip_of = checked_options(options), texts.get("clip_of")
    if clip_of is None and clip is None:
        raise InputError("clip", "there is no clip.", "Give its file, or clip_of, the job whose clip is used again.")
    if clip_of is not None and (clip is not None or right is not None):
        raise InputError("clip_of", "it came together with a clip.", "Give either of them.")
    given = {"clip": clip} if right is None else {"left": clip, "right": right}
    paths = {part: Path(path) for part, path in {**given, **others}.items() if path is not None}
    sizes = {part: _size_of(part, path) for part, path in paths.items()}
    if in_pieces is None:
        in_pieces = sum(sizes.values()) >= IN_PIECES_FROM_BYTES
    return Submission(paths, sizes, texts, document, labels, idempotency_key or str(uuid.uuid4()), in_pieces, on_upload)


def prepare_scene(
    path: Path,
    retention_hours: float | None,
    texts: dict[str, str],
    labels: dict[str, Any],
    *,
    idempotency_key: str | None,
    on_upload: OnUpload | None,
) -> Submission:
    """As prepare(), for a scene that another installation exported; it is sent in one form.

    Raises:
        InputError: the file cannot be read or is empty, or the option cannot be used.
    """
    document = checked_options({} if retention_hours is None else {"retention_hours": retention_hours})
    sizes, key = {"scene": _size_of("scene", path)}, idempotency_key or str(uuid.uuid4())
    return Submission({"scene": path}, sizes, texts, document, labels, key, False, on_upload, "/scenes")


def texts_of(**given: str | None) -> dict[str, str]:
    """The given ones of clip_of and callback_url, which are sent as text."""
    return {name: text for name, text in given.items() if text is not None}


def labels_of(label: str | None, metadata: Mapping[str, str] | None) -> dict[str, Any]:
    """The given labels of a job, as JSON values."""
    given = {"label": label, "metadata": None if metadata is None else dict(metadata)}
    return {name: value for name, value in given.items() if value is not None}


def checked_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options as JSON values.

    Raises:
        InputError: an option does not exist, is out of range, or excludes another.
    """
    remedy = f"The options are {', '.join(GivenOptions.__annotations__)}."
    try:
        document = dict(TypeAdapter(GivenOptions).validate_python(options))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(["options", *(str(part) for part in first["loc"][:1])])
        problem = f"{first['msg']} (given: {str(first['input'])[:80]!r})."
        raise InputError(field, problem, remedy) from error
    for names in EXCLUSIVE_OPTIONS:
        given = [name for name in names if document.get(name) is not None]
        if len(given) > 1:
            raise InputError(f"options.{given[-1]}", f"{' and '.join(given)} exclude each other.", "Give one of them.")
    return document


async def submit(session: Session, submission: Submission) -> JobView:
    """Send the clip and get its job. Lost connections never create a second job."""
    headers = {"Idempotency-Key": submission.idempotency_key}
    try:
        if submission.in_pieces:
            uploads = await _upload_all(session, submission)
            document = {**uploads, **submission.texts, **submission.labels, "options": submission.options}
            call = Call("POST", "/reconstruct", headers=headers, json=document, is_repeatable=True)
        else:
            call = form_call(submission)
        response = await session.request(call)
    except ServiceUnavailable as failure:
        if failure.job_id is None:
            raise
        return await _job_of_accepted_clip(session, failure)
    return parsed(response, JobView.model_validate_json, response.content)


def form_call(submission: Submission) -> Call:
    """The request that sends all files in one form."""
    boundary = uuid.uuid4().hex
    headers = {"Idempotency-Key": submission.idempotency_key}
    headers["Content-Type"] = f"multipart/form-data; boundary={boundary}"
    return Call("POST", submission.route, headers=headers, body=_form(submission, boundary), is_repeatable=True)


def prepare_feed(calibration: Path, options: Mapping[str, Any], idempotency_key: str | None) -> Submission:
    """A live feed that is ready to be opened.

    Raises:
        InputError: the calibration cannot be read or is empty.
    """
    part = "calibration"
    sizes, key = {part: _size_of(part, calibration)}, idempotency_key or str(uuid.uuid4())
    return Submission({part: calibration}, sizes, {}, dict(options), {}, key, False, None, "/feeds")


async def _job_of_accepted_clip(session: Session, failure: ServiceUnavailable) -> JobView:
    """Wait until a service that has the clip on disk, but cannot reach its queue, has queued the job."""
    patience = session.patience()
    while True:
        await session.wait(patience, failure)
        with contextlib.suppress(NotFound, ServiceUnavailable):
            response = await session.request(Call("GET", f"/jobs/{failure.job_id}"), patience_s=0.0)
            return parsed(response, JobView.model_validate_json, response.content)


async def _upload_all(session: Session, submission: Submission) -> dict[str, str]:
    """Send each file in pieces. Returns the ids of the uploads by part."""
    uploads: dict[str, str] = {}
    sent_bytes = 0
    for part, size_bytes in submission.sizes.items():
        uploads[part] = await _upload(session, submission, part, sent_bytes)
        sent_bytes += size_bytes
    return uploads


async def _upload(session: Session, submission: Submission, part: str, sent_before: int) -> str:
    """Send one file in pieces. Returns the id of its upload."""
    path, size_bytes = submission.paths[part], submission.sizes[part]
    metadata = {"part": part, "suffix": path.suffix}
    encoded = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in metadata.items())
    headers = {**TUS, "Upload-Length": str(size_bytes), "Upload-Metadata": encoded}
    created = await session.request(Call("POST", "/uploads", headers=headers, is_repeatable=True))
    place = parsed(created, lambda answer: httpx.URL(answer.headers["location"]).path, created)
    patience, offset = session.patience(), 0
    while offset < size_bytes:
        start, end = offset, min(offset + PIECE_BYTES, size_bytes)
        pieces = functools.partial(_read, part, path, start, end)
        body = Body(end - start, pieces, functools.partial(_report_piece, submission, sent_before + start))
        offset = await _append(session, place, start, body, patience)
        if offset > start:
            patience.renew()
    return place.rpartition("/")[2]


async def _append(session: Session, place: str, start: int, body: Body, patience: Patience) -> int:
    """Send a piece that starts at byte `start`. Returns the service's new offset, which may be lower or higher."""
    headers = {**TUS, "Upload-Offset": str(start), "Content-Type": TUS_CONTENT_TYPE}
    failure: IntrasplatError
    try:
        response = await session.send(Call("PATCH", place, headers=headers, body=body))
        if response.is_success:
            return parsed(response, _offset_of, response)
        failure = error_of(response)
        if not isinstance(failure, ServiceUnavailable) and response.status_code not in RESUME_AFTER:
            raise failure
    except Unreachable as error:
        failure = error
    while True:
        await session.wait(patience, failure)
        try:
            head = await session.send(Call("HEAD", place, headers=TUS))
        except Unreachable as error:
            failure = error
        else:
            if head.status_code not in (httpx.codes.TOO_MANY_REQUESTS, httpx.codes.SERVICE_UNAVAILABLE):
                # An error answer to HEAD has no body with a reason; the next PATCH gets one.
                return parsed(head, _offset_of, head) if head.is_success else start


def _offset_of(response: httpx.Response) -> int:
    return int(response.headers["upload-offset"])


def _report_piece(submission: Submission, sent_before: int, sent_bytes: int) -> None:
    submission.report(sent_before + sent_bytes)


def _form(submission: Submission, boundary: str) -> Body:
    """multipart/form-data with the options and all files, never whole in memory."""
    texts = {**submission.texts, **submission.labels, "options": json.dumps(submission.options)}
    if "metadata" in texts:
        texts["metadata"] = json.dumps(texts["metadata"])
    head = "".join(
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{text}\r\n'
        for name, text in texts.items()
    ).encode()
    heads = {
        part: f'--{boundary}\r\nContent-Disposition: form-data; name="{part}"; filename="{part}{path.suffix}"\r\n'
        f"Content-Type: application/octet-stream\r\n\r\n".encode()
        for part, path in submission.paths.items()
    }
    tail = f"--{boundary}--\r\n".encode()
    length = len(head) + sum(len(each) + 2 for each in heads.values()) + submission.total_bytes + len(tail)

    def pieces() -> Iterator[bytes]:
        yield head
        for part, path in submission.paths.items():
            yield heads[part]
            yield from _read(part, path, 0, submission.sizes[part])
            yield b"\r\n"
        yield tail

    return Body(length, pieces, submission.report)


def _read(part: str, path: Path, start: int, end: int) -> Iterator[bytes]:
    """The bytes of a file from start to end, even if the file has grown meanwhile."""
    with _readable(part, path), path.open("rb") as file:
        file.seek(start)
        while start < end:
            piece = file.read(min(READ_BYTES, end - start))
            if not piece:
                raise InputError(part, f"{path} has become shorter while it was sent.", "Send it once it is complete.")
            start += len(piece)
            yield piece


@contextlib.contextmanager
def _readable(part: str, path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(part, f"{path} cannot be read ({error.strerror}).", "Name a file that exists.") from error


def _size_of(part: str, path: Path) -> int:
    with _readable(part, path), path.open("rb"):
        size_bytes = path.stat().st_size
    if size_bytes == 0:
        raise InputError(part, f"{path} is empty.", "Send a file with content.")
    return size_bytes
