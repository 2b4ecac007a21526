"""The blend: front-to-back compositing of a tile, the loss on it, and the gradients of its splats, in one visit.

Symbols, for one pixel and its splats i = 0, 1, ... nearest first:
    alpha_i = min(MAX_ALPHA, 2**power2_i), 0 below MIN_ALPHA or once T < MIN_TRANSMITTANCE
    T_i     = product over j < i of (1 - alpha_j);  w_i = alpha_i T_i
    C       = sum w_i c_i,  Z = sum w_i z_i,  A = sum w_i = 1 - T_end
    s_i     = g_C . c_i + g_Z z_i + g_A, with g the loss gradient at this pixel
    dL/dalpha_i = T_i (s_i - B_i),  B_{i-1} = alpha_i s_i + (1 - alpha_i) B_i,  B_last = 0
so going back to front needs no division, and dL/dpower_i = w_i (s_i - B_i). The forward pass leaves alpha and w of
every row it visited in ``trail``; the loss needs only the pixel's own colour, so no gradient image ever exists.
Derivation: docs/rasterizer.md.

A tile's planes lie in ``planes``, PLANE floats apart: T (later B and g_A), then R G B Z (later g_R g_G g_B g_Z).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from worker.raster import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from worker.raster.cpu.bins import TILE_ROWS
from worker.raster.cpu.simd import (
    LANES,
    exp2,
    fma,
    iota,
    lane_max,
    lane_sum,
    load,
    load_bytes,
    minimum,
    splat,
    store,
    where_less,
)

PLANE = TILE_ROWS * LANES
PLANES = 6
RENDER, LOSS, COTANGENT = 0, 1, 2
"""Modes: images only; images never, gradients of the built-in loss; gradients of given image cotangents."""
STATISTICS = 4
"""Sums a tile reports: colour loss, depth loss, squared colour error (of channels), |1 - A| over tissue."""

_CUT = np.float32(np.log2(MIN_ALPHA))
_CAP = np.float32(MAX_ALPHA)
_STOP = np.float32(MIN_TRANSMITTANCE)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)
_CHECK_EVERY = 32  # splats between two looks at whether the whole tile is opaque


@njit(cache=True, nogil=True)
def blend(  # type: ignore[no-untyped-def]
    thread, threads, mode, width, height, tiles_x, splats, slot_splat, slot_rows, tile_start, tile_slots,
    trail, planes, slots, statistics, target, weight, inverse_depth, loss_settings, image,
):  # fmt: skip
    """Composite every tile; tiles are dealt to the threads in turn.

    trail [threads, 2 * rows * LANES] and planes [threads, PLANES * PLANE]: scratch.
    slots [M, 10]: written in modes LOSS and COTANGENT (GRADIENT of project.py). statistics [tiles, STATISTICS]: LOSS.
    target [3, H, stride] uint8, weight [H, stride] uint8 (255 = tissue), inverse_depth [H, stride] float32 (0 = none):
    LOSS, flattened, stride = tiles_x * LANES. loss_settings float32 [5]: colour weight a channel, depth weight,
    1 / width of the quadratic zone of the colour and of the depth loss, 1 for normalised depth else 0.
    image [5, H, stride] flattened: R G B Z A, written in RENDER, read as cotangents in COTANGENT.
    """
    tiles = tile_start.shape[0] - 1
    size = height * tiles_x * LANES
    for tile in range(thread, tiles, threads):
        row0, column0 = tile // tiles_x * TILE_ROWS, tile % tiles_x * LANES
        rows = min(TILE_ROWS, height - row0)
        first, end = tile_start[tile], tile_start[tile + 1]
        visited = _forward(
            first, end, row0, column0, width, rows, mode != RENDER,
            splats, slot_splat, slot_rows, tile_slots, trail[thread], planes[thread],
        )  # fmt: skip
        origin, stride = row0 * tiles_x * LANES + column0, tiles_x * LANES
        if mode == RENDER:
            _write(planes[thread], image, origin, stride, size, rows)
            continue
        if mode == LOSS:
            _loss(
                planes[thread], statistics[tile], target, weight, inverse_depth, loss_settings,
                origin, stride, size, rows,
            )  # fmt: skip
        else:
            _read_cotangents(planes[thread], image, origin, stride, size, rows)
        for i in range(visited, end):  # behind the opaque front: no gradient
            slots[tile_slots[i], :] = _ZERO
        _backward(
            first, visited, row0, column0,
            splats, slot_splat, slot_rows, tile_slots, trail[thread], planes[thread], slots,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _forward(  # type: ignore[no-untyped-def]
    first, end, row0, column0, width, rows, keep, splats, slot_splat, slot_rows, tile_slots, trail, planes
):
    """Blend the tile's slots [first, end) into planes; return the end of those visited before the tile was opaque."""
    zero, cut, cap, stop = splat(_ZERO), splat(_CUT), splat(_CAP), splat(_STOP)
    lanes = iota()
    inside = where_less(lanes + splat(np.float32(column0)), splat(np.float32(width)), splat(_ONE), zero)
    for row in range(rows):
        store(planes, row * LANES, inside)
    for at in range(PLANE, 5 * PLANE, LANES):
        store(planes, at, zero)
    at = 0
    for i in range(first, end):
        slot = tile_slots[i]
        g = slot_splat[slot]
        dx = lanes + splat(np.float32(column0) + _HALF - splats[g, 0])
        k_xx = splat(splats[g, 2])
        red, green, blue, depth = splat(splats[g, 6]), splat(splats[g, 7]), splat(splats[g, 8]), splat(splats[g, 9])
        dy = np.float32(row0 + slot_rows[slot, 0]) + _HALF - splats[g, 1]
        for row in range(slot_rows[slot, 0], slot_rows[slot, 1]):
            p = row * LANES
            power = fma(dx, fma(dx, k_xx, splat(splats[g, 3] * dy)), splat(splats[g, 5] + splats[g, 4] * dy * dy))
            transmittance = load(planes, p)
            alpha = where_less(power, cut, zero, minimum(exp2(power), cap))
            alpha = where_less(transmittance, stop, zero, alpha)
            weight = alpha * transmittance
            store(planes, p, transmittance - weight)
            store(planes, p + PLANE, fma(weight, red, load(planes, p + PLANE)))
            store(planes, p + 2 * PLANE, fma(weight, green, load(planes, p + 2 * PLANE)))
            store(planes, p + 3 * PLANE, fma(weight, blue, load(planes, p + 3 * PLANE)))
            store(planes, p + 4 * PLANE, fma(weight, depth, load(planes, p + 4 * PLANE)))
            if keep:
                store(trail, at, alpha)
                store(trail, at + LANES, weight)
                at += 2 * LANES
            dy += _ONE
        if (i - first) % _CHECK_EVERY == _CHECK_EVERY - 1:
            clearest = zero
            for row in range(rows):
                transmittance = load(planes, row * LANES)
                clearest = where_less(clearest, transmittance, transmittance, clearest)
            if lane_max(clearest) < _STOP:
                return i + 1
    return end


