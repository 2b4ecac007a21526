"""The pose of a caller's camera: a rigid transform, or an orbit about a point, such as what the endoscope looked at.

Symbols: R rotation, C camera centre (mm), P point looked at (mm), D median depth of the clip (mm).
Axes are OpenCV's (x right, y down, z forward); the world is the endoscope's camera at frame 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from intrasplat.errors import InputError

RIGID_TOLERANCE = 1e-3
"""Largest entry of |R R^T - 1| that is accepted: poses are often typed with four digits."""

MAX_TRANSLATION_MM = 10_000.0
POSE_REMEDY = (
    "Give 12 or 16 numbers, the row-major world_from_camera in mm, or orbit:yaw,pitch,zoom in degrees "
    "(orbit:0,0,1 is frame 0), or orbit:yaw,pitch,zoom,x,y,z with the point looked at in mm."
)

Matrix = tuple[tuple[float, float, float, float], ...]


class MatrixPose(BaseModel):
    """world_from_camera as the 12 numbers of its upper three rows, row-major, translation in mm."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["matrix"] = "matrix"
    rows: tuple[float, ...] = Field(min_length=12, max_length=12)


class OrbitPose(BaseModel):
    """About a point: yaw moves the camera right, pitch up, zoom > 1 nearer."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["orbit"] = "orbit"
    yaw_deg: float = Field(ge=-180, le=180)
    pitch_deg: float = Field(ge=-90, le=90)
    zoom: float = Field(ge=0.1, le=10)
    about_mm: tuple[float, float, float] | None = None
    """The point looked at, in the world; None: the point at the median depth on frame 0's axis."""


Pose = MatrixPose | OrbitPose


def orbit(
    yaw_deg: float, pitch_deg: float, zoom: float = 1.0, about_mm: tuple[float, float, float] | None = None
) -> OrbitPose:
    """The pose of a camera that has moved about the point it looks at.

    Args:
        yaw_deg: degrees to the right, -180 to 180.
        pitch_deg: degrees up, -90 to 90.
        zoom: times nearer, 0.1 to 10.
        about_mm: the point in the world, mm; None: the point at the median depth on frame 0's axis.

    Raises:
        InputError: a number is out of its range.

    Example:
        >>> isp.orbit(10, 0).yaw_deg
        10.0
    """
    return _parse_orbit([float(each) for each in (yaw_deg, pitch_deg, zoom, *(about_mm or ()))])


def parse_pose(text: str) -> Pose:
    """Read a pose as the API and the command line write it; commas or blanks separate the numbers.

    Raises:
        InputError: the text has neither form, or the pose is not finite, not rigid, or out of range.
    """
    if text.startswith("orbit:"):
        return _parse_orbit(_numbers(text.removeprefix("orbit:")))
    values = _numbers(text)
    if len(values) not in (12, 16):
        raise InputError("pose", f"{len(values)} numbers were given.", POSE_REMEDY)
    if len(values) == 16 and any(abs(a - b) > RIGID_TOLERANCE for a, b in zip(values[12:], (0, 0, 0, 1), strict=True)):
        raise InputError("pose", f"the last row is {values[12:]}, not 0 0 0 1.", POSE_REMEDY)
    _check_rigid(values[:12])
    return MatrixPose(rows=tuple(values[:12]))


def world_from_camera(pose: Pose, median_depth_mm: float) -> Matrix:
    """The 4 x 4 transform of a pose, translation in mm; only orbits use the median depth.

    An orbit is C = P - R z D / zoom with R = Ry(-yaw) Rx(-pitch). It always looks at P, by default (0, 0, D).
    """
    if isinstance(pose, MatrixPose):
        a = pose.rows
        return ((a[0], a[1], a[2], a[3]), (a[4], a[5], a[6], a[7]), (a[8], a[9], a[10], a[11]), (0.0, 0.0, 0.0, 1.0))
    yaw, pitch = math.radians(-pose.yaw_deg), math.radians(-pose.pitch_deg)
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    rotation = ((cy, sy * sp, sy * cp), (0.0, cp, -sp), (-sy, cy * sp, cy * cp))
    distance_mm, about_mm = median_depth_mm / pose.zoom, pose.about_mm or (0.0, 0.0, median_depth_mm)
    centre_mm = [p - row[2] * distance_mm for p, row in zip(about_mm, rotation, strict=True)]
    top = tuple((row[0], row[1], row[2], c) for row, c in zip(rotation, centre_mm, strict=True))
    return (*top, (0.0, 0.0, 0.0, 1.0))


def _numbers(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        raise InputError("pose", f"{text[:80]!r} holds something that is not a number.", POSE_REMEDY) from None
    if not all(math.isfinite(value) for value in values):
        raise InputError("pose", f"{text[:80]!r} holds a number that is not finite.", POSE_REMEDY)
    return values


def _parse_orbit(values: list[float]) -> OrbitPose:
    if len(values) not in (3, 6):
        raise InputError("pose", f"an orbit has 3 or 6 numbers, {len(values)} were given.", POSE_REMEDY)
    limits = {"yaw": (-180.0, 180.0), "pitch": (-90.0, 90.0), "zoom": (0.1, 10.0)}
    limits |= dict.fromkeys("xyz", (-MAX_TRANSLATION_MM, MAX_TRANSLATION_MM))
    for value, (name, (low, high)) in zip(values, limits.items(), strict=False):
        if not low <= value <= high:
            raise InputError("pose", f"{name} is {value:g}.", f"Keep {name} between {low:g} and {high:g}.")
    about_mm = (values[3], values[4], values[5]) if len(values) == 6 else None
    return OrbitPose(yaw_deg=values[0], pitch_deg=values[1], zoom=values[2], about_mm=about_mm)


def _check_rigid(values: Sequence[float]) -> None:
    rows = [values[0:3], values[4:7], values[8:11]]
    for i in range(3):
        for j in range(i, 3):
            product = sum(a * b for a, b in zip(rows[i], rows[j], strict=True))
            if abs(product - (i == j)) > RIGID_TOLERANCE:
                problem = f"rows {i + 1} and {j + 1} of the rotation have the product {product:.4g}: it is not rigid."
                raise InputError("pose", problem, POSE_REMEDY)
    (a, b, c), (d, e, f), (g, h, k) = rows
    if a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g) < 0:
        raise InputError("pose", "the rotation is a mirror image (determinant -1).", POSE_REMEDY)
    largest_mm = max(abs(values[i]) for i in (3, 7, 11))
    if largest_mm > MAX_TRANSLATION_MM:
        remedy = f"Give the translation in mm, at most {MAX_TRANSLATION_MM:g}."
        raise InputError("pose", f"the translation reaches {largest_mm:g} mm.", remedy)
