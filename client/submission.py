"""Sending a clip: small files in one form, large ones in pieces that survive a lost connection (tus 1.0.0, tus.io).

Of file names only the endings are sent; they may name a patient.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import json
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from client.errors import NotFound, ServiceUnavailable, Unreachable
from client.steps import Body, Call, Patience, Steps, answered, error_of
from contract.wire.errors import InputError, IntrasplatError
from contract.wire.job import JobView, parse_options

IN_PIECES_FROM_BYTES = 64 * 2**20
"""A connection that is lost in a smaller upload costs seconds; a larger one goes on where it was."""
PIECE_BYTES = 32 * 2**20
"""Of one request: what a proxy in between will let pass, and what is sent again at worst."""
READ_BYTES = 2**18

TUS = {"Tus-Resumable": "1.0.0"}
TUS_CONTENT_TYPE = "application/offset+octet-stream"

GO_ON_AFTER = frozenset({httpx.codes.REQUEST_TIMEOUT, httpx.codes.CONFLICT, httpx.codes.LOCKED})
"""Silence; another offset; the service has not noticed yet that the connection before is dead."""

OnUpload = Callable[[int, int], object]
"""Called with the bytes that have been sent and the bytes there are; after a lost connection the former fall back."""


@dataclass(frozen=True)
class Submission:
    """A clip that is ready to go: files by part, options as JSON can have them."""

    paths: dict[str, Path]
    options: dict[str, Any]
    idempotency_key: str
    in_pieces: bool
    on_upload: OnUpload | None = None
    sizes: dict[str, int] = field(default_factory=dict)

    @property
    def total_bytes(self) -> int:
        """Of all files."""
        return sum(self.sizes.values())

    def tell(self, sent_bytes: int) -> None:
        """Report how much has gone."""
        if self.on_upload is not None:
            self.on_upload(min(sent_bytes, self.total_bytes), self.total_bytes)


def prepare(
    clip: Path,
    right: Path | None,
    others: dict[str, Path | None],
    options: dict[str, Any],
    *,
    idempotency_key: str | None,
    in_pieces: bool | None,
    on_upload: OnUpload | None,
) -> Submission:
    """Look at everything before anything is sent.

    Raises:
        InputError: a file cannot be read or is empty, or an option is not one.
    """
    document = parse_options(options).model_dump(mode="json", exclude_unset=True)
    given = {"clip": clip} if right is None else {"left": clip, "right": right}
    given |= {part: path for part, path in others.items() if path is not None}
    paths = {part: Path(path) for part, path in given.items()}
    sizes = {part: _size_of(part, path) for part, path in paths.items()}
    if in_pieces is None:
        in_pieces = sum(sizes.values()) >= IN_PIECES_FROM_BYTES
    key = idempotency_key or str(uuid.uuid4())
    return Submission(paths, document, key, in_pieces, on_upload, sizes)


def reconstruct(submission: Submission, patience_s: float) -> Steps[JobView]:
    """Send the clip and get its job; the same job however often the connection is lost on the way."""
    headers = {"Idempotency-Key": submission.idempotency_key}
    uploads: dict[str, str] = {}
    try:
        if submission.in_pieces:
            for part in submission.paths:
                uploads[part] = yield from _upload(submission, part, uploads, patience_s)
            document = {**uploads, "options": submission.options}
            call = Call("POST", "/reconstruct", headers=headers, json=document, is_repeatable=True)
        else:
            boundary = uuid.uuid4().hex
            headers["Content-Type"] = f"multipart/form-data; boundary={boundary}"
            call = Call("POST", "/reconstruct", headers=headers, body=_form(submission, boundary), is_repeatable=True)
        response = yield from answered(call, patience_s)
    except ServiceUnavailable as failure:
        if failure.job_id is None:
            raise
        return (yield from _job_of_safe_clip(failure, patience_s))
    return JobView.model_validate_json(response.content)


def _job_of_safe_clip(failure: ServiceUnavailable, patience_s: float) -> Steps[JobView]:
    """The clip is on the service's disk, but its queue is away: the job comes into being when that is back."""
    patience = Patience(patience_s)
    while True:
        yield patience.pause(failure)
        try:
            response = yield from answered(Call("GET", f"/jobs/{failure.job_id}"), patience_s=0.0)
            return JobView.model_validate_json(response.content)
        except (NotFound, ServiceUnavailable):
            continue


def _upload(submission: Submission, part: str, before: dict[str, str], patience_s: float) -> Steps[str]:
    """Send one file in pieces; the id of its upload."""
    path, size_bytes = submission.paths[part], submission.sizes[part]
    metadata = {"part": part, "suffix": path.suffix}
    encoded = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in metadata.items())
    headers = {**TUS, "Upload-Length": str(size_bytes), "Upload-Metadata": encoded}
    created = yield from answered(Call("POST", "/uploads", headers=headers, is_repeatable=True), patience_s)
    place = httpx.URL(created.headers["location"]).path
    sent_before = sum(submission.sizes[each] for each in before)
    patience, offset = Patience(patience_s), 0
    while offset < size_bytes:
        end = min(offset + PIECE_BYTES, size_bytes)
        new_offset = yield from _append(submission, part, place, (offset, end), sent_before, patience)
        if new_offset > offset:
            patience.renew()
        offset = new_offset
    return place.rpartition("/")[2]


def _append(
    submission: Submission, part: str, place: str, span: tuple[int, int], sent_before: int, patience: Patience
) -> Steps[int]:
    """Send the bytes of one span; how many the service has afterwards, which may be fewer, or more, than that."""
    start, end = span
    pieces = functools.partial(_read, part, submission.paths[part], start, end)
    body = Body(end - start, pieces, lambda n: submission.tell(sent_before + start + n))
    headers = {**TUS, "Upload-Offset": str(start), "Content-Type": TUS_CONTENT_TYPE}
    failure: IntrasplatError
    try:
        response: httpx.Response = yield Call("PATCH", place, headers=headers, body=body)
        if response.is_success:
            return int(response.headers["upload-offset"])
        failure = error_of(response)
        if not isinstance(failure, ServiceUnavailable) and response.status_code not in GO_ON_AFTER:
            raise failure
    except Unreachable as error:
        failure = error
    while True:
        yield patience.pause(failure)
        try:
            head: httpx.Response = yield Call("HEAD", place, headers=TUS)
        except Unreachable as error:
            failure = error
        else:
            if head.status_code not in (httpx.codes.TOO_MANY_REQUESTS, httpx.codes.SERVICE_UNAVAILABLE):
                # An answer to HEAD cannot say what is wrong; that to the next PATCH will.
                return int(head.headers["upload-offset"]) if head.is_success else start


def _form(submission: Submission, boundary: str) -> Body:
    """multipart/form-data with the options and all files, never in memory as a whole."""
    options = json.dumps(submission.options)
    head = f'--{boundary}\r\nContent-Disposition: form-data; name="options"\r\n\r\n{options}\r\n'.encode()
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

    return Body(length, pieces, submission.tell)


def _read(part: str, path: Path, start: int, end: int) -> Iterator[bytes]:
    """The bytes of a file from start to end, and no others, though it may have grown meanwhile."""
    with _readable(part, path), path.open("rb") as file:
        file.seek(start)
        while start < end:
            piece = file.read(min(READ_BYTES, end - start))
            if not piece:
                raise InputError(part, f"{path} has become shorter while it was sent.", "Send it once it is whole.")
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
