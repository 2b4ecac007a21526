"""A measurement as a caller gets it: the points of a view, and what they make together over time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
from intrasplat.notices import Notice
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.view.measure import MIN_CONFIDENCE, Distances, MeasuredPlace, distances, places_at
from intrasplat.view.render import clamped_to_clip
from intrasplat.view.renderer import renderer_of
from intrasplat.view.shapes import Shape, shape_of

OTHER_PLACE = "Choose another place or another moment."
EXPANDED = 2.0
"""Coverage factor: about 95 % of the true values lie within the reported uncertainty, twice the standard one."""
DIGITS = 4
"""Decimals of a length in mm: a tenth of a micrometre; also of an area in mm2 and an angle in degrees."""


def measured(
    scene: TrainedScene,
    t: float,
    world_from_camera: NDArray[np.float64] | None,
    camera: Intrinsics,
    points: tuple[Point, ...],
    device: Device = CPU,
    *,
    shape: ShapeKind | None = None,
) -> Measurement:
    """The measurement of the points of a view at model time t (clamped to the clip); pose None: the endoscope's.

    Args:
        shape: what the points make together; their number must fit (check_shape).

    Raises:
        InputError: a point lies outside the picture, sides of a polygon cross, or the scene has no trust.
    """
    shown, outside = clamped_to_clip(scene, t)
    places = places_at(scene, shown, world_from_camera, camera, points, device)
    measured = tuple(
        _point(number, point, place, camera) for number, (point, place) in enumerate(zip(points, places, strict=True))
    )
    distance = made = None
    is_whole = all(each.refusal is None for each in measured)
    if shape is not None and is_whole:
        made = _shape(scene, shape, shape_of(scene, shown, shape, places, points, device))
    elif len(places) == 2 and is_whole:
        distance = _distance(scene, distances(scene, shown, places[0], places[1], device))
    warnings: tuple[Notice, ...] = (*outside, *scene.pose_warnings)
    range_mm = renderer_of(scene, device).depth_range.before(world_from_camera)
    return Measurement(
        t=shown, points=measured, distance=distance, shape=made, depth_range_mm=range_mm, warnings=warnings
    )


def _point(number: int, point: Point, place: MeasuredPlace, camera: Intrinsics) -> MeasuredPoint:
    refusal = _refusal(f"points[{number}]", place)
    likely = round(place.confidence, DIGITS)
    if refusal is not None:
        return MeasuredPoint(x=point[0], y=point[1], confidence=likely, refusal=refusal)
    return MeasuredPoint(
        x=point[0],
        y=point[1],
        confidence=likely,
        depth_mm=round(place.depth_mm, DIGITS),
        uncertainty_mm=round(EXPANDED * place.uncertainty_mm, DIGITS),
        point_mm=_rounded(place.point_mm),
        mm_per_px=round(place.depth_mm / camera.fx, 2 * DIGITS),
    )


def _refusal(field: str, place: MeasuredPlace) -> Refusal | None:
    if place.unseen:
        problem = "No frame of the clip saw what is shown here."
        return Refusal(code=RefusalCode.UNSEEN, field=field, problem=problem, remedy=OTHER_PLACE)
    if place.confidence < MIN_CONFIDENCE:
        problem = f"The depth here is right with a probability of {place.confidence:.2f}, less than {MIN_CONFIDENCE:g}."
        return Refusal(code=RefusalCode.LOW_CONFIDENCE, field=field, problem=problem, remedy=OTHER_PLACE)
    return None


def _distance(scene: TrainedScene, found: Distances) -> MeasuredDistance:
    return MeasuredDistance(
        distance_mm=round(found.now_mm, DIGITS),
        uncertainty_mm=round(EXPANDED * found.now_uncertainty_mm, DIGITS),
        t=_times(scene),
        time_s=tuple(scene.frame_times_s.tolist()),
        distances_mm=_where(found.known, found.distances_mm),
        uncertainties_mm=_where(found.known, EXPANDED * found.uncertainties_mm),
        first_mm=tuple(_rounded(each) for each in found.paths_mm[0]),
        second_mm=tuple(_rounded(each) for each in found.paths_mm[1]),
    )


def _shape(scene: TrainedScene, kind: ShapeKind, found: Shape) -> MeasuredShape:
    return MeasuredShape(
        kind=kind,
        unit=UNITS[kind],
        value=round(found.now, DIGITS),
        uncertainty=round(EXPANDED * found.now_uncertainty, DIGITS),
        pieces_mm=tuple(round(float(each), DIGITS) for each in found.pieces_mm),
        piece_uncertainties_mm=tuple(round(EXPANDED * float(each), DIGITS) for each in found.piece_uncertainties_mm),
        t=_times(scene),
        time_s=tuple(scene.frame_times_s.tolist()),
        values=_where(found.known, found.values),
        uncertainties=_where(found.known, EXPANDED * found.uncertainties),
        trust=tuple(round(float(each), DIGITS) for each in found.trust),
        places_mm=tuple(tuple(_rounded(place) for place in path) for path in found.places_mm),
    )


def _times(scene: TrainedScene) -> tuple[float, ...]:
    return tuple(frame / scene.frame_count for frame in range(scene.frame_count))


def _where(known: NDArray[np.bool_], values: NDArray[np.float64]) -> tuple[float | None, ...]:
    """Rounded values [T]; None at frames where they are not known."""
    return tuple(round(float(value), DIGITS) if here else None for value, here in zip(values, known, strict=True))


def _rounded(point_mm: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (round(float(each), DIGITS) for each in point_mm)
    return x, y, z
