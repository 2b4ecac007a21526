"""The false colours: matplotlib's cividis, whose lightness rises evenly, and those of errors."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from intrasplat.colours import COLOUR_TABLE, ERROR_COLOURS


def test_the_table_is_cividis() -> None:
    colours = mpl.colormaps["cividis"](np.arange(256))[:, :3]
    assert np.rint(colours * 255).astype(np.uint8).tobytes() == COLOUR_TABLE


def test_each_colour_is_at_least_as_light_as_the_one_before() -> None:
    light = lightness_of(COLOUR_TABLE)
    assert (np.diff(light) > -2e-3).all()  # by less than a step of 8 bits
    assert light[-1] - light[0] > 0.7


def test_an_error_is_as_light_darker_as_brighter_and_dark_where_there_is_none() -> None:
    darker, alike, brighter = lightness_of(ERROR_COLOURS)
    assert abs(darker - brighter) < 0.03
    assert alike < 0.02


def lightness_of(table: bytes) -> NDArray[np.float64]:
    """Relative luminance of colours R G B."""
    share = np.frombuffer(table, np.uint8).reshape(-1, 3) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ (0.2126, 0.7152, 0.0722), np.float64)
