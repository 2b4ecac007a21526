"""The colour of a state and its gradient, with gloss or with spherical harmonics (in torch: splat/gaussians.py).

N Gaussians, K = (degree + 1)^2 coefficients per channel: the constant one in state[COLOUR], the others in
rest [K - 1, 3, N]; colour [3, N], mean in state[MEAN].
"""

from __future__ import annotations

import math

import numpy as np

from intrasplat.machine.cache import kernel
from intrasplat.splat.constants import SH_C0, SH_C1, SH_C2, SH_C3
from intrasplat.splat.cpu.simd import load, maximum, splat, store, where_less
from intrasplat.splat.cpu.vectors import LANES
from intrasplat.splat.layout import COLOUR_ROW, DIM, GLOSS_ROW, MEAN_ROW, SIDE

_C2 = (SH_C2[0], -SH_C2[0], SH_C2[1], -SH_C2[0], SH_C2[2])
_C3 = (-SH_C3[0], SH_C3[1], -SH_C3[2], SH_C3[3], -SH_C3[2], SH_C3[4], -SH_C3[0])


_ZERO, _ONE, _HALF, _C0 = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(SH_C0)


@kernel
def colour_from_gloss(thread, threads, camera, state, colour):  # type: ignore[no-untyped-def]
    """colour = max(0, 0.5 + c Y_0 + side g - dim |g|), of the camera's side and dim."""
    zero, side, dim = splat(_ZERO), splat(np.float32(camera[SIDE])), splat(np.float32(camera[DIM]))
    has_gloss = camera[SIDE] != 0.0 or camera[DIM] != 0.0
    vectors = state.shape[1] // LANES
    for k in range(vectors * thread // threads, vectors * (thread + 1) // threads):
        i = k * LANES
        seen = zero
        if has_gloss:
            gloss = load(state[GLOSS_ROW], i)
            seen = side * gloss - dim * maximum(gloss, zero - gloss)
        for channel in range(3):
            shown = load(state[COLOUR_ROW + channel], i) * splat(_C0) + splat(_HALF) + seen
            store(colour[channel], i, where_less(shown, zero, zero, shown))


@kernel
def colour_from_gloss_backward(  # type: ignore[no-untyped-def]
    thread, threads, camera, state, colour, v_colour, adds, v_state
):
    """Write v_state[COLOUR] and v_state[GLOSS], or add to them. A colour that was clamped at 0 has no gradient."""
    zero, one = splat(_ZERO), splat(_ONE)
    side, dim = splat(np.float32(camera[SIDE])), splat(np.float32(camera[DIM]))
    vectors = state.shape[1] // LANES
    for k in range(vectors * thread // threads, vectors * (thread + 1) // threads):
        i = k * LANES
        gloss = load(state[GLOSS_ROW], i)
        shine = side - dim * (where_less(zero, gloss, one, zero) - where_less(gloss, zero, one, zero))
        total = zero
        for channel in range(3):
            gradient = load(v_colour[channel], i) * where_less(zero, load(colour[channel], i), one, zero)
            total = total + gradient
            before = load(v_state[COLOUR_ROW + channel], i) if adds else zero
            store(v_state[COLOUR_ROW + channel], i, before + gradient * splat(_C0))
        before = load(v_state[GLOSS_ROW], i) if adds else zero
        store(v_state[GLOSS_ROW], i, before + total * shine)


@kernel
def _terms(degree, x, y, z, value, slope):  # type: ignore[no-untyped-def]
    """Write the real harmonics at the unit direction (x, y, z) into value [K], their derivatives into slope [K, 3]."""
    value[0] = SH_C0
    slope[:, :] = 0.0
    if degree >= 1:
        value[1], value[2], value[3] = -SH_C1 * y, SH_C1 * z, -SH_C1 * x
        slope[1, 1], slope[2, 2], slope[3, 0] = -SH_C1, SH_C1, -SH_C1
    if degree >= 2:
        a, b, c, d, e = _C2
        value[4], value[5], value[6] = a * x * y, b * y * z, c * (2 * z * z - x * x - y * y)
        value[7], value[8] = d * x * z, e * (x * x - y * y)
        slope[4, 0], slope[4, 1] = a * y, a * x
        slope[5, 1], slope[5, 2] = b * z, b * y
        slope[6, 0], slope[6, 1], slope[6, 2] = -2 * c * x, -2 * c * y, 4 * c * z
        slope[7, 0], slope[7, 2] = d * z, d * x
        slope[8, 0], slope[8, 1] = 2 * e * x, -2 * e * y
    if degree >= 3:
        a, b, c, d, e, f, h = _C3
        value[9] = a * y * (3 * x * x - y * y)
        slope[9, 0], slope[9, 1] = 6 * a * x * y, a * (3 * x * x - 3 * y * y)
        value[10] = b * x * y * z
        slope[10, 0], slope[10, 1], slope[10, 2] = b * y * z, b * x * z, b * x * y
        value[11] = c * y * (4 * z * z - x * x - y * y)
        slope[11, 0], slope[11, 1], slope[11, 2] = -2 * c * x * y, c * (4 * z * z - x * x - 3 * y * y), 8 * c * y * z
        value[12] = d * z * (2 * z * z - 3 * x * x - 3 * y * y)
        slope[12, 0], slope[12, 1] = -6 * d * x * z, -6 * d * y * z
        slope[12, 2] = d * (6 * z * z - 3 * x * x - 3 * y * y)
        value[13] = e * x * (4 * z * z - x * x - y * y)
        slope[13, 0], slope[13, 1], slope[13, 2] = e * (4 * z * z - 3 * x * x - y * y), -2 * e * x * y, 8 * e * x * z
        value[14] = f * z * (x * x - y * y)
        slope[14, 0], slope[14, 1], slope[14, 2] = 2 * f * x * z, -2 * f * y * z, f * (x * x - y * y)
        value[15] = h * x * (x * x - 3 * y * y)
        slope[15, 0], slope[15, 1] = h * (3 * x * x - 3 * y * y), -6 * h * x * y


@kernel
def _direction(state, centre, g):  # type: ignore[no-untyped-def]
    """Unit vector from the camera to Gaussian g, and one over the distance."""
    x = state[MEAN_ROW, g] - centre[0]
    y = state[MEAN_ROW + 1, g] - centre[1]
    z = state[MEAN_ROW + 2, g] - centre[2]
    n = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return x * n, y * n, z * n, n


@kernel
def colour_from_sh(thread, threads, degree, centre, state, rest, colour):  # type: ignore[no-untyped-def]
    """colour = max(0, 0.5 + sum_k c_k Y_k(direction from the camera centre to the mean))."""
    terms = (degree + 1) * (degree + 1)
    value, slope = np.empty(terms), np.empty((terms, 3))
    count = state.shape[1]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        x, y, z, _ = _direction(state, centre, g)
        _terms(degree, x, y, z, value, slope)
        for channel in range(3):
            total = 0.5 + SH_C0 * state[COLOUR_ROW + channel, g]
            for k in range(1, terms):
                total += rest[k - 1, channel, g] * value[k]
            colour[channel, g] = max(total, 0.0)


@kernel
def colour_from_sh_backward(  # type: ignore[no-untyped-def]
    thread, threads, degree, centre, state, rest, colour, v_colour, adds, adds_state, v_rest, v_state
):
    """Write v_rest [K - 1, 3, N] and v_state[COLOUR], or add to them; add the direction's share to v_state[MEAN]."""
    terms = (degree + 1) * (degree + 1)
    value, slope, v_direction = np.empty(terms), np.empty((terms, 3)), np.empty(3)
    count = state.shape[1]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        x, y, z, n = _direction(state, centre, g)
        _terms(degree, x, y, z, value, slope)
        v_direction[:] = 0.0
        for channel in range(3):
            gradient = v_colour[channel, g] if colour[channel, g] > 0.0 else np.float32(0.0)
            before = v_state[COLOUR_ROW + channel, g] if adds_state else np.float32(0.0)
            v_state[COLOUR_ROW + channel, g] = before + np.float32(gradient * SH_C0)
            for k in range(1, terms):
                before = v_rest[k - 1, channel, g] if adds else np.float32(0.0)
                v_rest[k - 1, channel, g] = before + np.float32(gradient * value[k])
                for axis in range(3):
                    v_direction[axis] += gradient * rest[k - 1, channel, g] * slope[k, axis]
        along = v_direction[0] * x + v_direction[1] * y + v_direction[2] * z
        v_state[MEAN_ROW, g] += n * (v_direction[0] - along * x)
        v_state[MEAN_ROW + 1, g] += n * (v_direction[1] - along * y)
        v_state[MEAN_ROW + 2, g] += n * (v_direction[2] - along * z)
