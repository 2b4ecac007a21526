"""Completed depth: what was measured stays, the rest lies between its surroundings."""

from __future__ import annotations

import numpy as np

from intrasplat.motion.complete import complete_depth
from tests.intrasplat.clips import HEIGHT, WIDTH, plane_clip


def test_completed_depth_keeps_what_was_measured_and_stays_between_its_surroundings() -> None:
    random = np.random.default_rng(0)
    depth_mm = random.uniform(40, 80, (HEIGHT, WIDTH)).astype(np.float32)
    valid = random.random((HEIGHT, WIDTH)) > 0.8
    tissue = random.random((HEIGHT, WIDTH)) > 0.1
    completed = complete_depth(depth_mm, valid, tissue)
    known = valid & tissue
    assert np.array_equal(completed[known], depth_mm[known])
    assert (completed[~tissue] == 0).all()
    inside = completed[tissue]
    assert inside.min() >= depth_mm[known].min() - 1e-3
    assert inside.max() <= depth_mm[known].max() + 1e-3


def test_depth_under_an_instrument_takes_no_part_in_completion() -> None:
    clip = plane_clip()
    depth_mm = clip.depth_mm[0].copy()
    depth_mm[~clip.tissue[0]] = 5.0
    valid = np.ones_like(clip.tissue[0])
    valid[8:12, 2:10] = False
    completed = complete_depth(depth_mm, valid, clip.tissue[0])
    np.testing.assert_allclose(completed[8:10, 2:10], clip.depth_mm[0, 8:10, 2:10], atol=0.5)


def test_nothing_to_complete_from_gives_zeros() -> None:
    nothing = np.zeros((8, 8), dtype=np.bool_)
    assert not complete_depth(np.full((8, 8), 50, np.float32), nothing, ~nothing).any()
