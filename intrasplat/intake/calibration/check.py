"""Plausibility checks of a calibration from any source: is it one of a stereo endoscope?

Symbols: R rotation and T translation (mm) from the left to the right eye, x_right = R x_left + T.
"""

from __future__ import annotations

import math

from intrasplat.errors import InputError
from intrasplat.intake.calibration.types import RectifiedCalibration, Row, StereoCalibration

FIELD = "calibration"
MIN_BASELINE_MM, MAX_BASELINE_MM = 1.5, 50.0
"""da Vinci 4 to 5.5 mm, rigid 3D laparoscopes up to about 15 mm, which are 1.5 cm: less is centimetres or metres."""
USUAL_BASELINE_MM = 2.0, 15.0
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "micrometres": 0.001}
RIGID_TOLERANCE = 1e-3  # largest entry of |R R^T - 1|: files store rotations with four digits


def check_calibration(calibration: StereoCalibration) -> None:
    """Refuse a calibration with a non-rigid rotation, a vertical or reversed pair, or an implausible baseline.

    Raises:
        InputError: with field "calibration".
    """
    if isinstance(calibration, RectifiedCalibration):
        _check_baseline(calibration.baseline_mm)
        return
    off, determinant = _off_rigid(calibration.right_from_left_rotation)
    if off > RIGID_TOLERANCE or determinant < 0:
        raise InputError(
            FIELD,
            f"R is not a rotation: R R^T differs from 1 by {off:.3g}, its determinant is {determinant:.3g}.",
            "Give R as OpenCV's stereoCalibrate returned it, row by row.",
        )
    x, y, z = calibration.right_from_left_translation_mm
    _check_baseline(math.hypot(x, y, z))
    if abs(x) <= max(abs(y), abs(z)):
        raise InputError(
            FIELD,
            f"T = ({x:.3g}, {y:.3g}, {z:.3g}) mm does not point along x.",
            "Only eyes side by side are read; turn the frames and the calibration by 90 degrees.",
        )
    if x > 0:
        raise InputError(
            FIELD,
            f"T = ({x:.3g}, {y:.3g}, {z:.3g}) mm puts the right eye to the left of the left one.",
            "Swap the eyes, or invert R and T: x_right = R x_left + T, as OpenCV's stereoCalibrate means it.",
        )


def _off_rigid(rows: tuple[Row, Row, Row]) -> tuple[float, float]:
    """The largest entry of |R R^T - 1|, and the determinant of R."""
    products = ((i, j, sum(x * y for x, y in zip(rows[i], rows[j], strict=True))) for i in range(3) for j in range(3))
    off = max(abs(value - (i == j)) for i, j, value in products)
    (a, b, c), (d, e, f), (g, h, i) = rows
    return off, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _check_baseline(baseline_mm: float) -> None:
    if MIN_BASELINE_MM <= baseline_mm <= MAX_BASELINE_MM:
        return
    if baseline_mm == 0:
        raise InputError(FIELD, "the baseline is 0: both eyes stand at one point.", "Give T in mm.")
    low, high = USUAL_BASELINE_MM
    causes = (
        f"it is probably in {unit}, which would be {baseline_mm * unit_mm:.4g} mm"
        for unit, unit_mm in _UNITS_MM.items()
        if low <= baseline_mm * unit_mm <= high
    )
    raise InputError(
        FIELD,
        f"a baseline of {baseline_mm:.4g} mm is outside {MIN_BASELINE_MM} to {MAX_BASELINE_MM:.0f} mm; "
        f"{next(causes, 'no unit makes it that of a stereo endoscope')}.",
        "Give T and the baseline in mm.",
    )
