"""Spherical harmonics to colour and back on the device, and Adam on all of them but the constant one.

N Gaussians in rows of `columns` floats, F frames, K = (degree + 1)^2 coefficients per channel: the constant one in rows
10:13 of the state, the others in rest [K - 1, 3, columns]; colour [F, 3, columns], mean in rows 0:3 of the state
[F, 13, columns]; centre [F, 3] of the cameras. The equations are those of intrasplat/splat/cpu/harmonics.py.
"""

from __future__ import annotations

from collections.abc import Mapping

import triton
import triton.language as tl
from torch import Tensor

from intrasplat.splat.constants import SH_C1, SH_C2, SH_C3
from intrasplat.splat.cuda.update import COLOUR_ROW, CONSTANT_HARMONIC, STATE_ROWS, adam, load_trained, store_trained

BLOCK = 128
"""Gaussians per program, one per thread: a direction and its slopes stay in registers."""

C1 = tl.constexpr(SH_C1)
C2_XY, C2_ZZ, C2_XX = (tl.constexpr(each) for each in SH_C2)
C3_YYY, C3_XYZ, C3_YZZ, C3_ZZZ, C3_XXZ = (tl.constexpr(each) for each in SH_C3)


@triton.jit
def _term(K: tl.constexpr, x, y, z):  # type: ignore[no-untyped-def]
    """The K-th real harmonic (from 1; 0 is constant) at the unit direction (x, y, z), and its polynomial's slopes."""
    none = tl.zeros_like(x)
    if K == 1:
        value, by_x, by_y, by_z = -C1 * y, none, none - C1, none
    elif K == 2:
        value, by_x, by_y, by_z = C1 * z, none, none, none + C1
    elif K == 3:
        value, by_x, by_y, by_z = -C1 * x, none - C1, none, none
    elif K == 4:
        value, by_x, by_y, by_z = C2_XY * x * y, C2_XY * y, C2_XY * x, none
    elif K == 5:
        value, by_x, by_y, by_z = -C2_XY * y * z, none, -C2_XY * z, -C2_XY * y
    elif K == 6:
        value = C2_ZZ * (2 * z * z - x * x - y * y)
        by_x, by_y, by_z = -2 * C2_ZZ * x, -2 * C2_ZZ * y, 4 * C2_ZZ * z
    elif K == 7:
        value, by_x, by_y, by_z = -C2_XY * x * z, -C2_XY * z, none, -C2_XY * x
    elif K == 8:
        value, by_x, by_y, by_z = C2_XX * (x * x - y * y), 2 * C2_XX * x, -2 * C2_XX * y, none
    elif K == 9:
        value = -C3_YYY * y * (3 * x * x - y * y)
        by_x, by_y, by_z = -6 * C3_YYY * x * y, -3 * C3_YYY * (x * x - y * y), none
    elif K == 10:
        value, by_x, by_y, by_z = C3_XYZ * x * y * z, C3_XYZ * y * z, C3_XYZ * x * z, C3_XYZ * x * y
    elif K == 11:
        value = -C3_YZZ * y * (4 * z * z - x * x - y * y)
        by_x, by_y, by_z = (
            2 * C3_YZZ * x * y,
            -C3_YZZ * (4 * z * z - x * x - 3 * y * y),
            -8 * C3_YZZ * y * z,
        )
    elif K == 12:
        value = C3_ZZZ * z * (2 * z * z - 3 * x * x - 3 * y * y)
        by_x, by_y, by_z = (
            -6 * C3_ZZZ * x * z,
            -6 * C3_ZZZ * y * z,
            3 * C3_ZZZ * (2 * z * z - x * x - y * y),
        )
    elif K == 13:
        value = -C3_YZZ * x * (4 * z * z - x * x - y * y)
        by_x, by_y, by_z = (
            -C3_YZZ * (4 * z * z - 3 * x * x - y * y),
            2 * C3_YZZ * x * y,
            -8 * C3_YZZ * x * z,
        )
    elif K == 14:
        value = C3_XXZ * z * (x * x - y * y)
        by_x, by_y, by_z = 2 * C3_XXZ * x * z, -2 * C3_XXZ * y * z, C3_XXZ * (x * x - y * y)
    else:
        value = -C3_YYY * x * (x * x - 3 * y * y)
        by_x, by_y, by_z = -3 * C3_YYY * (x * x - y * y), 6 * C3_YYY * x * y, none
    return value, by_x, by_y, by_z


