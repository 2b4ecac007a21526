"""Lists the splats of each tile on the device. Arrays are padded to a capacity, so the host never reads their length.

Symbols: N Gaussians, F frames, M slots (the capacity). A slot is one (splat, tile) pair, an instance.

A splat's slots are consecutive, splats nearest first. A stable sort of the slots by tile then gives every tile its
instances, nearest first. So there are two sorts (torch.sort): of the F N depths, with 32-bit keys, and of the M tiles,
with 16-bit keys if so many tiles fit: half the passes of 32.

    count [F N]   how many tiles the splat touches (written by project.py)
    ends [F N]    running sum of count in depth order: the slots of rank r are ends[r] - count ... ends[r] - 1
    key, owner [M]  tile and splat of a slot; NO_TILE = F tiles beyond the last, so that sorting moves it to the end

Tiles are exact: in each row of tiles, a splat touches the columns that the ellipse alpha = MIN_ALPHA reaches at one of
the row's pixel centres. fill_slots gives each thread a slot, not a splat, so that a splat that covers the image does
not delay the whole kernel.
"""

from __future__ import annotations

import triton
import triton.language as tl

TILE_WIDTH, TILE_HEIGHT = 8, 8
"""Pixels. A smaller tile evaluates fewer pixels that a splat misses, but gives more instances to sort: 8 x 8 halves the
pixels of 16 x 16; 8 x 4 would save another fifth, with 1.6 times the instances."""
EXTENT = 8
"""Floats that decide which tiles a splat touches: its centre; the half-height of the ellipse; the dy of its rightmost
point; the middle of its chord at dy, over dy; the square of half a chord at dy = 0; and the decrease of that square
with dy^2. One is spare."""
SLOT = 16
"""Floats of an instance's gradient (blend.py): the moments 1, x, y, xx, xy, yy of dL/dpower about the tile's middle, x
and y of that middle, and dL/d(r, g, b, z) as 8:12 plus 12:16."""
FILL_BLOCK = 256
MAX_FRAMES = 16
"""Frames whose depths can be sorted together: their number has 4 bits of a depth key."""
DEPTH_BITS = 28
"""Bits of a depth in its key: exact for 32 powers of two above NEAR; all greater depths have one key."""

_EXTENT = tl.constexpr(EXTENT)
_SLACK = tl.constexpr(2e-3)  # pixels by which bounds are widened, against rounding; every pixel is tested anyway


@triton.jit
def rows_of(mean_y, reach, rows, TILE_H: tl.constexpr):  # type: ignore[no-untyped-def]
    """First and last row of tiles that a splat's ellipse may touch; last < first if there is none."""
    half = 0.5 + _SLACK
    first = tl.floor((mean_y - reach - half) * (1.0 / TILE_H))
    last = tl.floor((mean_y + reach - 0.5 + _SLACK) * (1.0 / TILE_H))
    limit = rows * 1.0
    first = tl.minimum(tl.maximum(first, 0.0), limit)
    last = tl.minimum(tl.maximum(last, -1.0), limit - 1.0)
    return first.to(tl.int32), last.to(tl.int32)


