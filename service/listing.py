"""Lists of jobs and scenes: search conditions, and pages by cursor.

A cursor is the position of the last job of a page (its time and id). The next page starts after that position, so jobs
that are added or removed meanwhile neither repeat nor hide others.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Query, Response
from pydantic import BaseModel, ConfigDict, Field

from contract.queue.interface import MAX_LISTED, ListingPosition, place_of
from contract.wire.job import JobRecord, JobState
from contract.wire.labels import folded
from intrasplat.errors import InputError
from intrasplat.names import PresetName

MAX_LOOKED_AT = 2000
"""Maximum jobs examined for one page. If few of them match, the page is short or empty and still has a cursor."""
MAX_CONDITIONS = 16
ID_CHARACTERS = 4
"""A search word matches the beginning of an id if it has at least this many characters."""
NEXT_HEADER = "X-Intrasplat-Next"
LAST_ID = "~"
"""Sorts after all ids."""
PAGED: dict[int | str, dict[str, Any]] = {
    200: {
        "headers": {
            NEXT_HEADER: {
                "description": "cursor of the next page; absent on the last one. A page may be shorter than its limit",
                "schema": {"type": "string"},
            }
        }
    }
}
"""The OpenAPI responses of a route with pages."""

Find = Callable[[int, ListingPosition | None], Sequence[JobRecord]]
"""(limit, after) -> at most `limit` records of the caller's tenant, newest first, after a position; empty only at the
end."""


class SceneSearch(BaseModel):
    """What a list is narrowed to, and which part of it is asked for."""

    model_config = ConfigDict(frozen=True)

    q: str | None = Field(
        default=None,
        max_length=200,
        description="words; each is part of the label or of a value of metadata, or begins the id. Case is ignored",
    )
    metadata: tuple[Annotated[str, Field(max_length=300)], ...] = Field(
        default=(), max_length=MAX_CONDITIONS, description="NAME=VALUE that metadata must have; may come several times"
    )
    preset: PresetName | None = Field(default=None, description="only jobs of this preset")
    created_from_s: float | None = Field(
        default=None, allow_inf_nan=False, description="only jobs submitted then or later, UNIX s"
    )
    created_until_s: float | None = Field(
        default=None, allow_inf_nan=False, description="only jobs submitted then or before, UNIX s"
    )
    limit: int = Field(default=MAX_LISTED, ge=1, le=MAX_LISTED, description="maximum number of entries")
    cursor: str | None = Field(
        default=None, max_length=200, description=f"where the page starts: the header {NEXT_HEADER} of the page before"
    )


class JobSearch(SceneSearch):
    """The same of jobs, which have a state."""

    state: JobState | None = Field(default=None, description="only jobs in this state")


SceneQuery = Annotated[SceneSearch, Query()]
JobQuery = Annotated[JobSearch, Query()]


@dataclass(frozen=True)
class Page:
    """Records, newest first, and the position after which the next page starts; None: there is no next page."""

    records: list[JobRecord]
    end: ListingPosition | None


def find_page(search: SceneSearch, tenant: str, find: Find, state: JobState | None = None) -> Page:
    """The requested page, only of jobs in `state` if it is given.

    Raises:
        InputError: the cursor is not one of this tenant's, or a condition on metadata is invalid.
    """
    fits = _condition(search, state)
    place = None if search.cursor is None else _place_of_cursor(search.cursor, tenant)
    if search.created_until_s is not None:
        newest = ListingPosition(search.created_until_s, LAST_ID)
        place = newest if place is None else min(place, newest)
    found: list[JobRecord] = []
    looked_at, all_fit = 0, state is None and not (search.q or search.metadata or search.preset)
    chunk_size = search.limit + 1 if all_fit else MAX_LISTED
    while looked_at < MAX_LOOKED_AT and (chunk := find(chunk_size, place)):
        for record in chunk:
            if search.created_from_s is not None and record.created_at_s < search.created_from_s:
                return Page(found, None)
            if fits(record):
                if len(found) == search.limit:
                    return Page(found, place_of(found[-1]))
                found.append(record)
        looked_at += len(chunk)
        place = place_of(chunk[-1])
    return Page(found, place if looked_at >= MAX_LOOKED_AT else None)


def find_among(records: Sequence[JobRecord]) -> Find:
    """A Find on the given records, which are newest first."""
    return lambda limit, before: [each for each in records if before is None or place_of(each) < before][:limit]


def tell_next(response: Response, page: Page, tenant: str) -> None:
    """Put the cursor of the next page into the response headers, if there is one."""
    if page.end is not None:
        response.headers[NEXT_HEADER] = _cursor_of(page.end, tenant)


def _condition(search: SceneSearch, state: JobState | None) -> Callable[[JobRecord], bool]:
    words = folded(search.q or "").split()
    wanted = [_entry(text) for text in search.metadata]

    def fits(record: JobRecord) -> bool:
        return (
            state in (None, record.state)
            and search.preset in (None, record.options.preset)
            and all(record.labels.metadata.get(name) == value for name, value in wanted)
            and all(_is_found(record, word) for word in words)
        )

    return fits


def _is_found(record: JobRecord, word: str) -> bool:
    return record.labels.found_by(word) or (len(word) >= ID_CHARACTERS and record.job_id.startswith(word))


def _entry(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError("metadata", f"{text[:40]!r} has no =.", "Give NAME=VALUE.")
    return name, value


def _cursor_of(place: ListingPosition, tenant: str) -> str:
    text = f"{place.created_at_s!r} {place.job_id}"
    return base64.urlsafe_b64encode(f"{text} {_seal(text, tenant)}".encode()).decode().rstrip("=")


def _place_of_cursor(cursor: str, tenant: str) -> ListingPosition:
    try:
        text = base64.b64decode(cursor + "=" * (-len(cursor) % 4), altchars=b"-_", validate=True).decode("ascii")
        created, job_id, seal = text.split(" ")
        if seal == _seal(f"{created} {job_id}", tenant):
            return ListingPosition(float(created), job_id)
    except (ValueError, binascii.Error):
        pass
    raise InputError("cursor", "it is none of yours.", f"Send what {NEXT_HEADER} said, or nothing for the first page.")


def _seal(text: str, tenant: str) -> str:
    """The suffix of this tenant's cursors, by which a cursor of another tenant is refused."""
    return hashlib.sha256(f"{tenant} {text}".encode()).hexdigest()[:16]
