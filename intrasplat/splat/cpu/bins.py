"""Lists the splats of each tile in depth order, and assigns the accumulators in which a splat's gradients are summed.

Symbols: N splats (index g), M slots. splats[g, k] is number k of the record of splat g (table in project.py).
A tile is LANES pixels wide, as a vector, and TILE_ROWS tall, so that a splat touches few tiles. A band is a row of
tiles. A slot is one (splat, tile) pair with its range of rows.

    slot_start, slot_count [N]   slots of splat g: slot_count[g] from slot_start[g];  slot_info [M]: tile and rows
    tile_start [tiles + 1], entries [M]   the slots of a tile, nearest splat first: splat and rows

Rows [top, end) inside the tile are exact for the ellipse within the tile's columns. The low 2 x ROW_BITS bits of
slot_info and entries are (top, end - 1), the others the tile or the splat. Packing halves memory and sorting time.

A block is BLOCK_TILES tiles of one band, blended one after the other by one thread. For each block that it may touch, a
splat has an accumulator of GRADIENT floats, to which each of its tiles adds its gradients. So accumulators are few and
stay in the cache, there are no atomics, and the order of addition does not depend on the threads.

    accumulators [N, 4]   number of the first, how many, offset, step. The accumulator of splat g in column block_x of
                          the blocks of a band is number accumulators[g, 2] + accumulators[g, 3] * band + block_x

Each thread has its own region of the slots and of the accumulators, so one pass over the splats is enough.
"""

from __future__ import annotations

import math

import numpy as np

from intrasplat.machine.cache import kernel
from intrasplat.splat.cpu.simd import ceil, floor, iota, maximum, minimum, splat, sqrt, store
from intrasplat.splat.cpu.vectors import LANES

ROW_BITS = 6
TILE_ROWS = 1 << ROW_BITS
"""Rows of a tile. 8 x 64 pixels x 5 planes of float32 are 10 kB: they and the tile's alphas stay in L1 and L2."""
BLOCK_TILES = 16
GRADIENT = 12
"""Floats of an accumulator: dL/d(r, g, b, z), the moments 1, x, y, xx, xy, yy of dL/dpower, two spare."""
EXTENT = 6
"""Numbers that project computes of a splat's ellipse a dx^2 + 2 b dx dy + c dy^2 = r: its half-width in pixels, dx of
its lowest point, -b / c, r / c, (ac - b^2) / c^2, and its half-height."""
MAX_GAUSSIANS = 1 << (32 - 2 * ROW_BITS)
"""A million: an entry has no bits for more beside the rows. As many tiles are an image of 23000 x 23000."""
ROUNDING = np.float32(2e-3)
"""Pixels by which row bounds are widened, against rounding; every pixel is tested exactly anyway."""
_ZERO, _HALF, _WIDTH = np.float32(0.0), np.float32(0.5), np.float32(LANES)
_RADIX_BITS = 11
_INFO_SHIFT = np.uint32(2 * ROW_BITS)
_ROWS_MASK = np.uint32((1 << 2 * ROW_BITS) - 1)


@kernel(inline="always")
def _rows(extent, g, x, y, column, bounds):  # type: ignore[no-untyped-def]
    """Write the image rows [top, end) that the ellipse covers in LANES columns of tiles, from `column` on, into bounds.

    bounds [2 * LANES]: top, then end. The lower branch -b / c dx + sqrt(r / c - (ac - b^2) / c^2 dx^2) is concave in
    dx, so its maximum over a column's pixel centres is at the ellipse's extreme point clamped to them. The upper branch
    is its mirror image. slope = -b / c, height2 = r / c, fall = (ac - b^2) / c^2.
    """
    zero, width, extreme = splat(_ZERO), splat(extent[g, 0]), splat(extent[g, 1])
    slope, height2, fall = splat(extent[g, 2]), splat(extent[g, 3]), splat(extent[g, 4])
    first_dx = (iota() + splat(np.float32(column))) * splat(_WIDTH) + splat(_HALF - x)
    low, high = maximum(first_dx, zero - width), minimum(first_dx + splat(_WIDTH - np.float32(1)), width)
    at = minimum(maximum(extreme, low), high)
    bottom = slope * at + sqrt(maximum(zero, height2 - fall * at * at))
    at = minimum(maximum(zero - extreme, low), high)
    top = slope * at - sqrt(maximum(zero, height2 - fall * at * at))
    store(bounds, 0, ceil(top + splat(y - _HALF - ROUNDING)))
    store(bounds, LANES, floor(bottom + splat(y + _HALF + ROUNDING)))


@kernel(inline="always")
def _number_accumulators(accumulators, g, accumulator, first, last, highest, lowest):  # type: ignore[no-untyped-def]
    """Number the accumulators of splat g from `accumulator` on; returns the next free number.

    The splat touches the tile columns first to last of the bands highest to lowest.
    """
    first_block, last_block = first // BLOCK_TILES, last // BLOCK_TILES
    step = last_block - first_block + 1
    accumulators[g, 1] = step * (lowest - highest + 1)
    accumulators[g, 2], accumulators[g, 3] = accumulator - step * highest - first_block, step
    return accumulator + accumulators[g, 1]


