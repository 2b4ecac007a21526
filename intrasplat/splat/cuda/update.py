"""Adam on the device: functions for all parameters, the update of canonical state and opacity, the report of a step.

N Gaussians in rows of `columns` floats, a multiple of COLUMNS; F frames per step. values [VALUES, columns] are the rows
of the canonical state (intrasplat/splat/layout.py) and the opacity's logit. A program has COLUMNS Gaussians and all of
their rows, so its tensors are [TILE_ROWS, COLUMNS]. A gradient is a sum over the frames.

Whatever changes from step to step is read from tensors on the device (control.py), so that a launch never changes.
Rates are given as sizes and floors that include Adam's bias corrections (intrasplat/splat/optimize.py). A size of 0
leaves a parameter and its moments unchanged. Every kernel that changes the model reads `ok` first and does nothing
if it is 0, because the step exceeded the capacity (rasterizer.py, model.py).
"""

from __future__ import annotations

import triton
import triton.language as tl

from intrasplat.splat import layout
from intrasplat.splat.constants import SH_C0

COLUMNS = 32
"""Rows are padded to a multiple of so many floats, 128 bytes, so that they are aligned to lines of memory. A program
has one such line of every row; with two, steps on several frames spill registers."""
TILE_ROWS = tl.constexpr(16)
STATE_ROWS, VALUE_ROWS = tl.constexpr(layout.ROWS), tl.constexpr(layout.VALUES)
COLOUR_ROW = tl.constexpr(layout.COLOUR_ROW)
"""The rasteriser computes gradients of the rows before this one."""
GLOSS_ROW, OPACITY_ROW = tl.constexpr(layout.GLOSS_ROW), tl.constexpr(layout.OPACITY_ROW)
CONSTANT_HARMONIC = tl.constexpr(SH_C0)
SUMS, MADE, SEEN = 4, 4, 5
"""The report: the sums of rasterizer.statistics as floats before SUMS; at MADE the number of steps made, as int32; from
SEEN on how many Gaussians each of them had in view, as int32."""
_MADE, _SEEN = tl.constexpr(MADE), tl.constexpr(SEEN)
_CHUNK = tl.constexpr(256)
"""Tiles whose sums are added at once."""


def padded(count: int) -> int:
    """The next multiple of COLUMNS, at least one."""
    return max(1, -(-count // COLUMNS)) * COLUMNS


@triton.jit
def load_trained(value, first, second, at, mask):  # type: ignore[no-untyped-def]
    """A value and its two moments. They are loaded together, before anything is stored, because loads overlap, but the
    compiler moves no load ahead of a store."""
    return (
        tl.load(value + at, mask=mask, other=0.0),
        tl.load(first + at, mask=mask, other=0.0),
        tl.load(second + at, mask=mask, other=0.0),
    )


@triton.jit
def adam(value, m, v, gradient, size, floor, betas):  # type: ignore[no-untyped-def]
    """One step of Adam: the value and its moments m, v after it; betas [2] are the moments' decays."""
    beta1, beta2 = tl.load(betas), tl.load(betas + 1)
    m = beta1 * m + (1.0 - beta1) * gradient
    v = beta2 * v + (1.0 - beta2) * gradient * gradient
    return value - size * m / (tl.sqrt(v) + floor), m, v


@triton.jit
def store_trained(value, first, second, at, mask, new, m, v):  # type: ignore[no-untyped-def]
    """Store a value and its two moments after a step."""
    tl.store(value + at, new, mask=mask)
    tl.store(first + at, m, mask=mask)
    tl.store(second + at, v, mask=mask)


@triton.jit
def gradient_of_values(  # type: ignore[no-untyped-def]
    v_state, v_opacity, v_colour, colour, shine, frame, row, at, columns
):
    """dL/dvalues of a frame, from v_state [F, 10, columns]; v_colour [F, 3, columns], which gives the constant harmonic
    and the gloss where the colour was not clamped at 0; and v_opacity [F, columns]. shine [F, 2]: side and dim of the
    frame's camera; training cameras have dim 0. row [TILE_ROWS, 1], at [1, COLUMNS]."""
    of_colour = (row >= COLOUR_ROW) & (row < GLOSS_ROW)
    gradient = tl.load(v_state + (frame * COLOUR_ROW + row) * columns + at, mask=row < COLOUR_ROW, other=0.0)
    hue = (frame * 3 + row - COLOUR_ROW) * columns + at
    shown = tl.load(colour + hue, mask=of_colour, other=0.0) > 0.0
    by_hue = tl.load(v_colour + hue, mask=of_colour & shown, other=0.0)
    gradient += CONSTANT_HARMONIC * by_hue
    by_gloss = tl.load(shine + 2 * frame) * tl.sum(by_hue, 0)[None, :]
    gradient += tl.where(row == GLOSS_ROW, by_gloss, 0.0)
    gradient += tl.load(v_opacity + frame * columns + at + 0 * row, mask=row == OPACITY_ROW, other=0.0)
    return gradient


@triton.jit
def update_values(  # type: ignore[no-untyped-def]
    values, moments, v_state, v_opacity, v_colour, colour, shine, size, floor, betas, row, at, columns,
    FRAMES: tl.constexpr,
):  # fmt: skip
    """Adam on a program's values; returns their gradient. moments [2, VALUES, columns], size [VALUES], floor [1]."""
    rate = tl.load(size + row, mask=row < VALUE_ROWS, other=0.0)
    second, place = moments + VALUE_ROWS * columns, row * columns + at
    value, m, v = load_trained(values, moments, second, place, rate != 0.0)
    gradient = gradient_of_values(v_state, v_opacity, v_colour, colour, shine, 0, row, at, columns)
    for frame in tl.static_range(1, FRAMES):
        gradient += gradient_of_values(v_state, v_opacity, v_colour, colour, shine, frame, row, at, columns)
    value, m, v = adam(value, m, v, gradient, rate, tl.load(floor), betas)
    store_trained(values, moments, second, place, rate != 0.0, value, m, v)
    return gradient


@triton.jit
def report_step(  # type: ignore[no-untyped-def]
    touched, statistics, report, slot, at, columns, tiles, FRAMES: tl.constexpr
):
    """Add the program's Gaussians in view to the report, at the step's place slot [1]; the first program also counts
    the step and adds its sums. touched int32 [F, columns]: tiles of a Gaussian; statistics [tiles, 4]."""
    most = tl.load(touched + at)
    for frame in tl.static_range(1, FRAMES):
        most = tl.maximum(most, tl.load(touched + frame * columns + at))
    tl.atomic_add(report + _SEEN + tl.load(slot), tl.sum(tl.sum((most > 0).to(tl.int32), 1), 0))
    if tl.program_id(0) == 0:
        kind, tile = tl.arange(0, 4)[None, :], tl.arange(0, _CHUNK)[:, None]
        total = tl.load(statistics + tile * 4 + kind, mask=tile < tiles, other=0.0)
        first = _CHUNK
        while first < tiles:
            total += tl.load(statistics + (first + tile) * 4 + kind, mask=first + tile < tiles, other=0.0)
            first += _CHUNK
        sums = report.to(tl.pointer_type(tl.float32)) + tl.arange(0, 4)
        tl.store(sums, tl.load(sums) + tl.sum(total, 0))
        tl.store(report + _MADE, tl.load(report + _MADE) + 1)