@triton.jit
def columns_of(  # type: ignore[no-untyped-def]
    mean_x, mean_y, reach, extreme, slope, square, fall, row, width, height, TILE_W: tl.constexpr, TILE_H: tl.constexpr
):
    """First tile and number of tiles in a row of tiles that the splat's ellipse touches.

    The right branch slope dy + sqrt(square - fall dy^2) is concave in dy, so its maximum over the row's pixel centres
    is at the ellipse's own extreme point clamped to them; the left one is its mirror image. Two kernels call this and
    must get bit-identical results, so multiply-adds are fused explicitly, not by the compiler.
    """
    top = (row * TILE_H).to(tl.float32) + 0.5 - mean_y
    bottom = tl.minimum(row * TILE_H + (TILE_H - 1), height - 1).to(tl.float32) + 0.5 - mean_y
    low, high = tl.maximum(top, -reach), tl.minimum(bottom, reach)
    dy = tl.minimum(tl.maximum(extreme, low), high)
    right = tl.fma(slope, dy, tl.sqrt(tl.maximum(tl.fma(-fall * dy, dy, square), 0.0)))
    dy = tl.minimum(tl.maximum(-extreme, low), high)
    left = tl.fma(slope, dy, -tl.sqrt(tl.maximum(tl.fma(-fall * dy, dy, square), 0.0)))
    last_pixel = (width - 1) * 1.0
    first = tl.minimum(tl.maximum(tl.ceil(mean_x + left - (0.5 + _SLACK)), 0.0), last_pixel + 1.0)
    last = tl.minimum(tl.maximum(tl.floor(mean_x + right - 0.5 + _SLACK), -1.0), last_pixel)
    first_tile = first.to(tl.int32) // TILE_W
    touches = (low <= high + 2 * _SLACK) & (first <= last)
    return first_tile, tl.where(touches, last.to(tl.int32) // TILE_W - first_tile + 1, 0)


@triton.jit
def count_tiles(  # type: ignore[no-untyped-def]
    mean_x, mean_y, reach, extreme, slope, square, fall, drawn, width, height, rows,
    TILE_W: tl.constexpr, TILE_H: tl.constexpr,
):  # fmt: skip
    """The number of tiles that each splat touches; 0 if it is not drawn."""
    row, last = rows_of(mean_y, reach, rows, TILE_H)
    last = tl.where(drawn, last, -1)
    total = tl.zeros_like(row)
    while tl.max(last - row) >= 0:
        _, count = columns_of(
            mean_x, mean_y, reach, extreme, slope, square, fall, row, width, height, TILE_W, TILE_H
        )  # fmt: skip
        total += tl.where(row <= last, count, 0)
        row += 1
    return total


@triton.jit(do_not_specialize=["capacity", "splats", "gaussians", "stride"])
def fill_slots(  # type: ignore[no-untyped-def]
    ends, order, count, extent, key, owner, slot_start, needed, ok,
    capacity, splats, gaussians, width, height, tiles_x, rows, no_tile, stride,
    TILE_W: tl.constexpr, TILE_H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write key and owner of every slot, slot_start [F N] of every splat with a slot, needed and ok (rasterizer.py).

    ends int64 [F N], order int64 [F N]: the splats, nearest first, frame after frame. splats = F N, gaussians = N;
    stride: the largest power of two up to F N.
    """
    slot = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    total = tl.load(ends + splats - 1)
    if tl.program_id(0) == 0:
        tl.store(needed, tl.maximum(tl.load(needed), tl.minimum(total, 2147483647).to(tl.int32)))
        tl.store(ok, tl.where(total > capacity, 0, tl.load(ok)))
    if tl.program_id(0) * BLOCK >= total:
        tl.store(key + slot, tl.full((BLOCK,), no_tile, key.dtype.element_ty), mask=slot < capacity)
        tl.store(owner + slot, tl.zeros((BLOCK,), tl.int32), mask=slot < capacity)
        return
    used = (slot < capacity) & (slot < total)

    rank = tl.zeros_like(slot)  # how many splats end at or before the slot
    while stride > 0:
        probe = rank + stride
        inside = used & (probe <= splats)
        rank = tl.where(inside & (tl.load(ends + probe - 1, mask=inside, other=0) <= slot), probe, rank)
        stride = stride // 2
    splat = tl.load(order + rank, mask=used, other=0).to(tl.int32)
    own = tl.load(count + splat, mask=used, other=0)
    ahead = (slot - (tl.load(ends + rank, mask=used, other=0) - own)).to(tl.int32)
    tl.store(slot_start + splat, slot, mask=used & (ahead == 0))

    at = extent + splat * _EXTENT
    mean_x, mean_y = tl.load(at, mask=used, other=0.0), tl.load(at + 1, mask=used, other=0.0)
    reach, extreme = tl.load(at + 2, mask=used, other=0.0), tl.load(at + 3, mask=used, other=0.0)
    slope = tl.load(at + 4, mask=used, other=0.0)
    square, fall = tl.load(at + 5, mask=used, other=0.0), tl.load(at + 6, mask=used, other=0.0)
    row, last = rows_of(mean_y, reach, rows, TILE_H)
    tile = tl.full((BLOCK,), -1, tl.int32)
    looking = (used & (row <= last)).to(tl.int32)
    while tl.max(looking) > 0:
        first, wide = columns_of(
            mean_x, mean_y, reach, extreme, slope, square, fall, row, width, height, TILE_W, TILE_H
        )  # fmt: skip
        tile = tl.where((looking > 0) & (ahead < wide), row * tiles_x + first + ahead, tile)
        ahead -= wide
        row += 1
        looking = tl.where((tile < 0) & (row <= last), looking, 0)
    number = tl.where(tile >= 0, splat // gaussians * (tiles_x * rows) + tile, no_tile)
    tl.store(key + slot, number.to(key.dtype.element_ty), mask=slot < capacity)
    tl.store(owner + slot, splat, mask=slot < capacity)
