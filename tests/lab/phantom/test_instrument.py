"""Instruments: their colours tell the kinds apart, they enter from the border, and several do so at once."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.phantom import TOOLS, Phantom, PhantomFrame, PhantomSettings, Tool, make_phantom

FRAMES = 24


@cache
def scene(*tools: Tool) -> Phantom:
    return make_phantom(PhantomSettings(160, 128, FRAMES, tools=tools, noise=False, period_frames=12.0))


@cache
def frame_of(index: int, *tools: Tool) -> PhantomFrame:
    """Callers share the arrays."""
    return scene(*tools).frame(index)


def shown(frame: PhantomFrame) -> NDArray[np.bool_]:
    """Pixels well inside the instruments."""
    return ~frame.tissue & (frame.hidden_depth_mm - frame.depth_mm > 1)


@pytest.mark.parametrize("tool", TOOLS)
def test_an_instrument_moves_enters_from_the_border_and_glints(tool: Tool) -> None:
    frames = [frame_of(index, tool) for index in (0, 8, 16)]
    for frame in frames:
        mask = ~frame.tissue
        assert 0.005 < mask.mean() < 0.4
        assert mask[-1].any() | mask[:, -1].any()
        np.testing.assert_array_equal(frame.depth_mm[frame.tissue], frame.hidden_depth_mm[frame.tissue])
    assert (frames[0].tissue != frames[1].tissue).mean() > 0.01
    brightness = np.concatenate([frame.left[shown(frame)].max(axis=1) for frame in frames]).astype(float)
    assert np.quantile(brightness, 0.999) > 1.5 * np.median(brightness)


def test_kinds_tell_apart_by_their_colours() -> None:
    looks = {}
    for tool in TOOLS:
        frames = [frame_of(index, tool) for index in range(0, FRAMES, 4)]
        looks[tool] = np.concatenate([frame.left[shown(frame)] for frame in frames]).astype(float)
    brightness = {tool: np.median(pixels) for tool, pixels in looks.items()}
    assert brightness["dark"] < brightness["grasper"] < brightness["steel"]
    yellow = {
        tool: np.mean((pixels[:, 1] > 1.5 * pixels[:, 2]) & (pixels[:, 1] > 60)) for tool, pixels in looks.items()
    }
    assert yellow["yellow"] > 0.2
    assert max(yellow[tool] for tool in ("steel", "dark")) < 0.05


def test_a_second_instrument_comes_and_goes_and_leaves_the_first_as_it_was() -> None:
    more = []
    for index in range(0, FRAMES, 2):
        both, alone = frame_of(index, "grasper", "yellow"), frame_of(index, "grasper")
        np.testing.assert_array_equal(both.hidden_rgb, alone.hidden_rgb)
        assert not (both.tissue & ~alone.tissue).any()
        assert (both.depth_mm <= alone.depth_mm).all()
        more.append(float((alone.tissue & ~both.tissue).mean()))
    assert min(more) == 0
    assert max(more) > 0.02


def test_three_instruments_come_from_three_sides() -> None:
    chosen: list[tuple[Tool, ...]] = [("grasper",), ("grasper", "steel"), ("grasper", "steel", "dark")]
    tissue = [np.stack([frame_of(index, *tools).tissue for index in range(0, FRAMES, 4)]) for tools in chosen]
    second, third = (now_less & ~now for now_less, now in pairwise(tissue))
    assert second[:, :, 0].any() | second[:, -1, :80].any(), "from below left"
    assert third[:, 0].any(), "from above"
