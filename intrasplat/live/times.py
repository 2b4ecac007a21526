"""The times at which one looks at a feed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from intrasplat.errors import InputError
from intrasplat.live.spec import MAX_KEEP_S

REMEDY = "Give live, -12.5 (seconds before live), 73.2 (seconds of the source), or 2026-11-29T08:15:00.5Z (RFC 3339)."
FIELD = "t"
_UNESCAPED = re.compile(r".+T.+ [0-9]{2}:[0-9]{2}", re.ASCII)
_NUMBER = re.compile(r"[+-]?[0-9]{1,9}(\.[0-9]{1,9})?", re.ASCII)


class FeedTimeKind(StrEnum):
    """What a FeedTime counts from."""

    LIVE = "live"
    BEFORE_LIVE = "before_live"
    SOURCE = "source"
    UNIX = "unix"


@dataclass(frozen=True)
class FeedTime:
    """A moment of a feed.

    kind     live: the newest moment that the model knows
    seconds  before live; of the source's clock; or UNIX time, at which the moment came in
    """

    kind: FeedTimeKind = FeedTimeKind.LIVE
    seconds: float = 0.0

    @classmethod
    def before_live(cls, seconds: float) -> FeedTime:
        """Seconds before the newest moment that the model knows."""
        return cls(FeedTimeKind.BEFORE_LIVE, seconds)

    @classmethod
    def of_source(cls, seconds: float) -> FeedTime:
        """Seconds of the source's clock since the feed's first frame."""
        return cls(FeedTimeKind.SOURCE, seconds)

    @classmethod
    def at(cls, unix_s: float) -> FeedTime:
        """The moment that came in at a UNIX time, s."""
        return cls(FeedTimeKind.UNIX, unix_s)

    @classmethod
    def parse(cls, value: str | float, remedy: str = REMEDY) -> FeedTime:
        """live, seconds before live (below 0, or -0), seconds of the source, or a time of RFC 3339 with its zone.

        remedy: of the error for what is none of these.

        Raises:
            InputError: it is none of these, or more than MAX_KEEP_S before live.
        """
        text = value.strip() if isinstance(value, str) else f"{value:.9f}".rstrip("0").rstrip(".")
        if text == FeedTimeKind.LIVE:
            return LIVE
        if not _NUMBER.fullmatch(text):
            return cls.at(_unix_s(text, remedy))
        seconds = float(text)
        if seconds < -MAX_KEEP_S:
            raise _no_time(text, remedy)
        if not text.startswith("-"):
            return cls.of_source(seconds)
        return cls.before_live(-seconds) if seconds else LIVE


LIVE = FeedTime()


def _unix_s(text: str, remedy: str) -> float:
    try:
        moment = datetime.fromisoformat(text)
        unix_s = moment.timestamp() if moment.tzinfo is not None else 0.0
    except (ValueError, OverflowError):
        if _UNESCAPED.fullmatch(text):
            in_address = "In an address write %2B for the + of a time zone, or give the time in UTC, with a Z."
            raise InputError(FIELD, f"{text[:40]!r} has a space before its time zone.", in_address) from None
        raise _no_time(text, remedy) from None
    if moment.tzinfo is None:
        raise InputError(FIELD, f"{text[:40]!r} has no time zone.", "Append Z, or an offset such as +01:00.")
    if unix_s < 0:
        raise _no_time(text, remedy)
    return unix_s


def _no_time(text: str, remedy: str) -> InputError:
    return InputError(FIELD, f"{text[:40]!r} is no time.", remedy)