@njit(cache=True, nogil=True)
def _backward(  # type: ignore[no-untyped-def]
    first, end, row0, column0, splats, slot_splat, slot_rows, tile_slots, trail, planes, slots
):
    """Gradients of the slots [first, end), back to front; planes hold g_R g_G g_B g_Z at 1..4, g_A at 5, B at 0."""
    zero, cap = splat(_ZERO), splat(_CAP)
    lanes = iota()
    at = 0
    for i in range(first, end):
        slot = tile_slots[i]
        at += (slot_rows[slot, 1] - slot_rows[slot, 0]) * 2 * LANES
    for i in range(end - 1, first - 1, -1):
        slot = tile_slots[i]
        g = slot_splat[slot]
        dx = lanes + splat(np.float32(column0) + _HALF - splats[g, 0])
        red, green, blue, depth = splat(splats[g, 6]), splat(splats[g, 7]), splat(splats[g, 8]), splat(splats[g, 9])
        top, bottom = slot_rows[slot, 0], slot_rows[slot, 1]
        at -= (bottom - top) * 2 * LANES
        v_red, v_green, v_blue, v_depth = zero, zero, zero, zero
        moment, moment_y, moment_yy = zero, zero, zero
        dy = np.float32(row0 + top) + _HALF - splats[g, 1]
        trace = at
        for row in range(top, bottom):
            p = row * LANES
            alpha, weight = load(trail, trace), load(trail, trace + LANES)
            trace += 2 * LANES
            g_red, g_green = load(planes, p + PLANE), load(planes, p + 2 * PLANE)
            g_blue, g_depth = load(planes, p + 3 * PLANE), load(planes, p + 4 * PLANE)
            behind = load(planes, p)
            score = fma(g_red, red, fma(g_green, green, load(planes, p + 5 * PLANE)))
            score = fma(g_blue, blue, fma(g_depth, depth, score)) - behind
            store(planes, p, fma(alpha, score, behind))
            v_red, v_green = fma(weight, g_red, v_red), fma(weight, g_green, v_green)
            v_blue, v_depth = fma(weight, g_blue, v_blue), fma(weight, g_depth, v_depth)
            v_power = where_less(alpha, cap, weight * score, zero)
            moment = moment + v_power
            along = v_power * splat(dy)
            moment_y = moment_y + along
            moment_yy = fma(along, splat(dy), moment_yy)
            dy += _ONE
        moment_x = moment * dx
        slots[slot, 0], slots[slot, 1], slots[slot, 2] = lane_sum(v_red), lane_sum(v_green), lane_sum(v_blue)
        slots[slot, 3] = lane_sum(v_depth)
        slots[slot, 4] = lane_sum(moment)
        slots[slot, 5], slots[slot, 6] = lane_sum(moment_x), lane_sum(moment_y)
        slots[slot, 7], slots[slot, 8] = lane_sum(moment_x * dx), lane_sum(moment_y * dx)
        slots[slot, 9] = lane_sum(moment_yy)