@kernel
def fill_slots(  # type: ignore[no-untyped-def]
    thread, threads, splats, radius2, extent, height, tiles_x, accumulator_capacity,
    slot_start, slot_count, slot_info, accumulators, region_end,
):  # fmt: skip
    """Write the slots of the thread's share of splats into its region, an equal share of slot_info.

    Number the splats' accumulators too. accumulator_capacity: accumulators of all threads. region_end [threads, 2]: the
    end of the thread's slots and of its accumulators. Slots beyond the region are counted but not written.
    """
    region = slot_info.shape[0] // threads
    slot, full = thread * region, (thread + 1) * region
    accumulator = accumulator_capacity // threads * thread
    count, last_row = splats.shape[0], np.float32(height - 1)
    bounds = np.empty(2 * LANES, np.float32)
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        slot_start[g], slot_count[g], accumulators[g, 0], accumulators[g, 1] = slot, 0, accumulator, 0
        if not radius2[g] >= _ZERO:
            continue
        x, y, reach_x, reach_y = splats[g, 0], splats[g, 1], extent[g, 0], extent[g, 5]
        first = max(math.floor((x - reach_x - _HALF) / _WIDTH), 0)
        last = min(math.floor((x + reach_x - _HALF) / _WIDTH), tiles_x - 1)
        highest = int(max(y - reach_y - _HALF, _ZERO)) >> ROW_BITS
        lowest = int(min(y + reach_y + _HALF, last_row)) >> ROW_BITS
        top_most, bottom_most = highest << ROW_BITS, min((lowest + 1) << ROW_BITS, height)
        for column in range(first, last + 1):
            lane = (column - first) % LANES
            if lane == 0:
                _rows(extent, g, x, y, column, bounds)
            top, end = max(int(bounds[lane]), top_most), min(int(bounds[LANES + lane]), bottom_most)
            if top >= end:
                continue
            for band in range(top >> ROW_BITS, ((end - 1) >> ROW_BITS) + 1):
                if slot < full:
                    above = band << ROW_BITS
                    rows = max(top - above, 0) << ROW_BITS | min(end - 1 - above, TILE_ROWS - 1)
                    slot_info[slot] = (band * tiles_x + column) << 2 * ROW_BITS | rows
                slot += 1
        slot_count[g] = slot - slot_start[g]
        if slot_count[g] > 0:
            accumulator = _number_accumulators(accumulators, g, accumulator, first, last, highest, lowest)
    region_end[thread, 0], region_end[thread, 1] = slot, accumulator


@kernel
def depth_order(splats, radius2, order, keys, other_order, other_keys):  # type: ignore[no-untyped-def]
    """Sort the visible splats, nearest first, ties by index; order, keys, other_* are scratch [N].

    Returns how many there are, and whether the result is in `order`; otherwise it is in other_order. A radix sort on
    the float's bits minus those of the nearest (depths are positive), with as many passes as their range has digits.
    """
    visible, nearest, farthest = 0, np.uint32(0xFFFFFFFF), np.uint32(0)
    depth = splats[:, 9].copy().view(np.uint32)
    for g in range(splats.shape[0]):
        if radius2[g] >= _ZERO:
            order[visible], keys[visible] = g, depth[g]
            nearest, farthest = min(nearest, depth[g]), max(farthest, depth[g])
            visible += 1
    for i in range(visible):
        keys[i] -= nearest
    digits, shift, is_first = (1 << _RADIX_BITS) - 1, 0, True
    while visible > 0 and (farthest - nearest) >> shift > 0:
        cursor = np.zeros(digits + 2, np.int64)
        for i in range(visible):
            cursor[((keys[i] >> shift) & digits) + 1] += 1
        for digit in range(digits):
            cursor[digit + 1] += cursor[digit]
        for i in range(visible):
            digit = (keys[i] >> shift) & digits
            at = cursor[digit]
            cursor[digit] = at + 1
            other_order[at], other_keys[at] = order[i], keys[i]
        order, other_order, keys, other_keys = other_order, order, other_keys, keys
        shift, is_first = shift + _RADIX_BITS, not is_first
    return visible, is_first


@kernel
def sort_into_tiles(  # type: ignore[no-untyped-def]
    order, visible, slot_start, slot_count, slot_info, region_end, tile_start, entries
):
    """Counting sort of the slots by tile, with splats in depth order; fills tile_start and entries."""
    tile_start[:] = 0
    region = slot_info.shape[0] // region_end.shape[0]
    for thread in range(region_end.shape[0]):
        for slot in range(thread * region, region_end[thread, 0]):
            tile_start[(slot_info[slot] >> _INFO_SHIFT) + np.uint32(1)] += 1
    for tile in range(tile_start.shape[0] - 1):
        tile_start[tile + 1] += tile_start[tile]
    cursor = tile_start[:-1].copy()
    for i in range(visible):
        g = order[i]
        splat_bits = np.uint32(g) << _INFO_SHIFT
        for slot in range(slot_start[g], slot_start[g] + slot_count[g]):
            info = slot_info[slot]
            place = cursor[info >> _INFO_SHIFT]
            cursor[info >> _INFO_SHIFT] = place + 1
            entries[place] = splat_bits | info & _ROWS_MASK
