"""The blend on the device: compositing, the loss, and the gradients of every splat; one program per tile.

Symbols: K splats of a chunk (axis 0), P pixels of a tile (axis 1); for one pixel and its splats i, nearest first,
    alpha_i = min(MAX_ALPHA, 2**power2_i), 0 below MIN_ALPHA or once T < MIN_TRANSMITTANCE
    T_i     = product over j < i of (1 - alpha_j);  w_i = alpha_i T_i
    s_i     = g_C . c_i + g_Z z_i + g_A, with g the loss gradient at this pixel
    B_(i-1) = alpha_i s_i + (1 - alpha_i) B_i,  B_last = 0: the blend of s of the splats behind splat i - 1
    dL/dpower_i = w_i (s_i - B_i), 0 where alpha was clamped to MAX_ALPHA
as in intrasplat/splat/cpu/blend.py. The forward pass stores T before each chunk, and the backward pass computes a
chunk's alphas again. Derivations: docs/rasterizer.md; the loss: intrasplat/splat/loss.py.

Layout. Pixels lie along the lanes, and one thread has all K splats of a pixel: products, sums and steps from splat to
splat need no shuffle. A program is one warp, so its barriers cost nothing. The K P / 32 independent numbers of a thread
hide latency. Sums over pixels are matrix products on the tensor cores: dL/dpower times the monomials 1 x y xx xy yy of
the pixel (relative to the tile's middle), and w times g. One operand is split into two parts of 11 bits, hence exact to
2^-22. The monomials have few enough bits to be exact, and g is split too, into 8 columns.

Each instance's gradient is written to its own slot (bins.py). There are no atomics, so results are bit-identical.
"""

from __future__ import annotations

import triton
import triton.language as tl

from intrasplat.splat.constants import MAX_ALPHA, MIN_ALPHA, MIN_COVERAGE, MIN_TRANSMITTANCE
from intrasplat.splat.cuda.bins import SLOT
from intrasplat.splat.cuda.project import RECORD

CHUNK = 16
"""Splats per chunk: the smallest size of a matrix product; an intermediate has K P / 32 = 32 registers."""
WARPS = 1
STATISTICS = 4
"""Sums of a tile over tissue: colour L1, depth L1, squared error of the colour channels, 1 - A."""
RENDER, LOSS, COTANGENT = 0, 1, 2
"""Modes. RENDER writes images. LOSS computes gradients of the built-in loss and writes no image. COTANGENT computes
gradients from given image gradients."""

_RECORD = tl.constexpr(RECORD)
_SLOT = tl.constexpr(SLOT)
_STATISTICS = tl.constexpr(STATISTICS)
_RENDER, _LOSS = tl.constexpr(RENDER), tl.constexpr(LOSS)
_MIN_ALPHA, _MAX_ALPHA = tl.constexpr(MIN_ALPHA), tl.constexpr(MAX_ALPHA)
_STOP = tl.constexpr(MIN_TRANSMITTANCE)
_UPPER_BITS = tl.constexpr(-(1 << 13))  # the sign, the exponent and 10 bits of a float32: what TF32 keeps
_PER_BYTE = tl.constexpr(1.0 / 255.0)
_MIN_COVERAGE = tl.constexpr(MIN_COVERAGE)
_NOWHERE = tl.constexpr(-1000.0)  # log2 of an opacity that is never drawn


@triton.jit
def _rows(owner, i, first, end, in_chunk):  # type: ignore[no-untyped-def]
    """Record numbers of the instances i + in_chunk; beyond the tile's own [first, end) that of its last.

    They are read a chunk ahead, so that the load of a record does not wait for its number.
    """
    at = tl.minimum(tl.maximum(i, first) + in_chunk, end - 1)
    return tl.load(owner + at, mask=at >= first, other=0)


