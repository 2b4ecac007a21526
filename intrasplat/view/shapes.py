"""Lengths, areas and angles of measured places, at every frame, with their standard uncertainty.

Symbols: P places, T frames, S samples of their errors.

A line is the sum of straight pieces from place to place. An area is that of flat triangles, into which the polygon is
cut as the picture shows it. The uncertainty is the root mean square by which a figure changes when each place moves by
its own errors: of depth along its ray, and of its way in any direction (measure.py). The errors of different places
count as independent. docs/conventions.md ("Measuring") has the definition.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import InputError
from intrasplat.measuring import Point, ShapeKind
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.view.measure import MeasuredPlace, paths

SAMPLES = 1024
"""Samples of the errors, half of them the negatives of the others: an uncertainty is off by some 3 %."""
SEED = 0
"""The same samples for every frame and every question, so that no figure flickers."""

Figure = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""From places [..., P, 3] in mm to a figure [...]."""


@dataclass(frozen=True, eq=False)
class Shape:
    """A figure of places over time.

    now, now_uncertainty   at the time at which they were chosen, with its standard uncertainty
    pieces_mm, piece_uncertainties_mm   [P - 1] the same of each piece of a line; [0] of other shapes
    values, uncertainties  [T] the figure at every frame
    known                  [T] whether all places are trusted at that frame
    trust                  [T] the least confidence of a place, times the share of its trust that is left
    places_mm              [P, T, 3] where the places are in the world
    """

    now: float
    now_uncertainty: float
    pieces_mm: NDArray[np.float64]
    piece_uncertainties_mm: NDArray[np.float64]
    values: NDArray[np.float64]
    uncertainties: NDArray[np.float64]
    known: NDArray[np.bool_]
    trust: NDArray[np.float64]
    places_mm: NDArray[np.float64]


def shape_of(
    scene: TrainedScene,
    t: float,
    kind: ShapeKind,
    places: Sequence[MeasuredPlace],
    points: Sequence[Point],
    device: Device = CPU,
) -> Shape:
    """The shape of places that were chosen at model time t, at the points of a picture.

    Raises:
        InputError: sides of a polygon cross each other.
    """
    figure, followed = _figure_of(kind, points), paths(scene, t, places, device)
    errors = _Errors.of(places)
    chosen_mm = np.stack([each.point_mm for each in places])
    over_time = zip(followed.places_mm.swapaxes(0, 1), followed.spread_mm.T, strict=True)
    ends = [chosen_mm[i : i + 2] for i in range(len(places) - 1)] if kind is ShapeKind.LINE else []
    pieces = [_Errors.of(places[i : i + 2]).uncertainty(length_mm, each) for i, each in enumerate(ends)]
    confidence = np.array([each.confidence for each in places])
    return Shape(
        now=float(figure(chosen_mm)),
        now_uncertainty=errors.uncertainty(figure, chosen_mm),
        pieces_mm=np.array([float(length_mm(each)) for each in ends]),
        piece_uncertainties_mm=np.array(pieces),
        values=figure(followed.places_mm.swapaxes(0, 1)),
        uncertainties=np.array([errors.uncertainty(figure, at_mm, spread_mm) for at_mm, spread_mm in over_time]),
        known=followed.known,
        trust=(confidence[:, None] * np.minimum(followed.left, 1)).min(axis=0),
        places_mm=followed.places_mm,
    )


