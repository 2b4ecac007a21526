"""The result of a measurement: points in mm under pixels of a view, the distance of two over time, and uncertainties.

Symbols: T frames. Uncertainties are expanded, with coverage factor 2: about 95 % of the true values lie within them
(docs/conventions.md, "Measuring").
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from intrasplat.errors import InputError
from intrasplat.notices import Notice

MAX_POINTS = 16
RESEARCH_ONLY = "Research use only. Not a medical device; it must not guide treatment."
POINTS_REMEDY = f"Give 1 to {MAX_POINTS} points as x,y;x,y in pixels from the picture's upper left."

Point = tuple[float, float]
Place = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Ends = Annotated[tuple[float, ...], Field(min_length=2, max_length=2)]


class RefusalCode(StrEnum):
    """Why nothing is measured at a point; docs/codes.md explains each."""

    LOW_CONFIDENCE = "low_confidence"
    UNSEEN = "unseen"


class Refusal(BaseModel):
    """Why nothing is measured at a point, and what to do."""

    model_config = ConfigDict(frozen=True)

    code: RefusalCode
    field: str = Field(description="the point, such as points[0]")
    problem: str
    remedy: str


class MeasuredPoint(BaseModel):
    """What is seen at a point of the picture. A point that is refused has no numbers but its confidence."""

    model_config = ConfigDict(frozen=True)

    x: float = Field(description="as asked for, in pixels of the picture")
    y: float = Field(description="as asked for, in pixels of the picture")
    confidence: float = Field(description="in [0, 1], as the layer confidence has it")
    depth_mm: float | None = Field(default=None, description="along the camera's z, as the layer depth has it")
    uncertainty_mm: float | None = Field(default=None, description="about 95 % of the true depths lie within it")
    point_mm: Place | None = Field(default=None, description="the place in the world")
    mm_per_px: float | None = Field(default=None, description="width of a pixel at this depth, across the view")
    refusal: Refusal | None = None


class MeasuredDistance(BaseModel):
    """How far the two points are apart in space, at every frame; the tissue carries them along.

    Null where a place is out of the endoscope's view for too long to be trusted. Lists have T entries.
    """

    model_config = ConfigDict(frozen=True)

    distance_mm: float = Field(description="at the time asked for")
    uncertainty_mm: float = Field(description="about 95 % of the true distances lie within it")
    t: tuple[float, ...] = Field(description="times of the frames")
    time_s: tuple[float, ...] = Field(description="seconds of the frames, from the first one")
    distances_mm: tuple[float | None, ...] = Field(description="at every frame")
    uncertainties_mm: tuple[float | None, ...] = Field(description="those of distances_mm")
    first_mm: tuple[Place, ...] = Field(description="where the first point is in the world at every frame")
    second_mm: tuple[Place, ...] = Field(description="where the second point is in the world at every frame")


class Measurement(BaseModel):
    """What was measured in one view of a finished scene."""

    model_config = ConfigDict(frozen=True)

    t: float = Field(description="the time that is shown")
    points: tuple[MeasuredPoint, ...]
    distance: MeasuredDistance | None = Field(
        default=None,
        description="the distance of two points; null for any other number of points, and where a point is refused",
    )
    depth_range_mm: Ends = Field(
        description="depths of the brightest and the darkest false colour of layer=depth from this pose"
    )
    warnings: tuple[Notice, ...] = Field(description="reasons not to rely on the scene; every view repeats them")
    notice: str = RESEARCH_ONLY


def parse_points(text: str) -> tuple[Point, ...]:
    """Read points as the API and the command line write them: x,y;x,y.

    Raises:
        InputError: the text is not 1 to MAX_POINTS pairs of finite numbers.
    """
    points = []
    for pair in text.split(";"):
        try:
            x, y = map(float, pair.split(","))
        except ValueError:
            raise InputError("points", f"{pair[:40]!r} is not a point.", POINTS_REMEDY) from None
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError("points", f"{pair[:40]!r} is not finite.", POINTS_REMEDY)
        points.append((x, y))
    if len(points) > MAX_POINTS:
        raise InputError("points", f"{len(points)} points are too many.", POINTS_REMEDY)
    return tuple(points)
