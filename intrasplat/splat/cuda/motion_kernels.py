"""How Gaussians move on the device: deformation to the frames' times, and Adam on everything but the other harmonics.

N Gaussians in rows of `columns` floats, F frames per step, B bases, C channels (10, 13 or 14);
state [F, 14, columns]; other arrays and a program's share as in update.py. cpu/update.py has the same equations.
A loop whose length only the device knows is a while loop: with a recent NumPy, Triton's interpreter runs no other kind.
"""

from __future__ import annotations

import triton
import triton.language as tl

from intrasplat.splat import constants
from intrasplat.splat.cuda.update import (
    COLOUR_ROW,
    COLUMNS,
    CONSTANT_HARMONIC,
    GLOSS_ROW,
    STATE_ROWS,
    TILE_ROWS,
    adam,
    gradient_of_values,
    load_trained,
    report_step,
    store_trained,
    update_values,
)
from intrasplat.splat.layout import CHANNELS

_MIN_WIDTH, _QUARTIC_FLOOR = tl.constexpr(constants.MIN_WIDTH), tl.constexpr(constants.QUARTIC_FLOOR)
_LOG2E = tl.constexpr(constants.LOG2E)
FDM_CHANNELS = tl.constexpr(CHANNELS)
LINE = tl.constexpr(COLUMNS)


@triton.jit
def _place():  # type: ignore[no-untyped-def]
    """A program's rows [TILE_ROWS, 1] and Gaussians [1, COLUMNS]."""
    return tl.arange(0, TILE_ROWS)[:, None], tl.program_id(0) * LINE + tl.arange(0, LINE)[None, :]


@triton.jit
def _store_state(state, colour, shine, frame, row, at, moved, columns):  # type: ignore[no-untyped-def]
    """Store the state, and the colour of the constant harmonic and the gloss.

    shine [F, 2]: side and dim of the frame's camera (intrasplat/splat/camera.py).
    """
    tl.store(state + (frame * STATE_ROWS + row) * columns + at, moved, mask=row < STATE_ROWS)
    gloss = tl.sum(tl.where(row == GLOSS_ROW, moved, 0.0), 0)[None, :]
    seen = tl.load(shine + 2 * frame) * gloss - tl.load(shine + 2 * frame + 1) * tl.abs(gloss)
    shown = tl.maximum(moved * CONSTANT_HARMONIC + 0.5 + seen, 0.0)
    is_colour = (row >= COLOUR_ROW) & (row < GLOSS_ROW)
    tl.store(colour + (frame * 3 + row - COLOUR_ROW) * columns + at, shown, mask=is_colour)


@triton.jit(do_not_specialize=["bases"])
def deform_linear(  # type: ignore[no-untyped-def]
    values, weight, basis, span, state, colour, shine, columns, bases, CHANNELS: tl.constexpr
):
    """Write state = canonical + sum over j in span of basis_j weight_j, and its colour. Grid (lines, F).

    weight [B, C, columns], basis [F, B], span int32 [F, 2]: the first of the bases in use and the one after the last.
    """
    frame = tl.program_id(1)
    row, at = _place()
    moved = tl.load(values + row * columns + at, mask=row < STATE_ROWS, other=0.0)
    j, last = tl.load(span + 2 * frame), tl.load(span + 2 * frame + 1)
    while j < last:
        weights = tl.load(weight + (j * CHANNELS + row) * columns + at, mask=row < CHANNELS, other=0.0)
        moved += tl.load(basis + frame * bases + j) * weights
        j += 1
    _store_state(state, colour, shine, frame, row, at, moved, columns)


@triton.jit(do_not_specialize=["bases", "tiles"])
def update_linear(  # type: ignore[no-untyped-def]
    values, moments, weight, first, second, v_state, v_opacity, v_colour, colour, shine, touched, statistics, ok,
    report, slot, size, floor, betas, basis, alive, basis_size, basis_floor, channel_rate, columns, bases, tiles,
    CHANNELS: tl.constexpr, FRAMES: tl.constexpr,
):  # fmt: skip
    """Adam on the values and on the weights of the bases in use; writes the report. Grid (lines,).

    weight and its moments [B, C, columns]; basis [F, B], 0 where a frame does not use it; alive int32 [1 + B]: how many
    bases are in use, and which. Their step's size is basis_size [B] times channel_rate [14], its floor basis_floor [B].
    """
    row, at = _place()
    if tl.load(ok) != 0:
        report_step(touched, statistics, report, slot, at, columns, tiles, FRAMES)
        total = update_values(
            values, moments, v_state, v_opacity, v_colour, colour, shine, size, floor, betas, row, at, columns, FRAMES
        )  # fmt: skip
        rate = tl.load(channel_rate + row, mask=row < CHANNELS, other=0.0)
        used, left = rate != 0.0, tl.load(alive)
        while left > 0:
            j = tl.load(alive + left)
            place = (j * CHANNELS + row) * columns + at
            value, m, v = load_trained(weight, first, second, place, used)
            if FRAMES == 1:
                gradient = tl.load(basis + j) * total
            else:
                gradient = tl.zeros_like(total)
                for frame in tl.static_range(FRAMES):
                    share = gradient_of_values(v_state, v_opacity, v_colour, colour, shine, frame, row, at, columns)
                    gradient += tl.load(basis + frame * bases + j) * share
            step, low = tl.load(basis_size + j) * rate, tl.load(basis_floor + j)
            value, m, v = adam(value, m, v, gradient, step, low, betas)
            store_trained(weight, first, second, place, used, value, m, v)
            left -= 1