@njit(cache=True, nogil=True)
def _write(planes, image, origin, stride, size, rows):  # type: ignore[no-untyped-def]
    """R G B Z A of the tile into the image."""
    one = splat(_ONE)
    for row in range(rows):
        p, q = row * LANES, origin + row * stride
        for k in range(4):
            store(image, q + k * size, load(planes, p + (k + 1) * PLANE))
        store(image, q + 4 * size, one - load(planes, p))


@njit(cache=True, nogil=True)
def _read_cotangents(planes, image, origin, stride, size, rows):  # type: ignore[no-untyped-def]
    """The image's cotangents into the planes' places for g; B starts at 0."""
    for row in range(rows):
        p, q = row * LANES, origin + row * stride
        for k in range(5):
            store(planes, p + (k + 1) * PLANE, load(image, q + k * size))
        store(planes, p, splat(_ZERO))


@njit(cache=True, nogil=True, inline="always")
def _clip_unit(x):  # type: ignore[no-untyped-def]
    """x held within [-1, 1]: the derivative of the L1 loss with a quadratic zone of half-width 1."""
    one, minus = splat(_ONE), splat(-_ONE)
    x = where_less(x, minus, minus, x)
    return where_less(one, x, one, x)


@njit(cache=True, nogil=True)
def _loss(  # type: ignore[no-untyped-def]
    planes, statistics, target, weight, inverse_depth, loss_settings, origin, stride, size, rows
):
    """Loss of the tile into statistics, its gradient into the planes (worker/loss.py has the same in plain torch)."""
    zero, one = splat(_ZERO), splat(_ONE)
    per_byte = splat(np.float32(1.0 / 255.0))
    colour_weight, depth_weight = splat(loss_settings[0]), splat(loss_settings[1])
    colour_sharpness, depth_sharpness = splat(loss_settings[2]), splat(loss_settings[3])
    normalised = loss_settings[4] > _ZERO
    l1, depth_l1, squared, holes = zero, zero, zero, zero
    for row in range(rows):
        p, q = row * LANES, origin + row * stride
        tissue = load_bytes(weight, q) * per_byte
        for k in range(3):
            error = load(planes, p + (k + 1) * PLANE) - load_bytes(target, q + k * size) * per_byte
            l1 = fma(tissue, where_less(error, zero, zero - error, error), l1)
            squared = fma(tissue, error * error, squared)
            store(planes, p + (k + 1) * PLANE, _clip_unit(error * colour_sharpness) * tissue * colour_weight)
        transmittance = load(planes, p)
        holes = fma(tissue, transmittance, holes)
        coverage = one - transmittance
        wanted = load(inverse_depth, q)
        summed = load(planes, p + 4 * PLANE)
        # Where nothing was blended there is no depth to correct; 1e-2 keeps the divisions finite.
        solid = where_less(splat(np.float32(1e-2)), coverage, one, zero)
        usable = where_less(zero, wanted, tissue * solid, zero)
        divisor = where_less(zero, usable, summed, one)
        inverse = one / divisor
        if normalised:
            inverse = inverse * coverage
        error = inverse - wanted
        depth_l1 = fma(usable, where_less(error, zero, zero - error, error), depth_l1)
        slope = _clip_unit(error * depth_sharpness) * usable * depth_weight
        # d(1/D)/dZ with D = Z (paper) or Z / A; d(1/D)/dA = 1 / Z in the second case.
        store(planes, p + 4 * PLANE, (zero - slope) * inverse / divisor)
        if normalised:
            store(planes, p + 5 * PLANE, slope / divisor)
        else:
            store(planes, p + 5 * PLANE, zero)
        store(planes, p, zero)
    statistics[0], statistics[1] = lane_sum(l1), lane_sum(depth_l1)
    statistics[2], statistics[3] = lane_sum(squared), lane_sum(holes)
