"""Limits of uploads: how many at once, bytes of each, and the free space on the disk for all of them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from starlette.requests import Request

from contract.runtime.settings import Settings
from contract.store.store import Store
from intrasplat.errors import LimitError
from service.partial import promised_bytes
from service.problems import LENGTH_REMEDY, Problem, disk_full_for_upload, space_remedy
from service.upload import LIMIT_REMEDY

MIN_BYTES = 4096
"""The minimum that a body must bring per upload_silence_s: a slow sender occupies a slot that another could use."""


@dataclass(eq=False)
class UploadSlot:
    """An upload that is being received, and the disk space that is reserved for its remaining bytes."""

    reserved_bytes: int
    tenant: str


class Intake:
    """Counts the uploads of this process. The folders of resumable uploads record the space reserved for them."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        self._slots: set[UploadSlot] = set()

    @contextmanager
    def slot(self, tenant: str, declared_bytes: int = 0, part: str = "clip") -> Iterator[UploadSlot]:
        """A slot for one upload, with disk space for `declared_bytes`. part: what is sent.

        Raises:
            Problem: 429: the tenant has used its share. 503: all slots are taken. 507: the disk has no space for it.
            LimitError: it exceeds the maximum size of an upload.
        """
        own, share = sum(slot.tenant == tenant for slot in self._slots), self._settings.tenant_share
        if own and own + 1 > self._settings.max_uploads * share:
            detail = f"{own} of your uploads are being received, as many as one tenant may send at once."
            raise Problem(429, detail, field="uploads", remedy="Send this one when one of them has ended.")
        if len(self._slots) >= self._settings.max_uploads:
            detail = f"{len(self._slots)} uploads are being received, the most at once (INTRASPLAT_MAX_UPLOADS)."
            raise Problem(503, detail, field="uploads", remedy="Send this one when one of them has ended.")
        if declared_bytes:
            self.check(tenant, declared_bytes, part)
        slot = UploadSlot(declared_bytes, tenant)
        self._slots.add(slot)
        try:
            yield slot
        finally:
            self._slots.discard(slot)

    def check(self, tenant: str, declared_bytes: int, part: str = "clip") -> None:
        """Return if an upload of this size is allowed and fits on the disk; raises as slot().

        A tenant with reserved space gets no more of the disk's free space than its share.
        """
        if declared_bytes > self._settings.max_upload_bytes:
            problem = f"{declared_bytes} bytes are more than the {self._settings.max_upload_bytes} of an upload."
            raise LimitError(part, problem, LIMIT_REMEDY)
        available_bytes = self.available_bytes()
        if declared_bytes > available_bytes:
            raise disk_full_for_upload(declared_bytes, available_bytes, self._settings.min_free_bytes)
        own_bytes = self._reserved_bytes(tenant)
        allowed_bytes = self._settings.tenant_share * (available_bytes + own_bytes)
        if own_bytes and own_bytes + declared_bytes > allowed_bytes:
            detail = (
                f"Your uploads have {own_bytes} bytes of the disk reserved; {declared_bytes} more would exceed the "
            )
            detail += f"{allowed_bytes:.0f} of one tenant."
            raise Problem(
                429, detail, field="uploads", remedy="Finish these uploads, or delete some: DELETE /uploads/{id}."
            )

    def has_free_space(self) -> bool:
        """Whether the disk has more than the minimum free space; otherwise no clip is accepted."""
        return self.missing_bytes() <= 0

    def missing_bytes(self) -> int:
        """How many more bytes must be free before clips are accepted."""
        return self._settings.min_free_bytes - self._store.free_bytes()

    def space_remedy(self) -> str:
        """The remedy for a full disk, with the number of missing bytes."""
        return space_remedy(self.missing_bytes(), self._settings.min_free_bytes)

    def available_bytes(self) -> int:
        """Bytes that may be written now: free space less the minimum and what is reserved for uploads."""
        return self._store.free_bytes() - self._settings.min_free_bytes - self._reserved_bytes()

    def _reserved_bytes(self, tenant: str | None = None) -> int:
        """Bytes reserved for unfinished uploads, of one tenant or of all."""
        slots = sum(slot.reserved_bytes for slot in self._slots if tenant in (None, slot.tenant))
        return slots + promised_bytes(self._store, tenant)

    async def body(self, request: Request, slot: UploadSlot | None = None) -> AsyncGenerator[bytes]:
        """The pieces of a request's body as they arrive.

        Raises:
            Problem: 408: fewer than MIN_BYTES came in upload_silence_s.
            ClientDisconnect: the caller has disconnected.
        """
        pieces, silence_s = request.stream(), self._settings.upload_silence_s
        while True:
            new_bytes, left_s = 0, silence_s
            while new_bytes < MIN_BYTES:
                asked_at_s = time.monotonic()
                try:
                    async with asyncio.timeout(left_s):
                        piece = await anext(pieces, None)
                except TimeoutError:
                    raise _silence(silence_s) from None
                if piece is None:
                    return
                left_s -= time.monotonic() - asked_at_s  # counts waiting for the caller, not writing to disk
                new_bytes += len(piece)
                if slot is not None:
                    slot.reserved_bytes = max(slot.reserved_bytes - len(piece), 0)
                yield piece


def _silence(silence_s: float) -> Problem:
    detail = f"Fewer than {MIN_BYTES} bytes came in {silence_s:g} s."
    return Problem(408, detail, field="body", remedy="Send it again.", headers={"Connection": "close"})


def declared_length(request: Request) -> int:
    """Content-Length of a request; 0 if there is none.

    Raises:
        Problem: 400: it is not a valid length.
    """
    text = request.headers.get("content-length", "0")
    if not (text.isascii() and text.isdigit() and len(text) < 20):
        raise Problem(400, f"{text[:40]!r} is not a length.", field="Content-Length", remedy=LENGTH_REMEDY)
    return int(text)
