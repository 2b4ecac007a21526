"""Lengths, areas and angles: true to known places, as uncertain as their errors make them, carried along by tissue."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from intrasplat.errors import InputError
from intrasplat.measuring import RefusalCode, ShapeKind, check_shape
from intrasplat.view.measure import distances, paths, places_at
from intrasplat.view.measured import EXPANDED, measured
from intrasplat.view.shapes import area_mm2, length_mm, shape_of, triangles_of
from tests.intrasplat.view.test_measure import sheet, stretched

ROW = [(20.5, 40.5), (40.5, 40.5), (70.5, 40.5)]
BOX = [(30.5, 30.5), (60.5, 30.5), (60.5, 50.5), (30.5, 50.5)]
HOOK = [(0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (6.0, 9.0), (6.0, 3.0), (0.0, 3.0)]
"""A polygon that is not convex, of 27 + 18 square pixels."""
MM_A_PIXEL = 0.6
"""Of the sheet, 60 mm away through a lens of 100 px."""


@pytest.mark.parametrize("turned", [HOOK, HOOK[::-1], HOOK[3:] + HOOK[:3]])
def test_a_polygon_that_is_not_convex_is_cut_into_triangles_within_it(turned: list[tuple[float, float]]) -> None:
    flat = np.array([(x, y, 60.0) for x, y in turned])
    assert float(area_mm2(flat, triangles_of(turned))) == pytest.approx(45)


def test_a_polygon_whose_sides_cross_is_refused() -> None:
    with pytest.raises(InputError, match="cross each other"):
        triangles_of([(0, 0), (9, 9), (9, 0), (0, 9)])


def test_lines_areas_and_angles_of_flat_tissue_are_those_of_its_geometry_and_follow_it() -> None:
    scene = stretched(sheet())

    def found(kind: ShapeKind, points: list[tuple[float, float]]) -> tuple[float, float, float]:
        shape = shape_of(scene, 0.0, kind, places_at(scene, 0.0, None, scene.intrinsics, points), points)
        assert shape.known.all()
        assert (shape.trust > 0.5).all()
        assert shape.values[0] == pytest.approx(shape.now)
        assert shape.uncertainties[0] == pytest.approx(shape.now_uncertainty)
        return shape.now, shape.now_uncertainty, float(np.min(shape.values / shape.now))

    long, _, shorter = found(ShapeKind.LINE, ROW)
    assert long == pytest.approx(50 * MM_A_PIXEL, rel=0.01)
    area, unsure, smaller = found(ShapeKind.AREA, BOX)
    assert area == pytest.approx(600 * MM_A_PIXEL**2, rel=0.02)
    assert smaller == pytest.approx(shorter, rel=1e-3)  # it shrinks along the rows
    assert shorter < 0.995
    assert 0 < unsure < 0.2 * area
    assert found(ShapeKind.ANGLE, BOX[:3])[0] == pytest.approx(90, abs=0.5)


def test_the_uncertainty_of_a_line_is_that_of_the_distance_and_pieces_end_to_end_err_together() -> None:
    scene = sheet()
    places = places_at(scene, 0.0, None, scene.intrinsics, ROW)
    pair = shape_of(scene, 0.0, ShapeKind.LINE, places[::2], ROW[::2])
    closed_form = distances(scene, 0.0, places[0], places[2])
    assert pair.now == pytest.approx(closed_form.now_mm)
    assert pair.now_uncertainty == pytest.approx(closed_form.now_uncertainty_mm, rel=0.05)
    line = shape_of(scene, 0.0, ShapeKind.LINE, places, ROW)
    assert line.pieces_mm.sum() == pytest.approx(line.now)
    assert line.now_uncertainty < np.hypot(*line.piece_uncertainties_mm)  # the corner between them hardly matters
    followed = paths(scene, 0.0, places)
    assert line.values == pytest.approx(length_mm(followed.places_mm.swapaxes(0, 1)))


def test_uncertainties_cover_true_figures_of_places_that_err_as_they_say() -> None:
    scene = sheet()
    places = places_at(scene, 0.0, None, scene.intrinsics, BOX)
    random = np.random.default_rng(5)
    truth_mm2 = float(area_mm2(np.stack([each.point_mm for each in places]), triangles_of(BOX)))
    within = []
    for _ in range(60):
        wrong = [
            dataclasses.replace(each, point_mm=each.point_mm + random.normal(0, each.uncertainty_mm) * each.ray)
            for each in places
        ]
        shape = shape_of(scene, 0.0, ShapeKind.AREA, wrong, BOX)
        within.append(abs(shape.now - truth_mm2) <= EXPANDED * shape.now_uncertainty)
    assert np.mean(within) > 0.88


def test_a_measured_shape_is_null_where_a_place_is_lost_and_refused_with_its_point() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[3:, 0, 3] = 400.0
    moved = dataclasses.replace(sheet(), world_from_camera=poses, frame_times_s=np.array([0.0, 1, 2, 3, 9]))
    found = measured(moved, 0.0, None, moved.intrinsics, tuple(BOX), shape=ShapeKind.AREA)
    assert found.distance is None
    assert found.shape is not None
    assert (found.shape.unit, found.shape.pieces_mm) == ("mm2", ())
    assert found.shape.values[-1] is None
    assert found.shape.uncertainties[-1] is None
    assert found.shape.values[0] == pytest.approx(found.shape.value, abs=1e-3)
    assert found.shape.trust[-1] < found.shape.trust[0]
    assert [len(path) for path in found.shape.places_mm] == [5] * 4

    unsure = dataclasses.replace(moved, seen=moved.seen * 0.03)
    refused = measured(unsure, 0.0, None, moved.intrinsics, tuple(BOX), shape=ShapeKind.AREA)
    assert refused.shape is None
    assert {each.refusal.code for each in refused.points if each.refusal} == {RefusalCode.LOW_CONFIDENCE}


@pytest.mark.parametrize(
    ("shape", "count", "is_good"),
    [
        (None, 1, True),
        ("line", 1, False),
        ("line", 9, True),
        ("area", 2, False),
        ("angle", 3, True),
        ("angle", 4, False),
    ],
)
def test_a_shape_needs_as_many_points_as_make_it(shape: str | None, count: int, is_good: bool) -> None:
    kind = None if shape is None else ShapeKind(shape)
    if is_good:
        return check_shape(kind, count)
    with pytest.raises(InputError) as refused:
        check_shape(kind, count)
    assert refused.value.field == "points"
    return None
