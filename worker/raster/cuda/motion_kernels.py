"""How Gaussians move on the device: deformation to the frames' times, and Adam on everything but the other harmonics.

N Gaussians in rows of `columns` floats, F frames a step, B bases, C channels (10, or 13 where colour moves too); state
[F, 13, columns] and the rest as in update.py. One program a row of the state and BLOCK Gaussians. The equations are
those of raster/cpu/update.py. Loops whose length is known on the device alone are while loops: Triton's interpreter has
no other way to run them beside a recent NumPy.
"""

from __future__ import annotations

import triton
import triton.language as tl

from worker.raster.cuda.update import (
    COLOUR_ROW,
    CONSTANT_HARMONIC,
    ROW_COUNT,
    adam,
    row_gradient,
    update_row,
)

MIN_WIDTH = tl.constexpr(1e-3)
"""Smallest |sigma| of a basis, in model time."""
QUARTIC_FLOOR = tl.constexpr(1e-4)
"""Added to sigma^2 in the released form of the basis."""
LOG2E = tl.constexpr(1.4426950408889634)
FDM_CHANNELS = tl.constexpr(10)


@triton.jit
def _store_row(state, colour, frame, row, at, inside, total, columns):  # type: ignore[no-untyped-def]
    """A row of the state, and the colour it shows where no other harmonic is in use."""
    tl.store(state + (frame * ROW_COUNT + row) * columns + at, total, mask=inside)
    if row >= COLOUR_ROW:
        shown = tl.maximum(total * CONSTANT_HARMONIC + 0.5, 0.0)
        tl.store(colour + (frame * 3 + row - COLOUR_ROW) * columns + at, shown, mask=inside)