@triton.jit
def _both(pair):  # type: ignore[no-untyped-def]
    """The two float32 of which int64 [K] are made, each [K, 1]."""
    low, high = pair.to(tl.int32), (pair >> 32).to(tl.int32)
    return low.to(tl.float32, bitcast=True)[:, None], high.to(tl.float32, bitcast=True)[:, None]


@triton.jit
def _two(records, row, part: tl.constexpr):  # type: ignore[no-untyped-def]
    """Floats 2 part and 2 part + 1 of K records, each [K, 1]."""
    return _both(tl.load(records + row * (_RECORD // 2) + part))


@triton.jit
def _four(records, row, part: tl.constexpr):  # type: ignore[no-untyped-def]
    """Floats 2 part to 2 part + 3 of K records, each [K, 1]: two lanes read a record, and every thread gets all."""
    columns = tl.arange(0, 2)[None, :] + part
    low, high = tl.split(tl.load(records + row[:, None] * (_RECORD // 2) + columns))
    first, second = _both(low)
    third, fourth = _both(high)
    return first, second, third, fourth


@triton.jit
def _row(values, k, which: tl.constexpr):  # type: ignore[no-untyped-def]
    """[P] row `which` of values [K, P]. It compiles to no instructions: each thread's k is known, so the integer sum is
    one register."""
    return tl.sum(tl.where(k == which, values.to(tl.int32, bitcast=True), 0), 0).to(tl.float32, bitcast=True)


@triton.jit
def _one_later(values, first, k, K: tl.constexpr, P: tl.constexpr):  # type: ignore[no-untyped-def]
    """values [K, P] shifted by one row, with first [P] in row 0. It only renames registers, too.

    k - 1 is k with its lowest set bit and all bits below it inverted. Two rows are exchanged as (a + b) - a = b, in
    integers, where that is exact and the compiler removes it.
    """
    bits = values.to(tl.int32, bitcast=True)
    moved = tl.where(k == 0, first[None, :].to(tl.int32, bitcast=True), bits)
    for i in tl.static_range(K.bit_length() - 1):
        bits = tl.reshape(bits, (K // 2 ** (i + 1), 2, 2**i, P))
        bits = tl.reshape(tl.sum(bits, 1, keep_dims=True) - bits, (K, P))
        moved = tl.where(k % 2 ** (i + 1) == 2**i, bits, moved)
    return moved.to(tl.float32, bitcast=True)


@triton.jit
def _alphas(records, row, there, x, y):  # type: ignore[no-untyped-def]
    """2^power2 and alpha [K, P] of a chunk, before alpha is set to 0 at full pixels."""
    mean_x, mean_y, k_xx, k_xy = _four(records, row, 0)
    k_yy, lo = _two(records, row, 2)
    lo = tl.where(there[:, None], lo, _NOWHERE)
    dx, dy = x[None, :] - mean_x, y[None, :] - mean_y
    raw = tl.exp2(tl.fma(dx, tl.fma(k_xx, dx, k_xy * dy), tl.fma(k_yy * dy, dy, lo)))
    return raw, tl.where(raw < _MIN_ALPHA, 0.0, tl.minimum(raw, _MAX_ALPHA))


@triton.jit
def _blended(alpha, before, k, K: tl.constexpr, P: tl.constexpr):  # type: ignore[no-untyped-def]
    """alpha, 0 at full pixels; the weights; and T after the chunk. before [P]: T before the chunk."""
    after = tl.cumprod((1.0 - alpha) * tl.where(k == 0, before[None, :], 1.0), 0)
    here = _one_later(after, before, k, K, P)
    # Beyond a full pixel T only gets smaller, so the products may go on (intrasplat/splat/reference.py).
    alpha = tl.where(here < _STOP, 0.0, alpha)
    return alpha, alpha * here, _row(after, k, K - 1)


@triton.jit
def _upper(value):  # type: ignore[no-untyped-def]
    """value truncated to TF32 precision; the remainder fits in TF32 too."""
    return (value.to(tl.int32, bitcast=True) & _UPPER_BITS).to(tl.float32, bitcast=True)


@triton.jit
def _sum_split(values, columns):  # type: ignore[no-untyped-def]
    """values [K, P] times columns [P, 8], whose numbers have at most 11 bits: [K, 8]."""
    upper = _upper(values)
    lower = tl.dot(values - upper, columns, input_precision="tf32")
    return tl.dot(upper, columns, lower, input_precision="tf32")


@triton.jit
def _split_columns(red, green, blue, depth):  # type: ignore[no-untyped-def]
    """[P, 8]: the upper bits of four numbers per pixel, then their remainders."""
    column = tl.arange(0, 8)[None, :]
    which = column % 4
    value = tl.where(which < 2, tl.where(which == 0, red[:, None], green[:, None]), blue[:, None])
    value = tl.where(which == 3, depth[:, None], value)
    return tl.where(column < 4, _upper(value), value - _upper(value))


@triton.jit
def _clip_unit(value):  # type: ignore[no-untyped-def]
    """value clamped to [-1, 1]: the derivative of the Huber loss with delta 1."""
    return tl.minimum(tl.maximum(value, -1.0), 1.0)


@triton.jit
def _monomials(x, y):  # type: ignore[no-untyped-def]
    """[P, 8]: 1 x y xx xy yy 0 0 of pixels at x, y [P]."""
    column = tl.arange(0, 8)[None, :]
    by_x = tl.where((column == 1) | (column == 4), x[:, None], tl.where(column == 3, (x * x)[:, None], 1.0))
    by_y = tl.where((column == 2) | (column == 4), y[:, None], tl.where(column == 5, (y * y)[:, None], 1.0))
    return tl.where(column < 6, by_x * by_y, 0.0)


@triton.jit
def _colour_loss(colour, target, q, inside, tissue, sharpness, weight):  # type: ignore[no-untyped-def]
    """One channel's L1, squared error and gradient at P pixels."""
    error = colour - tl.load(target + q, mask=inside, other=0).to(tl.float32) * _PER_BYTE
    slope = _clip_unit(error * sharpness) * tissue * weight
    return tl.sum(tl.abs(error) * tissue), tl.sum(error * error * tissue), slope


@triton.jit
def _depth_loss(depth, cover, wanted, tissue, normalised, sharpness, weight):  # type: ignore[no-untyped-def]
    """L1 of the inverse depth, and its gradients to sum w z and sum w."""
    # Pixels that are hardly covered have no depth loss; _MIN_COVERAGE keeps the divisions finite.
    usable = (wanted > 0.0) & (cover > _MIN_COVERAGE)
    inverse = 1.0 / tl.where(usable & (tissue > 0.0), depth, 1.0)
    rendered = tl.where(normalised, cover * inverse, inverse)
    error = rendered - wanted
    share = tl.where(usable, tissue, 0.0)
    slope = _clip_unit(error * sharpness) * share * weight
    # The inverse depth is 1 / Z (paper) or A / Z (normalised); its derivative to A is 1 / Z in the second case.
    return tl.sum(share * tl.abs(error)), -slope * rendered * inverse, tl.where(normalised, slope * inverse, 0.0)


@triton.jit
def blend(  # type: ignore[no-untyped-def]
    records, owner, slot, tile_start, before, image, slots, statistics,
    target, weight, inverse_depth, loss_settings, frame,
    width, height, tiles_x, tiles,
    MODE: tl.constexpr, VALUES: tl.constexpr, TILE_W: tl.constexpr, TILE_H: tl.constexpr, K: tl.constexpr,
):  # fmt: skip
    """Composite one tile of one frame: program = frame * tiles + tile, tiles row by row.

    records [F N, RECORD] (project.py), as int64. owner int32, slot int64 [M]: record and slot of every instance,
    sorted by tile, nearest first; tile_start int32 [F tiles + 1]. before [M / K + F tiles, P]: scratch for T before
    each chunk.
    image [F, 5 or 6, H, W]: R G B Z A and, with VALUES, the blended value: written in RENDER; read as cotangents in
    COTANGENT. slots [M, SLOT] and, in LOSS, statistics [F tiles, STATISTICS] are written.
    target [*, 3, H, W] uint8, weight [*, H, W] uint8 (255 = tissue), inverse_depth [*, H, W] (0 = none), of which the
    tile's frame is frame[f]; loss_settings float32 [F, 5]: colour weight per channel, depth weight, 1 / Huber delta of
    the colour and of the depth loss, 1 for normalised depth else 0.

    One long function, so that the pixels' sums stay in registers from the first chunk to the last.
    """
    P: tl.constexpr = TILE_W * TILE_H
    program = tl.program_id(0)
    f, tile = program // tiles, program % tiles
    pixel = tl.arange(0, P)
    column, line = tile % tiles_x * TILE_W + pixel % TILE_W, tile // tiles_x * TILE_H + pixel // TILE_W
    inside = (column < width) & (line < height)
    x, y = column.to(tl.float32) + 0.5, line.to(tl.float32) + 0.5
    at_pixel, size = line * width + column, width * height
    first, end = tl.load(tile_start + program), tl.load(tile_start + program + 1)
    in_chunk = tl.arange(0, K)
    k = in_chunk[:, None]
    scratch = before + (first // K + program).to(tl.int64) * P

    transmittance = tl.where(inside, 1.0, 0.0)
    red = tl.zeros((P,), tl.float32)
    green, blue, depth, cover, value = red, red, red, red, red
    i = first
    row = _rows(owner, i, first, end, in_chunk)
    while (i < end) & (tl.max(transmittance) >= _STOP):
        there = i + in_chunk < end
        next_row = _rows(owner, i + K, first, end, in_chunk)
        if MODE != _RENDER:
            tl.store(scratch + pixel, transmittance)
            scratch += P
        _, alpha = _alphas(records, row, there, x, y)
        _, w, transmittance = _blended(alpha, transmittance, k, K, P)
        c_red, c_green, c_blue, c_depth = _four(records, row, 4)
        red += tl.sum(w * c_red, 0)
        green += tl.sum(w * c_green, 0)
        blue += tl.sum(w * c_blue, 0)
        depth += tl.sum(w * c_depth, 0)
        cover += tl.sum(w, 0)
        if VALUES:
            c_value, _ = _two(records, row, 3)
            value += tl.sum(w * c_value, 0)
        row = next_row
        i += K

    if MODE == _RENDER:
        planes: tl.constexpr = 6 if VALUES else 5
        out = image + (f * planes).to(tl.int64) * size + at_pixel
        tl.store(out, red, mask=inside)
        tl.store(out + size, green, mask=inside)
        tl.store(out + 2 * size, blue, mask=inside)
        tl.store(out + 3 * size, depth, mask=inside)
        tl.store(out + 4 * size, cover, mask=inside)
        if VALUES:
            tl.store(out + 5 * size, value, mask=inside)
    else:
        if MODE == _LOSS:
            source = tl.load(frame + f).to(tl.int64) * size
            settings = loss_settings + 5 * f
            colour_weight, depth_weight = tl.load(settings), tl.load(settings + 1)
            sharp, depth_sharp = tl.load(settings + 2), tl.load(settings + 3)
            normalised = tl.load(settings + 4) > 0.0
            tissue = tl.load(weight + source + at_pixel, mask=inside, other=0).to(tl.float32) * _PER_BYTE
            channel = target + 3 * source
            l1_r, sq_r, g_red = _colour_loss(red, channel, at_pixel, inside, tissue, sharp, colour_weight)
            l1_g, sq_g, g_green = _colour_loss(green, channel + size, at_pixel, inside, tissue, sharp, colour_weight)
            l1_b, sq_b, g_blue = _colour_loss(blue, channel + 2 * size, at_pixel, inside, tissue, sharp, colour_weight)
            wanted = tl.load(inverse_depth + source + at_pixel, mask=inside, other=0.0).to(tl.float32)
            depth_l1, g_depth, g_cover = _depth_loss(
                depth, cover, wanted, tissue, normalised, depth_sharp, depth_weight
            )
            report = statistics + program * _STATISTICS
            tl.store(report, l1_r + l1_g + l1_b)
            tl.store(report + 1, depth_l1)
            tl.store(report + 2, sq_r + sq_g + sq_b)
            tl.store(report + 3, tl.sum(tissue * (1.0 - cover)))
        else:
            given = image + (f * 5).to(tl.int64) * size + at_pixel
            g_red = tl.load(given, mask=inside, other=0.0)
            g_green = tl.load(given + size, mask=inside, other=0.0)
            g_blue = tl.load(given + 2 * size, mask=inside, other=0.0)
            g_depth = tl.load(given + 3 * size, mask=inside, other=0.0)
            g_cover = tl.load(given + 4 * size, mask=inside, other=0.0)

        # Relative to the tile's middle the monomials are small, and exact in few bits.
        monomials = _monomials((pixel % TILE_W).to(tl.float32) - 0.5 * (TILE_W - 1),
                               (pixel // TILE_W).to(tl.float32) - 0.5 * (TILE_H - 1))  # fmt: skip
        of_colour = _split_columns(g_red, g_green, g_blue, g_depth)
        part = tl.arange(0, 8)[None, :]
        middle = tl.where(part == 6, (tile % tiles_x * TILE_W + 0.5 * TILE_W), 0.0)
        middle = tl.where(part == 7, (tile // tiles_x * TILE_H + 0.5 * TILE_H), middle)
        behind = tl.zeros((P,), tl.float32)
        tl.debug_barrier()  # another thread of the warp may have written the scratch that this one reads
        j = i
        row = _rows(owner, j - K, first, end, in_chunk)
        while j > first:
            j -= K
            next_row = _rows(owner, j - K, first, end, in_chunk)
            scratch -= P
            there = j + in_chunk < end
            place = tl.load(slot + j + in_chunk, mask=there, other=0)
            out = slots + place.to(tl.int64)[:, None] * _SLOT + part
            raw, alpha = _alphas(records, row, there, x, y)
            alpha, w, _ = _blended(alpha, tl.load(scratch + pixel), k, K, P)
            tl.store(out + 8, _sum_split(w, of_colour), mask=there[:, None])
            c_red, c_green, c_blue, c_depth = _four(records, row, 4)
            own = tl.fma(g_red[None, :], c_red, g_green[None, :] * c_green)
            own += tl.fma(g_blue[None, :], c_blue, tl.fma(g_depth[None, :], c_depth, g_cover[None, :]))
            v_power = tl.zeros((K, P), tl.float32)
            for back in tl.static_range(1, K + 1):
                score = _row(own, k, K - back) - behind
                v_power = tl.where(k == K - back, score[None, :], v_power)
                behind = tl.fma(_row(alpha, k, K - back), score, behind)
            v_power = tl.where(raw < _MAX_ALPHA, w * v_power, 0.0)
            tl.store(out, _sum_split(v_power, monomials) + middle, mask=there[:, None])
            row = next_row
        while i < end:  # instances behind a full tile
            there = i + in_chunk < end
            place = tl.load(slot + i + in_chunk, mask=there, other=0)
            out = slots + place.to(tl.int64)[:, None] * _SLOT + part
            tl.store(out, tl.zeros((K, 8), tl.float32), mask=there[:, None])
            tl.store(out + 8, tl.zeros((K, 8), tl.float32), mask=there[:, None])
            i += K
