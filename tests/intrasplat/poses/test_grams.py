"""A link's Gram matrix against the products of its columns, written out."""

from __future__ import annotations

import numpy as np
import pytest

from intrasplat.poses.field import DeformationField, powers_of
from intrasplat.poses.grams import INDEPENDENT, NOISE_PX, link_gram
from intrasplat.poses.links import FrameLink
from intrasplat.poses.rigid import StereoCamera, cross, exp, inverse

CAMERA = StereoCamera(285.0, 280.0, 160.0, 128.0, 4.3)


@pytest.mark.parametrize(("degree", "matches"), [(3, 40), (5, 40), (3, 0)])
def test_a_gram_matrix_holds_the_products_of_the_links_columns(degree: int, matches: int) -> None:
    rng = np.random.default_rng(0)
    before = rng.uniform([0, 0, 12], [320, 256, 18], (matches, 3))
    after, trust = before + rng.normal(0, 0.5, (matches, 3)), rng.uniform(0, 1, matches)
    link = FrameLink(0, 1, np.arange(matches), before, after, trust, 0.9, np.zeros((2, 2, 2), np.float32))
    weight = rng.normal(0, 0.2, (4, 3 * powers_of(degree)))
    field = DeformationField(degree, np.array([3.0, -2.0]), np.array([40.0, 30.0]), weight, np.zeros((2, 4)))
    poses, change = (exp(rng.normal(0, 0.02, 6)), exp(rng.normal(0, 0.02, 6))), rng.normal(0, 1, 4)
    found = link_gram(CAMERA, link, poses, field, change, 2.0, None)

    world = CAMERA.points_mm(before) @ poses[0][:3, :3].T + poses[0][:3, 3]
    back = inverse(poses[1])
    off = CAMERA.seen((world + field.displacement(world, change)) @ back[:3, :3].T + back[:3, 3]) - after
    there = CAMERA.points_mm(after)
    slopes = CAMERA.slopes_by_point(there) @ back[:3, :3]
    expected = np.zeros((7 + weight.shape[1],) * 2)
    for place, slope, each, factor in zip(
        there @ poses[1][:3, :3].T + poses[1][:3, 3], slopes, off, trust * found.weight, strict=True
    ):
        moved = np.concatenate([np.eye(3), -cross(place), np.kron(field.powers(place[None])[0], np.eye(3))], axis=1)
        columns = np.concatenate([slope @ moved, each[:, None]], axis=1)
        expected += factor * INDEPENDENT / NOISE_PX**2 * columns.T @ columns
    assert found.gram == pytest.approx(expected, rel=1e-9, abs=1e-9 * max(np.abs(expected).max(), 1.0))
    assert found.residual_px == pytest.approx(np.linalg.norm(off, axis=1))
