"""Which splats touch which tile, in depth order.

A tile is LANES pixels wide and TILE_ROWS tall: as narrow as a vector, tall to keep the number of tiles a splat touches
low. A slot is one (splat, tile) pair with its range of rows; the slots of a splat are consecutive, so the gradients the
blend writes a slot are summed without atomics and in a fixed order.

    slot_start, slot_count [N]   slots of splat g: slot_count[g] of them from slot_start[g]
    slot_splat, slot_tile  [M]   the splat and the tile of a slot
    slot_rows              [M, 2] first and end row inside the tile, exact for the ellipse within the tile's columns
    tile_start [tiles + 1], tile_slots [M]   the slots of a tile, nearest splat first

Each thread has a region of the M places for the slots of its splats, so one pass over the splats is enough.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from worker.raster.cpu.project import LOG2E
from worker.raster.cpu.simd import LANES

TILE_ROWS = 32
"""Rows of a tile. 8 x 32 pixels x 6 planes of float32 are 6 kB: they and the tile's alphas stay in L1 and L2."""
ROUNDING = 1e-3
"""Pixels by which row bounds are widened, against rounding; the exact test is made on every pixel anyway."""


@njit(cache=True, nogil=True, inline="always")
def _rows(splats, g, extent2, first_x, last_x):  # type: ignore[no-untyped-def]
    """Image rows [top, end) that the ellipse covers between the pixel centres first_x and last_x; end <= top if none.

    Solves k_xx dx^2 + k_xy dx dy + k_yy dy^2 = extent2 for dy; the upper branch is concave in dx, so its maximum over
    the columns is at the ellipse's own extreme point clamped to them.
    """
    a = -2.0 / LOG2E * splats[g, 2]
    b = -1.0 / LOG2E * splats[g, 3]
    c = -2.0 / LOG2E * splats[g, 4]
    det = a * c - b * b
    if not (det > 0.0):
        return 0, 0
    reach = math.sqrt(extent2 * c / det)
    mx, my = float(splats[g, 0]), float(splats[g, 1])
    low, high = max(first_x - mx, -reach), min(last_x - mx, reach)
    if low > high:
        return 0, 0
    extreme = -b / a * math.sqrt(extent2 * a / det)
    at = min(max(extreme, low), high)
    bottom = (-b * at + math.sqrt(max(0.0, extent2 * c - det * at * at))) / c
    at = min(max(-extreme, low), high)
    top = (-b * at - math.sqrt(max(0.0, extent2 * c - det * at * at))) / c
    return math.ceil(my + top - 0.5 - ROUNDING), math.floor(my + bottom - 0.5 + ROUNDING) + 1


@njit(cache=True, nogil=True, inline="always")
def _columns(splats, g, extent2, tiles_x):  # type: ignore[no-untyped-def]
    """Range of tile columns the ellipse may touch."""
    a = -2.0 / LOG2E * splats[g, 2]
    b = -1.0 / LOG2E * splats[g, 3]
    c = -2.0 / LOG2E * splats[g, 4]
    reach = math.sqrt(extent2 * c / max(a * c - b * b, 1e-30))
    first = math.floor((splats[g, 0] - reach - 0.5) / LANES)
    last = math.floor((splats[g, 0] + reach - 0.5) / LANES)
    return max(first, 0), min(last, tiles_x - 1)


@njit(cache=True, nogil=True)
def fill_slots(  # type: ignore[no-untyped-def]
    thread, threads, splats, radius2, height, tiles_x,
    slot_start, slot_count, slot_splat, slot_tile, slot_rows, region_end,
):  # fmt: skip
    """Write the slots of the thread's share of splats into its region, an equal share of the slot arrays.

    region_end [threads]: where they end, or would: beyond the region nothing is written, and the caller makes room.
    """
    region = slot_splat.shape[0] // threads
    slot, full = thread * region, (thread + 1) * region
    count = splats.shape[0]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        slot_start[g] = slot
        first, last = 0, -1
        if radius2[g] >= 0.0:
            first, last = _columns(splats, g, radius2[g], tiles_x)
        for column in range(first, last + 1):
            top, end = _rows(splats, g, radius2[g], column * LANES + 0.5, column * LANES + LANES - 0.5)
            top, end = max(top, 0), min(end, height)
            if top >= end:
                continue
            for band in range(top // TILE_ROWS, (end - 1) // TILE_ROWS + 1):
                if slot < full:
                    slot_splat[slot] = g
                    slot_tile[slot] = band * tiles_x + column
                    slot_rows[slot, 0] = max(top - band * TILE_ROWS, 0)
                    slot_rows[slot, 1] = min(end - band * TILE_ROWS, TILE_ROWS)
                slot += 1
        slot_count[g] = slot - slot_start[g]
    region_end[thread] = slot


@njit(cache=True, nogil=True)
def depth_order(splats, radius2, order, keys, other_order, other_keys):  # type: ignore[no-untyped-def]
    """Write the visible splats into order, nearest first, ties by index; return how many there are.

    Radix sort, 3 x 11 bits of the float's own bits (depths are positive). order, keys, other_* are scratch [N].
    """
    visible = 0
    for g in range(splats.shape[0]):
        if radius2[g] >= 0.0:
            order[visible] = g
            visible += 1
    depth = splats[:, 9].copy().view(np.uint32)
    for i in range(visible):
        keys[i] = depth[order[i]]
    for shift in (0, 11, 22):
        cursor = np.zeros(2049, np.int64)
        for i in range(visible):
            cursor[((keys[i] >> shift) & 2047) + 1] += 1
        for bucket in range(2048):
            cursor[bucket + 1] += cursor[bucket]
        for i in range(visible):
            bucket = (keys[i] >> shift) & 2047
            at = cursor[bucket]
            cursor[bucket] = at + 1
            other_order[at] = order[i]
            other_keys[at] = keys[i]
        order, other_order = other_order, order
        keys, other_keys = other_keys, keys
    for i in range(visible):  # an odd number of passes: the result is in the other buffer
        other_order[i] = order[i]
    return visible


@njit(cache=True, nogil=True)
def sort_into_tiles(  # type: ignore[no-untyped-def]
    order, visible, slot_start, slot_count, slot_tile, region_end, tile_start, tile_slots
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
            tile_slots[cursor[tile]] = slot
            cursor[tile] += 1


@njit(cache=True, nogil=True)
def most_rows(slot_rows, tile_start, tile_slots):  # type: ignore[no-untyped-def]
    """Rows of all slots of the fullest tile."""
    most = 0
    for tile in range(tile_start.shape[0] - 1):
        rows = 0
        for i in range(tile_start[tile], tile_start[tile + 1]):
            slot = tile_slots[i]
            rows += slot_rows[slot, 1] - slot_rows[slot, 0]
        most = max(most, rows)
    return most