@triton.jit
def fdm_basis(t, centre, width, QUARTIC: tl.constexpr):  # type: ignore[no-untyped-def]
    """Value of a basis at t, and its logarithmic derivatives to centre and width.

    gaussian: exp(-d^2 / (2 s^2)), d = t - centre;  quartic: exp(-(d^2 / (s^2 + QUARTIC_FLOOR))^2).
    """
    d = t - centre
    if QUARTIC:
        spread = width * width + _QUARTIC_FLOOR
        ratio = d * d / spread
        value = tl.exp2(ratio * ratio * -_LOG2E)
        slope = 4.0 * ratio / spread
        by_centre, by_width = slope * d, slope * ratio * width
    else:
        size = tl.abs(width)
        inverse = 1.0 / tl.maximum(size, _MIN_WIDTH)
        along = d * inverse
        value = tl.exp2(along * along * (-0.5 * _LOG2E))
        sign = tl.where(width < 0.0, -1.0, 1.0)
        by_centre = along * inverse
        by_width = tl.where(size < _MIN_WIDTH, 0.0, along * along * inverse * sign)  # no gradient through the floor
    return value, by_centre, by_width


@triton.jit(do_not_specialize=["bases"])
def deform_fdm(  # type: ignore[no-untyped-def]
    values, weight, centre, width, time, state, colour, shine, columns, bases, QUARTIC: tl.constexpr
):
    """Write state = canonical + FDM at the frames' times, and its colour. Grid (lines, F).

    weight, centre, width [10, B, columns] (Deform3DGS, equations 3 and 4); time [F].
    """
    frame = tl.program_id(1)
    row, at = _place()
    moved = tl.load(values + row * columns + at, mask=row < STATE_ROWS, other=0.0)
    used, t, left = row < FDM_CHANNELS, tl.load(time + frame), bases
    while left > 0:
        left -= 1
        place = (row * bases + left) * columns + at
        centres = tl.load(centre + place, mask=used, other=0.0)
        widths = tl.load(width + place, mask=used, other=1.0)
        value, _, _ = fdm_basis(t, centres, widths, QUARTIC)
        moved += tl.load(weight + place, mask=used, other=0.0) * value
    _store_state(state, colour, shine, frame, row, at, moved, columns)


@triton.jit(do_not_specialize=["bases", "tiles"])
def update_fdm(  # type: ignore[no-untyped-def]
    values, moments, weight, centre, width, first, second, v_state, v_opacity, v_colour, colour, shine, touched,
    statistics, ok, report, slot, size, floor, betas, time, motion_size, columns, bases, tiles,
    QUARTIC: tl.constexpr, FRAMES: tl.constexpr,
):  # fmt: skip
    """Adam on the values and on weight, centre and width of every basis; writes the report. Grid (lines,).

    Moments of the motion [3, 10, B, columns]; motion_size [1]: the size of its step.
    """
    row, at = _place()
    if tl.load(ok) != 0:
        report_step(touched, statistics, report, slot, at, columns, tiles, FRAMES)
        total = update_values(
            values, moments, v_state, v_opacity, v_colour, colour, shine, size, floor, betas, row, at, columns, FRAMES
        )  # fmt: skip
        step, low, group = tl.load(motion_size), tl.load(floor), FDM_CHANNELS * bases * columns
        used, left = row < FDM_CHANNELS, bases
        if step == 0.0:
            left *= 0
        while left > 0:
            left -= 1
            place = (row * bases + left) * columns + at
            w, w_m, w_v = load_trained(weight, first, second, place, used)
            c, c_m, c_v = load_trained(centre, first + group, second + group, place, used)
            s, s_m, s_v = load_trained(width, first + 2 * group, second + 2 * group, place, used)
            value, by_centre, by_width = fdm_basis(tl.load(time), c, s, QUARTIC)
            if FRAMES == 1:
                share = total * value
            else:
                share = value * gradient_of_values(v_state, v_opacity, v_colour, colour, shine, 0, row, at, columns)
            to_w, to_c, to_s = share, share * w * by_centre, share * w * by_width
            for frame in tl.static_range(1, FRAMES):
                value, by_centre, by_width = fdm_basis(tl.load(time + frame), c, s, QUARTIC)
                share = gradient_of_values(v_state, v_opacity, v_colour, colour, shine, frame, row, at, columns)
                share = share * value
                to_w += share
                to_c += share * w * by_centre
                to_s += share * w * by_width
            w, w_m, w_v = adam(w, w_m, w_v, to_w, step, low, betas)
            c, c_m, c_v = adam(c, c_m, c_v, to_c, step, low, betas)
            s, s_m, s_v = adam(s, s_m, s_v, to_s, step, low, betas)
            store_trained(weight, first, second, place, used, w, w_m, w_v)
            store_trained(centre, first + group, second + group, place, used, c, c_m, c_v)
            store_trained(width, first + 2 * group, second + 2 * group, place, used, s, s_m, s_v)
