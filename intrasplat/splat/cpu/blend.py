"""The blend: front-to-back compositing of a tile, its loss, and the gradients of its splats, in one pass over tiles.

Symbols, for one pixel and its splats i = 0, 1, ... nearest first:
    alpha_i = min(MAX_ALPHA, 2**power2_i), 0 below MIN_ALPHA or once T < MIN_TRANSMITTANCE
    T_i     = product over j < i of (1 - alpha_j);  w_i = alpha_i T_i
    C       = sum w_i c_i,  Z = sum w_i z_i,  A = sum w_i = 1 - T_end
    s_i     = g_C . c_i + g_Z z_i + g_A, with g the loss gradient at this pixel
    dL/dalpha_i = T_i (s_i - B_i),  B_{i-1} = alpha_i s_i + (1 - alpha_i) B_i,  B_last = 0
so going back to front needs no division, and dL/dpower_i = w_i (s_i - B_i). The forward pass stores alpha and w of
every row it visits in ``tape``, for the backward pass. The loss needs only the pixel's own colour, so there is no
gradient image. Down a column of pixels power2 is quadratic. So alpha is multiplied by a ratio from row to row, and the
ratio by a constant: two products instead of an exponential. Derivations: docs/rasterizer.md.

A tile takes four steps. _gather copies its entries (bins.py) into consecutive records, _forward blends them, _loss
computes the loss, and _backward visits the records in reverse. A record is RECORD floats: alpha and ratio of its first
row (one per lane), then BEND (the ratio's factor per row), COLOUR (r, g, b, z), PLACE (dx of the first lane, dy of the
first row) and VALUE (splat number 11 in project.py).
spans[i] is first row, end row and accumulator (bins.py) of record i. The arrays of a tile lie in ``planes``, PLANE
floats apart: T (later B - g_A), R G B Z (later g_R g_G g_B g_Z) and the value, blended only if no gradient is computed.
"""

from __future__ import annotations

import numpy as np

from intrasplat.machine.cache import kernel
from intrasplat.splat.constants import MAX_ALPHA, MIN_ALPHA, MIN_COVERAGE, MIN_TRANSMITTANCE
from intrasplat.splat.cpu.bins import BLOCK_TILES, GRADIENT, ROW_BITS, TILE_ROWS
from intrasplat.splat.cpu.simd import (
    add_sums,
    all_less,
    claim,
    exp2,
    fma,
    iota,
    lane_max,
    lane_sum,
    load,
    load_bytes,
    minimum,
    splat,
    spread,
    store,
    where_less,
)
from intrasplat.splat.cpu.vectors import LANES

PLANE = TILE_ROWS * LANES + 16
"""Not a power of two: otherwise the same pixel of two planes would fall into the same cache set (4K aliasing)."""
PLANES = 6
BEND, COLOUR, PLACE, VALUE = 2 * LANES, 2 * LANES + 1, 2 * LANES + 5, 2 * LANES + 7
RECORD = 2 * LANES + 8
MAX_ROWS = 16
"""The most rows of a record: the rounding error of the products grows with their square, to 1e-5 of alpha after 16."""
RENDER, LOSS, COTANGENT = 0, 1, 2
"""Modes. RENDER writes images. LOSS computes gradients of the built-in loss and writes no image. COTANGENT computes
gradients from given image gradients."""
STATISTICS = 4
"""Sums of a tile over tissue: colour L1, depth L1, squared error of the colour channels, 1 - A."""

_CUT = np.float32(MIN_ALPHA)
_CAP = np.float32(MAX_ALPHA)
_DEEP = np.float32(-60.0)  # below this power2 products may leave float32's range, so each row becomes a record
_STOP = np.float32(MIN_TRANSMITTANCE)
_MIN_COVERAGE = np.float32(MIN_COVERAGE)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)
_CHECK_EVERY = 32  # records between two tests of whether the whole tile is opaque


