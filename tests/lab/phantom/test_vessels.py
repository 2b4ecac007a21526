"""Vessels that are remembered are the ones that would be drawn, and so is what is drawn after them."""

from __future__ import annotations

import numpy as np

from lab.phantom import vessels


def test_remembered_vessels_and_the_numbers_after_them_are_those_of_a_first_drawing() -> None:
    def drawn(seed: int) -> list[bytes]:
        rng = np.random.default_rng(seed)
        rng.random()
        pictures = vessels.draw_vessels(rng, (30.0, 40.0), 0.5, (60, 80))
        return [*(each.tobytes() for each in pictures), rng.random(8).tobytes()]

    first, remembered, another = drawn(1), drawn(1), drawn(2)
    vessels._remembered.cache_clear()
    assert first == remembered == drawn(1)
    assert another == drawn(2) != first
