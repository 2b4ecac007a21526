"""What is measured in a scene that is only painted: flat tissue 60 mm before an endoscope that rests.

The right fifth of its picture is unsure, the upper fifth was never seen, and the rest stretches and shrinks by a tenth.
"""

from __future__ import annotations

import math

from contract.wire.measuring import MeasuredDistance, MeasuredPoint, Measurement, Point, Refusal, RefusalCode
from contract.wire.rendering import MeasureRequest
from tests.cameras import CAMERAS, FRAMES, RATE_HZ
from worker.daemon.reply import Reply
from worker.input.camera import Intrinsics

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
    distance = None
    if len(points) == 2 and not any(each.refusal for each in points):
        distance = _distance(request.t, points)
    return Measurement(t=request.t, points=points, distance=distance, depth_range_mm=RANGE_MM, warnings=())


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


def _distance(t: float, points: tuple[MeasuredPoint, ...]) -> MeasuredDistance:
    times = [frame / FRAMES for frame in range(FRAMES)]
    paths = [
        tuple((x * stretch(at) / stretch(t), y * stretch(at) / stretch(t), z) for at in times)
        for x, y, z in (each.point_mm for each in points if each.point_mm is not None)
    ]
    ends = (each.point_mm for each in points if each.point_mm is not None)
    now_mm = math.dist(*ends)
    return MeasuredDistance(
        distance_mm=now_mm,
        uncertainty_mm=UNCERTAINTY_MM,
        t=tuple(times),
        time_s=tuple(frame / RATE_HZ for frame in range(FRAMES)),
        distances_mm=tuple(math.dist(*ends) for ends in zip(*paths, strict=True)),
        uncertainties_mm=(UNCERTAINTY_MM,) * FRAMES,
        first_mm=paths[0],
        second_mm=paths[1],
    )