@kernel
def blend(  # type: ignore[no-untyped-def]
    thread, threads, next_block, mode, width, height, tiles_x, splats, tile_start, entries, accumulators,
    records, spans, tape, planes, sums, statistics, target, weight, inverse_depth, loss_settings, image,
):  # fmt: skip
    """Composite every tile. Each thread takes the next block; the result does not depend on which thread takes it.

    next_block int64 [1]: 0 at the start. records, spans, tape, planes [threads, ...]: scratch (see above).
    sums [accumulators * GRADIENT] (bins.py): added to in LOSS and COTANGENT. statistics [tiles, STATISTICS]: LOSS.
    target, weight, inverse_depth, loss_settings: LOSS, see _loss; stride = tiles_x * LANES.
    image [6, H, stride] flattened: R G B Z A and the blended value, written in RENDER; the first five are read as
    cotangents in COTANGENT.
    """
    blocks_x, stride, keep = -(-tiles_x // BLOCK_TILES), tiles_x * LANES, mode != RENDER
    blocks, size = (tile_start.shape[0] - 1) // tiles_x * blocks_x, height * stride
    records, spans, tape, planes = records[thread], spans[thread], tape[thread], planes[thread]
    block = claim(next_block)
    while block < blocks:
        band, block_x = block // blocks_x, block % blocks_x
        row0 = band * TILE_ROWS
        rows = min(TILE_ROWS, height - row0)
        for column in range(block_x * BLOCK_TILES, min((block_x + 1) * BLOCK_TILES, tiles_x)):
            tile, column0 = band * tiles_x + column, column * LANES
            origin = row0 * stride + column0
            count = _gather(
                tile_start[tile], tile_start[tile + 1], row0, column0, band, block_x, splats, entries, accumulators,
                records, spans,
            )  # fmt: skip
            _clear(planes, column0, width, rows)
            visited = _forward(count, rows, keep, records, spans, tape, planes)
            if mode == RENDER:
                _write(planes, image, origin, stride, size, rows)
            elif mode == LOSS:
                _loss(
                    planes, statistics[tile], target, weight, inverse_depth, loss_settings, origin, stride, size, rows
                )  # fmt: skip
            else:
                _read_cotangents(planes, image, origin, stride, size, rows)
            if keep:
                _backward(visited, records, spans, tape, planes, sums)
        block = claim(next_block)


@kernel
def _gather(  # type: ignore[no-untyped-def]
    first, end, row0, column0, band, block_x, splats, entries, accumulators, records, spans
):
    """Write the entries [first, end) of a tile as records; return how many records.

    splats[g]: 0 1 mean2d; 2 3 4 k_xx, k_xy, k_yy; 5 log2 opacity; 6-8 colour; 9 z; 10 BEND; 11 VALUE (project.py).
    An entry with many rows becomes several records of at most MAX_ROWS rows.
    """
    lanes = iota()
    at = count = 0
    for i in range(first, end):
        entry = np.int64(entries[i])
        g = np.uint64(entry >> 2 * ROW_BITS)
        top, bottom = entry >> ROW_BITS & TILE_ROWS - 1, (entry & TILE_ROWS - 1) + 1
        x = np.float32(column0) + _HALF - splats[g, 0]
        y = np.float32(row0) + _HALF - splats[g, 1]
        k_xx, k_xy, k_yy = splats[g, 2], splats[g, 3], splats[g, 4]
        dx = lanes + splat(x)
        along = fma(dx, splat(k_xx) * dx, splat(splats[g, 5]))
        linear = splat(k_xy) * dx  # power2 = along + linear dy + k_yy dy^2
        dy, end_dy = y + np.float32(top), y + np.float32(bottom - 1)
        head = fma(linear, splat(dy), along) + splat(k_yy * dy * dy)
        foot = fma(linear, splat(end_dy), along) + splat(k_yy * end_dy * end_dy)
        stretch = MAX_ROWS if all_less(splat(_DEEP), minimum(head, foot)) else 1
        accumulator = accumulators[g, 2] + accumulators[g, 3] * band + block_x  # of the splat in this block (bins.py)
        while top < bottom:
            dy = y + np.float32(top)
            store(records, at, exp2(fma(linear, splat(dy), along) + splat(k_yy * dy * dy)))
            store(records, at + LANES, exp2(linear + splat(k_yy * (dy + dy + _ONE))))
            records[at + BEND] = splats[g, 10]
            records[at + COLOUR], records[at + COLOUR + 1] = splats[g, 6], splats[g, 7]
            records[at + COLOUR + 2], records[at + COLOUR + 3] = splats[g, 8], splats[g, 9]
            records[at + PLACE], records[at + PLACE + 1] = x, dy
            records[at + VALUE] = splats[g, 11]
            spans[count, 0], spans[count, 1], spans[count, 2] = top, min(top + stretch, bottom), accumulator
            top += stretch
            at += RECORD
            count += 1
    return count


@kernel
def _clear(planes, column0, width, rows):  # type: ignore[no-untyped-def]
    """Reset the planes: T = 1 inside the image and 0 outside, the others 0."""
    zero = splat(_ZERO)
    inside = where_less(iota() + splat(np.float32(column0)), splat(np.float32(width)), splat(_ONE), zero)
    for row in range(rows):
        p = row * LANES
        store(planes, p, inside)
        for k in range(1, PLANES):
            store(planes, p + k * PLANE, zero)


@kernel
def _forward(count, rows, keep, records, spans, tape, planes):  # type: ignore[no-untyped-def]
    """Blend the records into planes; return how many were blended before the tile was opaque."""
    zero, cut, cap, stop = splat(_ZERO), splat(_CUT), splat(_CAP), splat(_STOP)
    at = 0
    for i in range(count):
        record = i * RECORD
        alpha_raw, ratio, bend = load(records, record), load(records, record + LANES), spread(records, record + BEND)
        red, green = spread(records, record + COLOUR), spread(records, record + COLOUR + 1)
        blue, depth = spread(records, record + COLOUR + 2), spread(records, record + COLOUR + 3)
        value = spread(records, record + VALUE)
        for row in range(spans[i, 0], spans[i, 1]):
            p = row * LANES
            transmittance = load(planes, p)
            alpha = where_less(alpha_raw, cut, zero, minimum(alpha_raw, cap))
            alpha = where_less(transmittance, stop, zero, alpha)
            weight = alpha * transmittance
            alpha_raw = alpha_raw * ratio
            ratio = ratio * bend
            store(planes, p, transmittance - weight)
            store(planes, p + PLANE, fma(weight, red, load(planes, p + PLANE)))
            store(planes, p + 2 * PLANE, fma(weight, green, load(planes, p + 2 * PLANE)))
            store(planes, p + 3 * PLANE, fma(weight, blue, load(planes, p + 3 * PLANE)))
            store(planes, p + 4 * PLANE, fma(weight, depth, load(planes, p + 4 * PLANE)))
            if keep:
                store(tape, at, alpha)
                store(tape, at + LANES, weight)
                at += 2 * LANES
            else:
                store(planes, p + 5 * PLANE, fma(weight, value, load(planes, p + 5 * PLANE)))
        if i % _CHECK_EVERY == _CHECK_EVERY - 1:
            clearest = zero
            for row in range(rows):
                transmittance = load(planes, row * LANES)
                clearest = where_less(clearest, transmittance, transmittance, clearest)
            if lane_max(clearest) < _STOP:
                return i + 1
    return count


@kernel
def _backward(count, records, spans, tape, planes, sums):  # type: ignore[no-untyped-def]
    """Add the gradients of the first count records to their accumulators, back to front.

    planes: B - g_A, then g_R g_G g_B g_Z. One long function, so that ten running sums stay in registers.
    """
    zero, cap = splat(_ZERO), splat(_CAP)
    lanes = iota()
    v_red, v_green, v_blue, v_depth = zero, zero, zero, zero
    moment, moment_y, moment_yy = zero, zero, zero
    at = 0
    for i in range(count):
        at += (spans[i, 1] - spans[i, 0]) * 2 * LANES
    for i in range(count - 1, -1, -1):
        record = i * RECORD
        red, green = spread(records, record + COLOUR), spread(records, record + COLOUR + 1)
        blue, depth = spread(records, record + COLOUR + 2), spread(records, record + COLOUR + 3)
        top, bottom = spans[i, 0], spans[i, 1]
        at -= (bottom - top) * 2 * LANES
        sum_1, sum_2, sum_3 = zero, zero, zero
        trace = at
        for row in range(top, bottom):
            p = row * LANES
            alpha, weight = load(tape, trace), load(tape, trace + LANES)
            trace += 2 * LANES
            g_red, g_green = load(planes, p + PLANE), load(planes, p + 2 * PLANE)
            g_blue, g_depth = load(planes, p + 3 * PLANE), load(planes, p + 4 * PLANE)
            behind = load(planes, p)
            score = fma(g_red, red, g_green * green) + (fma(g_blue, blue, g_depth * depth) - behind)
            store(planes, p, fma(alpha, score, behind))
            v_red, v_green = fma(weight, g_red, v_red), fma(weight, g_green, v_green)
            v_blue, v_depth = fma(weight, g_blue, v_blue), fma(weight, g_depth, v_depth)
            v_power = where_less(alpha, cap, weight * score, zero)
            sum_1 = sum_1 + v_power
            sum_2 = sum_2 + sum_1
            sum_3 = sum_3 + sum_2
        # With k rows to the record's end: sum_2 = sum k v, sum_3 = sum k (k + 1) / 2 v, dy = end_dy - k.
        end_dy = spread(records, record + PLACE + 1) + splat(np.float32(bottom - top))
        lowered = end_dy * sum_1 - sum_2
        moment, moment_y = moment + sum_1, moment_y + lowered
        moment_yy = moment_yy + fma(end_dy, lowered - sum_2, sum_3 + sum_3 - sum_2)
        if i > 0 and spans[i - 1, 2] == spans[i, 2]:
            continue  # the record before is of the same splat
        dx = lanes + spread(records, record + PLACE)
        moment_x = moment * dx
        accumulator = np.int64(spans[i, 2]) * GRADIENT
        add_sums(sums, accumulator, v_red, v_green, v_blue, v_depth)
        add_sums(sums, accumulator + 4, moment, moment_x, moment_y, moment_x * dx)
        add_sums(sums, accumulator + 8, moment_y * dx, moment_yy, zero, zero)
        v_red, v_green, v_blue, v_depth = zero, zero, zero, zero
        moment, moment_y, moment_yy = zero, zero, zero


@kernel
def _write(planes, image, origin, stride, size, rows):  # type: ignore[no-untyped-def]
    """Copy R G B Z A and the value of the tile into the image."""
    one = splat(_ONE)
    for row in range(rows):
        p, q = row * LANES, origin + row * stride
        for k in range(4):
            store(image, q + k * size, load(planes, p + (k + 1) * PLANE))
        store(image, q + 4 * size, one - load(planes, p))
        store(image, q + 5 * size, load(planes, p + 5 * PLANE))


@kernel
def _read_cotangents(planes, image, origin, stride, size, rows):  # type: ignore[no-untyped-def]
    """Copy the image's cotangents into the planes of g; B starts at 0."""
    for row in range(rows):
        p, q = row * LANES, origin + row * stride
        for k in range(4):
            store(planes, p + (k + 1) * PLANE, load(image, q + k * size))
        store(planes, p, splat(_ZERO) - load(image, q + 4 * size))


@kernel(inline="always")
def _clip_unit(x):  # type: ignore[no-untyped-def]
    """x clamped to [-1, 1]: the derivative of the Huber loss with delta 1."""
    one, minus = splat(_ONE), splat(-_ONE)
    x = where_less(x, minus, minus, x)
    return where_less(one, x, one, x)


@kernel(inline="always")
def _depth_loss(planes, p, tissue, wanted, normalised, sharpness, depth_weight):  # type: ignore[no-untyped-def]
    """Return the L1 of the depth at the LANES pixels from p, and write its gradient into the planes Z and T."""
    zero, one = splat(_ZERO), splat(_ONE)
    coverage = one - load(planes, p)
    # Pixels that are hardly covered have no depth loss; the bound keeps the divisions finite.
    solid = where_less(splat(_MIN_COVERAGE), coverage, one, zero)
    usable = where_less(zero, wanted, tissue * solid, zero)
    divisor = where_less(zero, usable, load(planes, p + 4 * PLANE), one)
    inverse = one / divisor
    if normalised:
        inverse = inverse * coverage
    error = inverse - wanted
    slope = _clip_unit(error * sharpness) * usable * depth_weight
    # The inverse depth is 1 / Z (paper) or A / Z (normalised); its derivative to A is 1 / Z in the second case.
    store(planes, p + 4 * PLANE, (zero - slope) * inverse / divisor)
    if normalised:
        store(planes, p, zero - slope / divisor)
    else:
        store(planes, p, zero)
    return usable * where_less(error, zero, zero - error, error)


@kernel
def _loss(  # type: ignore[no-untyped-def]
    planes, statistics, target, weight, inverse_depth, loss_settings, origin, stride, size, rows
):
    """Write the loss of the tile into statistics and its gradient into the planes (in torch: intrasplat/splat/loss.py).

    target [3, H, stride] uint8, weight [H, stride] uint8 (255 = tissue), inverse_depth [H, stride] float32 (0 = none),
    flattened. loss_settings float32 [5]: colour weight per channel, depth weight, 1 / Huber delta of the
    colour and of the depth loss, 1 for normalised depth else 0.
    """
    zero = splat(_ZERO)
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
        wanted = load(inverse_depth, q)
        depth_l1 = depth_l1 + _depth_loss(planes, p, tissue, wanted, normalised, depth_sharpness, depth_weight)
    statistics[0], statistics[1] = lane_sum(l1), lane_sum(depth_l1)
    statistics[2], statistics[3] = lane_sum(squared), lane_sum(holes)
