"""The table of false colours: matplotlib's cividis, whose lightness rises evenly."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np

from intrasplat.colours import COLOUR_TABLE


def test_the_table_is_cividis() -> None:
    colours = mpl.colormaps["cividis"](np.arange(256))[:, :3]
    assert np.rint(colours * 255).astype(np.uint8).tobytes() == COLOUR_TABLE


def test_each_colour_is_at_least_as_light_as_the_one_before() -> None:
    table = np.frombuffer(COLOUR_TABLE, np.uint8).reshape(256, 3) / 255
    light = np.where(table <= 0.04045, table / 12.92, ((table + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(light) > -2e-3).all()  # by less than a step of 8 bits
    assert light[-1] - light[0] > 0.7
