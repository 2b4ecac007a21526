"""The result of a measurement: points in mm under pixels of a view, a distance or shape of them over time.

Symbols: T frames. Uncertainties are expanded, with coverage factor 2: about 95 % of the true values lie within them
(docs/conventions.md, "Measuring").
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from intrasplat.errors import InputError
from intrasplat.notices import Notice

MAX_POINTS = 16
RESEARCH_ONLY = "Research use only. Not a medical device; it must not guide treatment."
POINTS_REMEDY = f"Give 1 to {MAX_POINTS} points as x,y;x,y in pixels from the picture's upper left."

Point = tuple[float, float]
Place = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Ends = Annotated[tuple[float, ...], Field(min_length=2, max_length=2)]


class ShapeKind(StrEnum):
    """What points make together: a line of straight pieces in space, a polygon of flat triangles, or the angle at the
    second of three points.
    """

    LINE = "line"
    AREA = "area"
    ANGLE = "angle"


ShapeUnit = Literal["mm", "mm2", "deg"]
UNITS: dict[ShapeKind, ShapeUnit] = {ShapeKind.LINE: "mm", ShapeKind.AREA: "mm2", ShapeKind.ANGLE: "deg"}
POINTS_OF_SHAPE = {ShapeKind.LINE: (2, MAX_POINTS), ShapeKind.AREA: (3, MAX_POINTS), ShapeKind.ANGLE: (3, 3)}
"""Fewest and most points of each kind."""


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


class MeasuredShape(BaseModel):
    """A length in mm, an area in mm2 or an angle in degrees, at every frame; the tissue carries its points along.

    Null where a point is out of the endoscope's view for too long to be trusted. Lists have T entries.
    """

    model_config = ConfigDict(frozen=True)

    kind: ShapeKind
    unit: ShapeUnit
    value: float = Field(description="at the time asked for")
    uncertainty: float = Field(description="about 95 % of the true values lie within it")
    pieces_mm: tuple[float, ...] = Field(description="of a line: the length of each piece at the time asked for")
    piece_uncertainties_mm: tuple[float, ...] = Field(description="those of pieces_mm")
    t: tuple[float, ...] = Field(description="times of the frames")
    time_s: tuple[float, ...] = Field(description="seconds of the frames, from the first one")
    values: tuple[float | None, ...] = Field(description="at every frame")
    uncertainties: tuple[float | None, ...] = Field(description="those of values")
    trust: tuple[float, ...] = Field(
        description="at every frame: the least confidence of a point, times the share of its trust that is left"
    )
    places_mm: tuple[tuple[Place, ...], ...] = Field(
        description="where each point is in the world: a list for each point, with a place for every frame"
    )


class Measurement(BaseModel):
    """What was measured in one view of a finished scene."""

    model_config = ConfigDict(frozen=True)

    t: float = Field(description="the time that is shown")
    points: tuple[MeasuredPoint, ...]
    distance: MeasuredDistance | None = Field(
        default=None,
        description="the distance of two points, if no shape is asked for; null for any other number of points, and "
        "where a point is refused",
    )
    shape: MeasuredShape | None = Field(
        default=None, description="what the points make together, if that is asked for and no point is refused"
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


def check_shape(shape: ShapeKind | None, count: int) -> None:
    """Check that so many points make a shape.

    Raises:
        InputError: they are too few or too many.
    """
    if shape is None:
        return
    fewest, most = POINTS_OF_SHAPE[shape]
    if not fewest <= count <= most:
        wanted = f"{fewest} points" if fewest == most else f"{fewest} to {most} points"
        raise InputError("points", f"{count} points make no {shape}.", f"Give {wanted}.")