def length_mm(places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """[...] lengths of lines through places [..., P, 3]."""
    return np.asarray(np.linalg.norm(np.diff(places_mm, axis=-2), axis=-1).sum(axis=-1))


def angle_deg(places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """[...] angles at the second of three places [..., 3, 3], in [0, 180]."""
    one, other = places_mm[..., 0, :] - places_mm[..., 1, :], places_mm[..., 2, :] - places_mm[..., 1, :]
    across = np.linalg.norm(np.cross(one, other), axis=-1)
    return np.asarray(np.degrees(np.arctan2(across, np.sum(one * other, axis=-1))))


def area_mm2(places_mm: NDArray[np.float64], triangles: NDArray[np.intp]) -> NDArray[np.float64]:
    """[...] areas of triangles [P - 2, 3] between places [..., P, 3]."""
    first, second, third = (places_mm[..., triangles[:, i], :] for i in range(3))
    return np.asarray(np.linalg.norm(np.cross(second - first, third - first), axis=-1).sum(axis=-1) / 2)


def triangles_of(points: Sequence[Point]) -> NDArray[np.intp]:
    """[P - 2, 3] corners of triangles that make up a polygon of points in a picture: its ears, one after the other.

    Raises:
        InputError: sides of the polygon cross each other.
    """
    corners = np.array(points, np.float64)
    count = len(corners)
    for i in range(count):
        for j in range(i + 2, count if i else count - 1):
            if _cross(corners[i], corners[(i + 1) % count], corners[j], corners[(j + 1) % count]):
                problem = f"The sides after points {i + 1} and {j + 1} cross each other."
                raise InputError("points", problem, "Give the corners in the order in which one walks around the area.")
    left = list(range(count) if _twice_area(*corners) >= 0 else range(count - 1, -1, -1))
    found = []
    while len(left) > 3:
        ear = next((i for i in range(len(left)) if _is_ear(corners, left, i)), 0)
        found.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return np.array([*found, tuple(left)], np.intp)


def _figure_of(kind: ShapeKind, points: Sequence[Point]) -> Figure:
    if kind is ShapeKind.LINE:
        return length_mm
    if kind is ShapeKind.ANGLE:
        return angle_deg
    triangles = triangles_of(points)
    return lambda places_mm: area_mm2(places_mm, triangles)


@dataclass(frozen=True, eq=False)
class _Errors:
    """Samples of the errors of places: depth_mm [S, P, 3] of their depths, along their rays, and unit [S, P, 3] of
    their ways, in any direction, for a standard uncertainty of 1.
    """

    depth_mm: NDArray[np.float64]
    unit: NDArray[np.float64]

    @classmethod
    def of(cls, places: Sequence[MeasuredPlace]) -> _Errors:
        random, shape = np.random.default_rng(SEED), (SAMPLES // 2, len(places))
        depth, way = random.standard_normal(shape), random.standard_normal((*shape, 3))
        along = np.concatenate([depth, -depth])
        rays_mm = np.stack([each.uncertainty_mm * each.ray for each in places])
        return cls(along[..., None] * rays_mm, np.concatenate([way, -way]))

    def uncertainty(
        self, figure: Figure, places_mm: NDArray[np.float64], spread_mm: NDArray[np.float64] | None = None
    ) -> float:
        """Standard uncertainty of a figure of places [P, 3] whose ways have standard uncertainties spread_mm [P]."""
        moved = places_mm + self.depth_mm
        if spread_mm is not None:
            moved = moved + spread_mm[:, None] * self.unit
        return float(np.sqrt(np.mean((figure(moved) - figure(places_mm)) ** 2)))


def _twice_area(*corners: NDArray[np.float64]) -> float:
    """Twice the area of a polygon in a picture; negative where its corners go round the other way."""
    x, y = np.transpose(corners)
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _cross(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]) -> bool:
    """Whether the sides a b and c d of a picture cross within both."""
    return _twice_area(a, b, c) * _twice_area(a, b, d) < 0 and _twice_area(c, d, a) * _twice_area(c, d, b) < 0


def _is_ear(corners: NDArray[np.float64], left: Sequence[int], i: int) -> bool:
    """Whether the triangle at corner i of what is left of a polygon lies within it and holds no other corner."""
    a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
    if _twice_area(*corners[[a, b, c]]) <= 0:
        return False
    sides = ((a, b), (b, c), (c, a))
    others = (each for each in left if each not in (a, b, c))
    return not any(
        all(_twice_area(corners[one], corners[two], corners[other]) >= 0 for one, two in sides) for other in others
    )
