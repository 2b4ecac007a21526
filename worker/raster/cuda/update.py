"""Adam on the device: what all parameters share, the rows of the canonical state, the opacity, and the step's report.

N Gaussians in rows of `columns` floats, a multiple of COLUMNS; F frames a step. canonical and state [13, columns] as in
raster/cpu/update.py, whose arithmetic this is. A gradient is a sum over the frames. Whatever changes from step to step
is read from tensors on the device (control.py), so that a launch never changes; rates come as sizes and floors that
have Adam's bias corrections folded in (worker/optimize.py). A size of 0 leaves a parameter and its moments untouched.

Every kernel reads `ok` first and does nothing where it is 0: the step had no room (rasterizer.py, model.py).
"""

from __future__ import annotations

import triton
import triton.language as tl

from worker.gaussians import SH_C0

COLUMNS = 32
"""Rows are padded to a multiple of so many floats, 128 bytes: they begin where lines of memory begin."""
BLOCK = 512
"""Gaussians a program; with four warps every thread moves 16 bytes at a time."""
ROWS = 13
PROGRAM_ROWS = ROWS + 2
"""Programs beside each other: a row of the state each, then the opacity, then the report."""
COLOUR_ROW = tl.constexpr(10)
"""First row of the constant harmonic."""
OPACITY_ROW = tl.constexpr(13)
ROW_COUNT = tl.constexpr(13)
GRADIENT_ROWS = tl.constexpr(10)
"""Rows of the state that the rasteriser has gradients of; those of the colour come apart."""
CONSTANT_HARMONIC = tl.constexpr(SH_C0)
SUMS, MADE, SEEN = 4, 4, 5
"""The report: floats before SUMS, the sums that rasterizer.statistics lists; then, as int32, how many steps were made,
and from SEEN on how many Gaussians each of them had in view."""
_MADE = tl.constexpr(MADE)
_SEEN = tl.constexpr(SEEN)
_CHUNK = tl.constexpr(256)


def padded(count: int) -> int:
    """The next multiple of COLUMNS."""
    return -(-count // COLUMNS) * COLUMNS


@triton.jit
def adam(value, first, second, at, inside, gradient, size, floor, betas):  # type: ignore[no-untyped-def]
    """One step of Adam on value[at]; first and second are the moments, betas their decays."""
    beta1, beta2 = tl.load(betas), tl.load(betas + 1)
    m = beta1 * tl.load(first + at, mask=inside, other=0.0) + (1.0 - beta1) * gradient
    v = beta2 * tl.load(second + at, mask=inside, other=0.0) + (1.0 - beta2) * gradient * gradient
    tl.store(first + at, m, mask=inside)
    tl.store(second + at, v, mask=inside)
    moved = tl.load(value + at, mask=inside, other=0.0) - size * m / (tl.sqrt(v) + floor)
    tl.store(value + at, moved, mask=inside)


@triton.jit
def row_gradient(v_state, v_colour, colour, frame, row, at, inside, columns):  # type: ignore[no-untyped-def]
    """dL/dstate of a frame at a row: v_state [F, 10, columns], then what v_colour [F, 3, columns] says of the constant
    harmonic where the colour was not held at 0."""
    if row >= COLOUR_ROW:
        place = (frame * 3 + row - COLOUR_ROW) * columns + at
        shown = tl.load(colour + place, mask=inside, other=0.0) > 0.0
        gradient = tl.load(v_colour + place, mask=inside & shown, other=0.0) * CONSTANT_HARMONIC
    else:
        gradient = tl.load(v_state + (frame * GRADIENT_ROWS + row) * columns + at, mask=inside, other=0.0)
    return gradient


@triton.jit
def update_row(  # type: ignore[no-untyped-def]
    canonical, canonical_moments, opacity, opacity_moments, v_state, v_opacity, v_colour, colour,
    touched, statistics, report, slot, size, floor, betas, row, at, inside, columns, tiles, FRAMES: tl.constexpr,
):  # fmt: skip
    """What the program of a row does beside the motion: Adam on its row of the canonical state, or on the opacity's
    logit, whose program also counts what is in view; the last one reports the sums of the loss.

    Moments [2, 13, columns] and [2, columns]; v_opacity [F, columns]; size [14], floor [1]; touched int32 [F, columns]:
    tiles a Gaussian touches; statistics [tiles, 4]; slot int32 [1]: the step's place in the report.
    """
    if row < OPACITY_ROW:
        rate = tl.load(size + row)
        if rate != 0.0:
            gradient = tl.zeros(at.shape, tl.float32)
            for frame in tl.static_range(FRAMES):
                gradient += row_gradient(v_state, v_colour, colour, frame, row, at, inside, columns)
            second = canonical_moments + ROW_COUNT * columns
            adam(
                canonical, canonical_moments, second, row * columns + at, inside, gradient, rate, tl.load(floor), betas
            )  # fmt: skip
    elif row == OPACITY_ROW:
        rate = tl.load(size + row)
        gradient = tl.zeros(at.shape, tl.float32)
        most = tl.zeros(at.shape, tl.int32)
        for frame in tl.static_range(FRAMES):
            gradient += tl.load(v_opacity + frame * columns + at, mask=inside, other=0.0)
            most = tl.maximum(most, tl.load(touched + frame * columns + at, mask=inside, other=0))
        tl.atomic_add(report + _SEEN + tl.load(slot), tl.sum((most > 0).to(tl.int32), 0))
        if rate != 0.0:
            adam(
                opacity, opacity_moments, opacity_moments + columns, at, inside, gradient, rate, tl.load(floor), betas
            )  # fmt: skip
    elif tl.program_id(0) == 0:
        _report_sums(statistics, report, tiles)


@triton.jit
def _report_sums(statistics, report, tiles):  # type: ignore[no-untyped-def]
    """Add the step's sums to the report, and the step to those made."""
    kind, tile = tl.arange(0, 4), tl.arange(0, _CHUNK)
    total = tl.zeros((4,), tl.float32)
    first = 0
    while first < tiles:
        place, inside = (first + tile)[:, None] * 4 + kind[None, :], (first + tile < tiles)[:, None]
        total += tl.sum(tl.load(statistics + place, mask=inside, other=0.0), 0)
        first += _CHUNK
    sums = report.to(tl.pointer_type(tl.float32)) + kind
    tl.store(sums, tl.load(sums) + total)
    tl.store(report + _MADE, tl.load(report + _MADE) + 1)