@triton.jit
def _term_number(k, x, y, z, TERMS: tl.constexpr):  # type: ignore[no-untyped-def]
    """The value of _term for a k that is known only at run time."""
    value = tl.zeros_like(x)
    for K in tl.static_range(1, TERMS):
        if k == K:
            value += _value(K, x, y, z)
    return value


@triton.jit
def _value(K: tl.constexpr, x, y, z):  # type: ignore[no-untyped-def]
    value, _, _, _ = _term(K, x, y, z)
    return value


@triton.jit
def _direction(state, centre, frame, at, inside, columns):  # type: ignore[no-untyped-def]
    """Unit vector from the frame's camera to the means, and one over the distance."""
    mean, eye = state + frame * STATE_ROWS * columns + at, centre + 3 * frame
    x = tl.load(mean, mask=inside, other=1.0) - tl.load(eye)
    y = tl.load(mean + columns, mask=inside, other=1.0) - tl.load(eye + 1)
    z = tl.load(mean + 2 * columns, mask=inside, other=1.0) - tl.load(eye + 2)
    nearness = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-12)
    return x * nearness, y * nearness, z * nearness, nearness


@triton.jit
def _colour_gradient(v_colour, colour, frame, channel, at, inside, columns):  # type: ignore[no-untyped-def]
    """dL/d of a colour before it was clamped at 0."""
    place = (frame * 3 + channel) * columns + at
    shown = tl.load(colour + place, mask=inside, other=0.0) > 0.0
    return tl.load(v_colour + place, mask=inside & shown, other=0.0)


@triton.jit
def colour_from_sh(  # type: ignore[no-untyped-def]
    rest, state, centre, colour, columns, TERMS: tl.constexpr, BLOCK: tl.constexpr
):
    """colour = max(0, 0.5 + sum_k c_k Y_k(direction from the camera to the mean)), k < TERMS. Grid (blocks, F)."""
    frame = tl.program_id(1)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < columns
    x, y, z, _ = _direction(state, centre, frame, at, inside, columns)
    constant = state + (frame * STATE_ROWS + COLOUR_ROW) * columns + at
    red = 0.5 + CONSTANT_HARMONIC * tl.load(constant, mask=inside, other=0.0)
    green = 0.5 + CONSTANT_HARMONIC * tl.load(constant + columns, mask=inside, other=0.0)
    blue = 0.5 + CONSTANT_HARMONIC * tl.load(constant + 2 * columns, mask=inside, other=0.0)
    for k in tl.static_range(1, TERMS):
        value, _, _, _ = _term(k, x, y, z)
        coefficient = rest + (k - 1) * 3 * columns + at
        red += tl.load(coefficient, mask=inside, other=0.0) * value
        green += tl.load(coefficient + columns, mask=inside, other=0.0) * value
        blue += tl.load(coefficient + 2 * columns, mask=inside, other=0.0) * value
    out = colour + frame * 3 * columns + at
    tl.store(out, tl.maximum(red, 0.0), mask=inside)
    tl.store(out + columns, tl.maximum(green, 0.0), mask=inside)
    tl.store(out + 2 * columns, tl.maximum(blue, 0.0), mask=inside)


@triton.jit
def colour_from_sh_backward(  # type: ignore[no-untyped-def]
    rest, state, centre, colour, v_colour, v_state, columns, TERMS: tl.constexpr, BLOCK: tl.constexpr
):
    """Add the directions' share to rows 0:3 of v_state [F, 10, columns]; update.py finds the constant harmonic's in
    v_colour. Grid (blocks, F)."""
    frame = tl.program_id(1)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < columns
    x, y, z, nearness = _direction(state, centre, frame, at, inside, columns)
    red = _colour_gradient(v_colour, colour, frame, 0, at, inside, columns)
    green = _colour_gradient(v_colour, colour, frame, 1, at, inside, columns)
    blue = _colour_gradient(v_colour, colour, frame, 2, at, inside, columns)
    v_x, v_y, v_z = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for k in tl.static_range(1, TERMS):
        _, by_x, by_y, by_z = _term(k, x, y, z)
        coefficient = rest + (k - 1) * 3 * columns + at
        share = red * tl.load(coefficient, mask=inside, other=0.0)
        share += green * tl.load(coefficient + columns, mask=inside, other=0.0)
        share += blue * tl.load(coefficient + 2 * columns, mask=inside, other=0.0)
        v_x += share * by_x
        v_y += share * by_y
        v_z += share * by_z
    along = v_x * x + v_y * y + v_z * z
    out = v_state + frame * COLOUR_ROW * columns + at
    tl.store(out, tl.load(out, mask=inside, other=0.0) + nearness * (v_x - along * x), mask=inside)
    out += columns
    tl.store(out, tl.load(out, mask=inside, other=0.0) + nearness * (v_y - along * y), mask=inside)
    out += columns
    tl.store(out, tl.load(out, mask=inside, other=0.0) + nearness * (v_z - along * z), mask=inside)