@triton.jit
def deform_linear(  # type: ignore[no-untyped-def]
    canonical, weight, basis, span, state, colour, columns, bases, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    """state = canonical + sum over j in span of basis_j weight_j, and its colour. Grid (blocks, 13, F).

    weight [B, C, columns], basis [F, B], span int32 [F, 2]: the first of the bases in use and the one after the last.
    """
    row, frame = tl.program_id(1), tl.program_id(2)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < columns
    total = tl.load(canonical + row * columns + at, mask=inside, other=0.0)
    if row < CHANNELS:
        j, last = tl.load(span + 2 * frame), tl.load(span + 2 * frame + 1)
        while j < last:
            moved = tl.load(weight + (j * CHANNELS + row) * columns + at, mask=inside, other=0.0)
            total += tl.load(basis + frame * bases + j) * moved
            j += 1
    _store_row(state, colour, frame, row, at, inside, total, columns)


@triton.jit
def update_linear(  # type: ignore[no-untyped-def]
    canonical, canonical_moments, opacity, opacity_moments, weight, first, second,
    v_state, v_opacity, v_colour, colour, touched, statistics, ok, report, slot, size, floor, betas,
    basis, alive, basis_size, basis_floor, channel_rate, columns, bases, tiles,
    CHANNELS: tl.constexpr, FRAMES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adam on the canonical state, the opacity, and the weights of the bases in use; the report. Grid (blocks, 15).

    weight and its moments [B, C, columns]; basis [F, B], 0 where a frame does not use it; alive int32 [1 + B]: how many
    bases are in use, and which. Their step's size is basis_size [B] times channel_rate [13], its floor basis_floor [B].
    """
    row = tl.program_id(1)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < columns
    if tl.load(ok) != 0:
        update_row(
            canonical, canonical_moments, opacity, opacity_moments, v_state, v_opacity, v_colour, colour,
            touched, statistics, report, slot, size, floor, betas, row, at, inside, columns, tiles, FRAMES,
        )  # fmt: skip
        if row < CHANNELS:
            rate = tl.load(channel_rate + row)
            if rate != 0.0:
                left = tl.load(alive)
                while left > 0:
                    j = tl.load(alive + left)
                    gradient = tl.zeros(at.shape, tl.float32)
                    for frame in tl.static_range(FRAMES):
                        share = row_gradient(v_state, v_colour, colour, frame, row, at, inside, columns)
                        gradient += tl.load(basis + frame * bases + j) * share
                    place = (j * CHANNELS + row) * columns + at
                    step, low = tl.load(basis_size + j) * rate, tl.load(basis_floor + j)
                    adam(weight, first, second, place, inside, gradient, step, low, betas)
                    left -= 1


@triton.jit
def fdm_basis(t, centre, width, QUARTIC: tl.constexpr):  # type: ignore[no-untyped-def]
    """Value of a basis at t, and its logarithmic derivatives to centre and width.

    gaussian: exp(-d^2 / (2 s^2)), d = t - centre;  quartic: exp(-(d^2 / (s^2 + QUARTIC_FLOOR))^2).
    """
    d = t - centre
    if QUARTIC:
        spread = width * width + QUARTIC_FLOOR
        ratio = d * d / spread
        value = tl.exp2(-LOG2E * ratio * ratio)
        slope = 4.0 * ratio / spread
        by_centre, by_width = slope * d, slope * ratio * width
    else:
        size = tl.abs(width)
        inverse = 1.0 / tl.maximum(size, MIN_WIDTH)
        along = d * inverse
        value = tl.exp2(-0.5 * LOG2E * along * along)
        sign = tl.where(width < 0.0, -1.0, 1.0)
        by_centre = along * inverse
        by_width = tl.where(size < MIN_WIDTH, 0.0, along * along * inverse * sign)  # no gradient through the floor
    return value, by_centre, by_width


@triton.jit
def deform_fdm(  # type: ignore[no-untyped-def]
    canonical, weight, centre, width, time, state, colour, columns, bases, QUARTIC: tl.constexpr, BLOCK: tl.constexpr
):
    """state = canonical + FDM at the frames' times, and its colour. Grid (blocks, 13, F).

    weight, centre, width [10, B, columns] (Deform3DGS, equations 3 and 4); time [F].
    """
    row, frame = tl.program_id(1), tl.program_id(2)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < columns
    total = tl.load(canonical + row * columns + at, mask=inside, other=0.0)
    if row < FDM_CHANNELS:
        t, left = tl.load(time + frame), bases
        while left > 0:
            left -= 1
            place = (row * bases + left) * columns + at
            centres = tl.load(centre + place, mask=inside, other=0.0)
            widths = tl.load(width + place, mask=inside, other=1.0)
            value, _, _ = fdm_basis(t, centres, widths, QUARTIC)
            total += tl.load(weight + place, mask=inside, other=0.0) * value
    _store_row(state, colour, frame, row, at, inside, total, columns)


@triton.jit
def update_fdm(  # type: ignore[no-untyped-def]
    canonical, canonical_moments, opacity, opacity_moments, weight, centre, width, first, second,
    v_state, v_opacity, v_colour, colour, touched, statistics, ok, report, slot, size, floor, betas,
    time, motion_size, columns, bases, tiles,
    QUARTIC: tl.constexpr, FRAMES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adam on the canonical state, the opacity, and weight, centre and width of every basis; the report.
    Grid (blocks, 15).

    Moments of the motion [3, 10, B, columns], motion_size [1]: the size of its step.
    """
    row = tl.program_id(1)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < columns
    if tl.load(ok) != 0:
        update_row(
            canonical, canonical_moments, opacity, opacity_moments, v_state, v_opacity, v_colour, colour,
            touched, statistics, report, slot, size, floor, betas, row, at, inside, columns, tiles, FRAMES,
        )  # fmt: skip
        if row < FDM_CHANNELS:
            step, low, group = tl.load(motion_size), tl.load(floor), FDM_CHANNELS * bases * columns
            left = bases
            while left > 0:
                left -= 1
                place = (row * bases + left) * columns + at
                centres = tl.load(centre + place, mask=inside, other=0.0)
                widths = tl.load(width + place, mask=inside, other=1.0)
                weights = tl.load(weight + place, mask=inside, other=0.0)
                to_weight = tl.zeros(at.shape, tl.float32)
                to_centre = tl.zeros(at.shape, tl.float32)
                to_width = tl.zeros(at.shape, tl.float32)
                for frame in tl.static_range(FRAMES):
                    share = row_gradient(v_state, v_colour, colour, frame, row, at, inside, columns)
                    value, by_centre, by_width = fdm_basis(tl.load(time + frame), centres, widths, QUARTIC)
                    share = share * value
                    to_weight += share
                    to_centre += share * weights * by_centre
                    to_width += share * weights * by_width
                adam(weight, first, second, place, inside, to_weight, step, low, betas)
                adam(centre, first + group, second + group, place, inside, to_centre, step, low, betas)
                adam(width, first + 2 * group, second + 2 * group, place, inside, to_width, step, low, betas)
