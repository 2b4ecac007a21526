"""Which splats touch which tile, in depth order.

A tile is LANES pixels wide and TILE_ROWS tall: as narrow as a vector, tall to keep the number of tiles a splat touches
low. A slot is one (splat, tile) pair with its range of rows. Slots have two orders, and so two numbers:

    by splat   slot_start, slot_count [N]: those of splat g are slot_count[g] from slot_start[g];
               slot_tile [M]; slot_rows [M]: top << 8 | end, rows inside the tile, exact within the tile's columns;
               slot_place [M]: the slot's number in the other order
    by tile    tile_start [tiles + 1]; entries [M, 2]: splat and rows, nearest splat first

The blend walks the second order and writes its gradients there, one after the other; each Gaussian then adds up its
own through slot_place, without atomics and in a fixed order. Each thread has a region of the M places for the slots of
its splats, so one pass over the splats is enough.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from worker.raster.cpu.vectors import LANES

TILE_ROWS = 32
"""Rows of a tile. 8 x 32 pixels x 5 planes of float32 are 5 kB: they and the tile's alphas stay in L1 and L2."""
EXTENT = 5
"""What project tells of the ellipse of a splat, a dx^2 + 2 b dx dy + c dy^2 = r: its half-width in pixels, dx where it
is lowest, -b / c, r / c and (ac - b^2) / c^2."""
ROUNDING = np.float32(2e-3)
"""Pixels by which row bounds are widened, against rounding; the exact test is made on every pixel anyway."""
_ZERO, _HALF = np.float32(0.0), np.float32(0.5)
_RADIX_BITS = 11


@njit(cache=True, nogil=True, inline="always")
def _rows(extent, g, first_dx, last_dx, y):  # type: ignore[no-untyped-def]
    """Image rows [top, end) that the ellipse covers between two columns of pixel centres; end <= top if none.

    The lower branch -b / c dx + sqrt(r / c - (ac - b^2) / c^2 dx^2) is concave in dx, so its maximum over the columns
    is at the ellipse's own extreme point clamped to them; the upper one is its mirror image.
    """
    width, extreme, lean, height2, fall = extent[g, 0], extent[g, 1], extent[g, 2], extent[g, 3], extent[g, 4]
    low, high = max(first_dx, -width), min(last_dx, width)
    if low > high:
        return 0, 0
    at = min(max(extreme, low), high)
    bottom = lean * at + math.sqrt(max(_ZERO, height2 - fall * at * at))
    at = min(max(-extreme, low), high)
    top = lean * at - math.sqrt(max(_ZERO, height2 - fall * at * at))
    return math.ceil(y + top - _HALF - ROUNDING), math.floor(y + bottom - _HALF + ROUNDING) + 1


@njit(cache=True, nogil=True)
def fill_slots(  # type: ignore[no-untyped-def]
    thread, threads, splats, radius2, extent, height, tiles_x, slot_start, slot_count, slot_tile, slot_rows, region_end
):
    """Write the slots of the thread's share of splats into its region, an equal share of the slot arrays.

    region_end [threads]: where they end, or would: beyond the region nothing is written, and the caller makes room.
    """
    region = slot_tile.shape[0] // threads
    slot, full = thread * region, (thread + 1) * region
    count = splats.shape[0]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        slot_start[g] = slot
        first, last, x, y = 0, -1, splats[g, 0], splats[g, 1]
        if radius2[g] >= _ZERO:
            first = max(math.floor((x - extent[g, 0] - _HALF) / np.float32(LANES)), 0)
            last = min(math.floor((x + extent[g, 0] - _HALF) / np.float32(LANES)), tiles_x - 1)
        for column in range(first, last + 1):
            first_dx = np.float32(column * LANES) + _HALF - x
            top, end = _rows(extent, g, first_dx, first_dx + np.float32(LANES - 1), y)
            top, end = max(top, 0), min(end, height)
            if top >= end:
                continue
            for band in range(top // TILE_ROWS, (end - 1) // TILE_ROWS + 1):
                if slot < full:
                    slot_tile[slot] = band * tiles_x + column
                    slot_rows[slot] = max(top - band * TILE_ROWS, 0) << 8 | min(end - band * TILE_ROWS, TILE_ROWS)
                slot += 1
        slot_count[g] = slot - slot_start[g]
    region_end[thread] = slot


@njit(cache=True, nogil=True)
def depth_order(splats, radius2, order, keys, other_order, other_keys):  # type: ignore[no-untyped-def]
    """Sort the visible splats, nearest first, ties by index; return how many there are and whether they are in order.

    (Else they are in other_order.) Radix sort on the float's own bits above the nearest one's (depths are positive):
    as many passes as the range of depths has digits. order, keys, other_* are scratch [N].
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


@njit(cache=True, nogil=True)
def sort_into_tiles(  # type: ignore[no-untyped-def]
    order, visible, slot_start, slot_count, slot_tile, slot_rows, region_end, tile_start, entries, slot_place
):
    """Counting sort of the slots by tile, splats taken in depth order."""
    tile_start[:] = 0
    region = slot_tile.shape[0] // region_end.shape[0]
    for thread in range(region_end.shape[0]):
        for slot in range(thread * region, region_end[thread]):
            tile_start[slot_tile[slot] + 1] += 1
    for tile in range(tile_start.shape[0] - 1):
        tile_start[tile + 1] += tile_start[tile]
    cursor = tile_start[:-1].copy()
    for i in range(visible):
        g = order[i]
        for slot in range(slot_start[g], slot_start[g] + slot_count[g]):
            tile = slot_tile[slot]
            place = cursor[tile]
            cursor[tile] = place + 1
            entries[place, 0], entries[place, 1] = g, slot_rows[slot]
            slot_place[slot] = place
