"""What is measured in a scene that is only painted: flat tissue 60 mm before an endoscope that rests.

The right fifth of its picture is unsure, the upper fifth was never seen, and the rest stretches and shrinks by a tenth.
"""

from __future__ import annotations

import itertools
import math

from contract.wire.rendering import MeasureRequest
from intrasplat.camera import Intrinsics
from intrasplat.measuring import (
    UNITS,
    MeasuredDistance,
    MeasuredPoint,
    MeasuredShape,
    Measurement,
    Point,
    Refusal,
    RefusalCode,
    ShapeKind,
)
from tests.cameras import CAMERAS, FRAMES, RATE_HZ
from worker.reply import Reply

DEPTH_MM, UNCERTAINTY_MM = 60.0, 0.4
RANGE_MM = (45.0, 78.0)


def measured_flat(request: MeasureRequest) -> Measurement:
    """As a worker would measure it."""
    k = CAMERAS.intrinsics
    asked, (width, height) = request.camera, request.camera.size(k.width, k.height)
    camera = Intrinsics(
        width=width,
        height=height,
        fx=asked.fx or k.fx * width / k.width,
        fy=asked.fy or k.fy * height / k.height,
        cx=asked.cx or k.cx * width / k.width,
        cy=asked.cy or k.cy * height / k.height,
    )
    points = tuple(_point(number, point, camera) for number, point in enumerate(request.points))
    distance = shape = None
    if not any(each.refusal for each in points):
        if request.shape is not None:
            shape = _shape(request.t, request.shape, points)
        elif len(points) == 2:
            distance = _distance(request.t, points)
    return Measurement(t=request.t, points=points, distance=distance, shape=shape, depth_range_mm=RANGE_MM, warnings=())


def measurement_reply(request: MeasureRequest) -> Reply:
    """As a worker tells it."""
    return Reply(measured_flat(request).model_dump_json().encode(), "application/json", request.t)


def stretch(t: float) -> float:
    """Of all lengths."""
    return 1 + 0.1 * math.sin(2 * math.pi * t)


def _point(number: int, point: Point, k: Intrinsics) -> MeasuredPoint:
    x, y = point
    if x > 0.8 * k.width or y < 0.2 * k.height:
        code = RefusalCode.UNSEEN if y < 0.2 * k.height else RefusalCode.LOW_CONFIDENCE
        refusal = Refusal(code=code, field=f"points[{number}]", problem="It is unsure.", remedy="Choose another.")
        return MeasuredPoint(x=x, y=y, confidence=0.2, refusal=refusal)
    place = (DEPTH_MM * (x - k.cx) / k.fx, DEPTH_MM * (y - k.cy) / k.fy, DEPTH_MM)
    return MeasuredPoint(
        x=x,
        y=y,
        confidence=0.9,
        depth_mm=DEPTH_MM,
        uncertainty_mm=UNCERTAINTY_MM,
        point_mm=place,
        mm_per_px=DEPTH_MM / k.fx,
    )


def _paths(t: float, points: tuple[MeasuredPoint, ...]) -> list[tuple[tuple[float, float, float], ...]]:
    """Where the points are at every frame."""
    times = [frame / FRAMES for frame in range(FRAMES)]
    return [
        tuple((x * stretch(at) / stretch(t), y * stretch(at) / stretch(t), z) for at in times)
        for x, y, z in (each.point_mm for each in points if each.point_mm is not None)
    ]


def _shape(t: float, kind: ShapeKind, points: tuple[MeasuredPoint, ...]) -> MeasuredShape:
    """Its last frame is lost; the area of a polygon is that of a convex one."""
    paths = _paths(t, points)
    places = [each.point_mm for each in points if each.point_mm is not None]
    pieces = [math.dist(*ends) for ends in itertools.pairwise(places)] if kind is ShapeKind.LINE else []
    value, power = sum(pieces), 1
    if kind is ShapeKind.AREA:
        crosses = (a[0] * b[1] - a[1] * b[0] for a, b in itertools.pairwise([*places, places[0]]))
        value, power = abs(sum(crosses)) / 2, 2
    if kind is ShapeKind.ANGLE:
        value, power = 90.0, 0
    known = [value * (stretch(frame / FRAMES) / stretch(t)) ** power for frame in range(FRAMES - 1)]
    return MeasuredShape(
        kind=kind,
        unit=UNITS[kind],
        value=value,
        uncertainty=UNCERTAINTY_MM,
        pieces_mm=tuple(pieces),
        piece_uncertainties_mm=(UNCERTAINTY_MM,) * len(pieces),
        t=tuple(frame / FRAMES for frame in range(FRAMES)),
        time_s=tuple(frame / RATE_HZ for frame in range(FRAMES)),
        values=(*known, None),
        uncertainties=(*[UNCERTAINTY_MM] * len(known), None),
        trust=(0.9,) * len(known) + (0.1,),
        places_mm=tuple(paths),
    )


def _distance(t: float, points: tuple[MeasuredPoint, ...]) -> MeasuredDistance:
    paths = _paths(t, points)
    ends = (each.point_mm for each in points if each.point_mm is not None)
    now_mm = math.dist(*ends)
    return MeasuredDistance(
        distance_mm=now_mm,
        uncertainty_mm=UNCERTAINTY_MM,
        t=tuple(frame / FRAMES for frame in range(FRAMES)),
        time_s=tuple(frame / RATE_HZ for frame in range(FRAMES)),
        distances_mm=tuple(math.dist(*ends) for ends in zip(*paths, strict=True)),
        uncertainties_mm=(UNCERTAINTY_MM,) * FRAMES,
        first_mm=paths[0],
        second_mm=paths[1],
    )
