"""The `t` of a request: a number of a scene's clip, or a moment of a live feed."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from pydantic import AfterValidator, Field

from intrasplat.errors import InputError
from intrasplat.live.times import LIVE, REMEDY, FeedTime

MAX_T = 1e6
SCENE_T_REMEDY = "Give a number: 0 is the first frame, 1 the end of the clip."
ABOUT_T = (
    "of a scene a number: 0 is the first frame, 1 the end of the clip (default: 0). Of a live feed live (the default), "
    "seconds before that (-12.5), seconds of the source (31.4), or a time of RFC 3339 with its zone"
)


def _checked(asked: float | str | None) -> float | str | None:
    """Refuse a text that is a time of neither. Raises InputError, so that the answer has its remedy."""
    if isinstance(asked, str):
        FeedTime.parse(asked, f"{SCENE_T_REMEDY} Of a live feed: {REMEDY}")
    return asked


AskedTime = Annotated[
    Annotated[float, Field(allow_inf_nan=False)] | str | None,
    Field(union_mode="left_to_right", description=ABOUT_T, examples=[0.4, "live", "-12.5", "2026-05-04T10:20:30Z"]),
    AfterValidator(_checked),
]


def scene_time(asked: float | str | None) -> float:
    """The time of a scene that is asked for; 0 if none is.

    Raises:
        InputError: it is no number in [0, MAX_T].
    """
    if asked is None:
        return 0.0
    if isinstance(asked, str) or not 0 <= asked <= MAX_T:
        raise InputError("t", f"{str(asked)[:40]!r} is no time of a scene.", SCENE_T_REMEDY)
    return asked


def feed_time(asked: float | str | None) -> FeedTime:
    """The moment of a feed that is asked for; the newest if none is.

    Raises:
        InputError: it names no moment.
    """
    return LIVE if asked is None else FeedTime.parse(asked)


def moment_text(at_s: float) -> str:
    """A UNIX time in RFC 3339 with milliseconds, UTC."""
    return datetime.fromtimestamp(at_s, UTC).isoformat(timespec="milliseconds")