@triton.jit
def update_rest(  # type: ignore[no-untyped-def]
    rest, moments, state, centre, colour, v_colour, ok, size, floor, betas, columns, coefficients,
    TERMS: tl.constexpr, FRAMES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adam on the coefficients in use, 1 <= k < TERMS. moments [2, coefficients, columns] with coefficients =
    3 (K - 1), size and floor [1]. Grid (blocks, TERMS - 1): a program has one k. After colour_from_sh_backward, which
    reads what this changes."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, k = at < columns, 1 + tl.program_id(1)
    if tl.load(ok) != 0:
        step, low = tl.load(size), tl.load(floor)
        if step != 0.0:
            second, place = moments + coefficients * columns, (k - 1) * 3 * columns + at
            r, r_m, r_v = load_trained(rest, moments, second, place, inside)
            g, g_m, g_v = load_trained(rest, moments, second, place + columns, inside)
            b, b_m, b_v = load_trained(rest, moments, second, place + 2 * columns, inside)
            red, green, blue = tl.zeros_like(r), tl.zeros_like(r), tl.zeros_like(r)
            for frame in tl.static_range(FRAMES):
                x, y, z, _ = _direction(state, centre, frame, at, inside, columns)
                value = _term_number(k, x, y, z, TERMS)
                red += value * _colour_gradient(v_colour, colour, frame, 0, at, inside, columns)
                green += value * _colour_gradient(v_colour, colour, frame, 1, at, inside, columns)
                blue += value * _colour_gradient(v_colour, colour, frame, 2, at, inside, columns)
            r, r_m, r_v = adam(r, r_m, r_v, red, step, low, betas)
            g, g_m, g_v = adam(g, g_m, g_v, green, step, low, betas)
            b, b_m, b_v = adam(b, b_m, b_v, blue, step, low, betas)
            store_trained(rest, moments, second, place, inside, r, r_m, r_v)
            store_trained(rest, moments, second, place + columns, inside, g, g_m, g_v)
            store_trained(rest, moments, second, place + 2 * columns, inside, b, b_m, b_v)


def _grid(columns: int, *beside: int) -> tuple[int, ...]:
    return (triton.cdiv(columns, BLOCK), *beside)


def evaluate(rest: Tensor, state: Tensor, centre: Tensor, colour: Tensor, degree: int) -> None:
    """Write the colour seen from the cameras, with harmonics up to `degree`, at least 1."""
    frames, _, columns = state.shape
    colour_from_sh[_grid(columns, frames)](rest, state, centre, colour, columns, TERMS=(degree + 1) ** 2, BLOCK=BLOCK)


def evaluate_backward(
    rest: Tensor, state: Tensor, centre: Tensor, colour: Tensor, v_colour: Tensor, v_state: Tensor, degree: int
) -> None:
    """Add dL/dmean through the directions, from dL/dcolour [F, 3, columns], to rows 0:3 of v_state [F, 10, columns]."""
    frames, _, columns = state.shape
    colour_from_sh_backward[_grid(columns, frames)](
        rest, state, centre, colour, v_colour, v_state, columns, TERMS=(degree + 1) ** 2, BLOCK=BLOCK
    )


def update(
    rest: Tensor,
    moments: Tensor,
    state: Tensor,
    centre: Tensor,
    colour: Tensor,
    v_colour: Tensor,
    ok: Tensor,
    control: Mapping[str, Tensor],
    degree: int,
) -> None:
    """One step of Adam on the harmonics up to `degree`, after evaluate_backward. control: adam_fields (control.py)."""
    frames, _, columns = state.shape
    terms = (degree + 1) ** 2
    update_rest[_grid(columns, terms - 1)](
        rest, moments, state, centre, colour, v_colour, ok, control["rest_size"], control["floor"],
        control["betas"], columns, rest.shape[0] * 3, TERMS=terms, FRAMES=frames, BLOCK=BLOCK,
    )  # fmt: skip
