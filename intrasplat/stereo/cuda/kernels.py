"""Triton kernels of matching: census words, costs, paths, winners, the line solver; the rest is tensor operations.

Symbols: F frames of h w pixels; D disparities, low <= d < low + D, of which index i is low + i; a point at x in the
left eye is at x - d in the right one. Volumes are [F, h, w, D], D fastest. LANES is the power of two from D up.
All volumes together have fewer than 2^31 entries (matching.VOLUME_BYTES), so places in them are int32.

    C(p, i)   cost: bits in which the census words of p and its match differ, over a block (Zabih and Woodfill 1994)
    L_r(p, i) = C(p, i) + min(L_r(p - r, i), L_r(p - r, i +- 1) + P1, min L_r(p - r) + P2) - min L_r(p - r)
    S(p, i)   = sum over the four directions r of L_r(p, i)          (Hirschmueller 2008, eq. 13, 14)

Layout. A disparity is a lane, so a step along a path is elementwise, except one minimum and the access to both
neighbours, which are shuffles within a warp. A program is one warp, whose steps are sequential. Many lines keep the GPU
busy; a frame has some hundred, so many frames are matched at once. The line solver has a line per lane. Images are
extended by their border pixels.
"""

from __future__ import annotations

import triton
import triton.language as tl

BLOCK_PX = 5
"""Side of the square over which a pixel's costs are summed."""
BEYOND = 1 << 12
"""Cost and sum of lanes beyond D: more than any real one, which is at most 4 (24 BLOCK_PX^2 + P2)."""
PACKED = 512
"""Sums and indices are compared together, as sum * PACKED + index; it is the maximum number of disparities."""

_kernel = triton.jit(
    do_not_specialize=[
        "pixels", "height", "width", "count", "low", "lines", "length",
        "line_stride", "step_stride", "frame_size", "small", "large",
    ]
)  # fmt: skip
"""Sizes are not specialised, so a clip of another size uses the kernels that are compiled already."""

_RADIUS = tl.constexpr(BLOCK_PX // 2)
_BEYOND = tl.constexpr(BEYOND)
_PACKED = tl.constexpr(PACKED)


@triton.jit
def _shifted(pixel, dy, dx, height, width):  # type: ignore[no-untyped-def]
    """The pixel (of any frame) dy rows below and dx columns to the right, clamped to the image."""
    x, y = pixel % width, pixel // width % height
    to_y, to_x = tl.minimum(tl.maximum(y + dy, 0), height - 1), tl.minimum(tl.maximum(x + dx, 0), width - 1)
    return pixel + (to_y - y) * width + to_x - x


@_kernel
def census(image, words, pixels, height, width, PIXELS: tl.constexpr):  # type: ignore[no-untyped-def]
    """words int32 [F, h, w]: a bit for each of the 24 neighbours of a pixel of image uint8 [F, h, w] that is darker."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < pixels
    centre = tl.load(image + pixel, mask=inside, other=0)
    word = tl.zeros((PIXELS,), tl.int32)
    for k in tl.static_range(25):
        if k != 12:
            at = _shifted(pixel, k // 5 - 2, k % 5 - 2, height, width)
            darker = tl.load(image + at, mask=inside, other=0) < centre
            word = word * 2 + darker.to(tl.int32)
    tl.store(words + pixel, word, mask=inside)


@triton.jit
def _bits_by_byte(word):  # type: ignore[no-untyped-def]
    """The number of set bits in each byte of a 24-bit word: the first steps of a population count."""
    word = word - ((word >> 1) & 0x555555)
    word = (word & 0x333333) + ((word >> 2) & 0x333333)
    return (word + (word >> 4)) & 0x0F0F0F


@_kernel
def column_costs(  # type: ignore[no-untyped-def]
    left, right, costs, low, pixels, height, width, count, PIXELS: tl.constexpr, LANES: tl.constexpr
):  # fmt: skip
    """costs uint8 [F, h, w, D]: differing bits of census words int32 [F, h, w], summed over the block's rows."""
    pixel = (tl.program_id(0) * PIXELS + tl.arange(0, PIXELS))[:, None]
    lane = tl.arange(0, LANES)[None, :]
    there = (pixel < pixels) & (lane < count)
    x = pixel % width
    to_match = tl.minimum(tl.maximum(x - low - lane, 0), width - 1) - x
    by_byte = tl.zeros((PIXELS, LANES), tl.int32)  # at most BLOCK_PX rows of 8 bits a byte
    for k in tl.static_range(2 * _RADIUS + 1):
        at = _shifted(pixel, k - _RADIUS, 0, height, width)
        word = tl.load(left + at, mask=pixel < pixels, other=0) ^ tl.load(right + at + to_match, mask=there, other=0)
        by_byte += _bits_by_byte(word)
    total = (by_byte & 255) + ((by_byte >> 8) & 255) + (by_byte >> 16)
    tl.store(costs + pixel * count + lane, total.to(tl.uint8), mask=there)


@_kernel
def block_costs(  # type: ignore[no-untyped-def]
    columns, costs, pixels, height, width, count, PIXELS: tl.constexpr, LANES: tl.constexpr
):  # fmt: skip
    """costs int16 [F, h, w, D]: the sums of column_costs, summed over the block's columns."""
    pixel = (tl.program_id(0) * PIXELS + tl.arange(0, PIXELS))[:, None]
    lane = tl.arange(0, LANES)[None, :]
    there = (pixel < pixels) & (lane < count)
    total = tl.zeros((PIXELS, LANES), tl.int32)
    for k in tl.static_range(2 * _RADIUS + 1):
        at = _shifted(pixel, 0, k - _RADIUS, height, width) * count + lane
        total += tl.load(columns + at, mask=there, other=0).to(tl.int32)
    tl.store(costs + pixel * count + lane, total.to(tl.int16), mask=there)


@triton.jit
def _follow(  # type: ignore[no-untyped-def]
    cost_at, sum_at, stride, length, there, lane, small, large, ADD: tl.constexpr, LANES: tl.constexpr
):  # fmt: skip
    """Compute L along a line from cost_at and sum_at, and write or add it to the sums; returns the last positions.

    Each step's input is loaded one step early, so that steps wait for each other alone, not for memory.
    """
    path = tl.zeros(there.shape, tl.int32)  # in front of the first pixel: there L is the cost
    to_nearer = tl.broadcast_to(tl.maximum(lane - 1, 0), there.shape)
    to_farther = tl.broadcast_to(tl.minimum(lane + 1, LANES - 1), there.shape)
    cost, before = tl.load(cost_at, mask=there, other=_BEYOND).to(tl.int32), path
    if ADD:
        before = tl.load(sum_at, mask=there, other=0).to(tl.int32)
    k = 1
    while k <= length:
        more = tl.where(there, k, length) < length  # Triton 3.9 interprets no mask made of a scalar comparison
        cost_at += stride
        next_cost, next_before = tl.load(cost_at, mask=more, other=_BEYOND).to(tl.int32), before
        if ADD:
            next_before = tl.load(sum_at + stride, mask=more, other=0).to(tl.int32)
        least = tl.min(path, 1)[:, None]
        # At either end the neighbour is the lane itself, which at the cost of a step is never the minimum.
        neighbour = tl.minimum(tl.gather(path, to_nearer, 1), tl.gather(path, to_farther, 1))
        path = cost + tl.minimum(tl.minimum(path, neighbour + small) - least, large)
        tl.store(sum_at, (path + before).to(tl.int16), mask=there)
        sum_at += stride
        cost, before = next_cost, next_before
        k += 1
    return cost_at - stride, sum_at - stride


@_kernel
def add_paths(  # type: ignore[no-untyped-def]
    costs, sums, lines, length, line_stride, step_stride, frame_size, count, small, large,
    ADD: tl.constexpr, LINES: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Follow `lines` parallel lines of every frame there and back: sums int16 [F, h, w, D] gains both L.

    Pixel k of line j of a frame is the frame's pixel j line_stride + k step_stride; small is P1, large P2. Without ADD,
    sums is overwritten.
    """
    line = (tl.program_id(0) * LINES + tl.arange(0, LINES))[:, None]
    lane = tl.arange(0, LANES)[None, :]
    there = (line < lines) & (lane < count)
    first = (tl.program_id(1) * frame_size + line * line_stride) * count + lane
    stride = step_stride * count
    cost_at, sum_at = _follow(costs + first, sums + first, stride, length, there, lane, small, large, ADD, LANES)
    tl.debug_barrier()  # what was stored is read again, perhaps by another thread
    _follow(cost_at, sum_at, -stride, length, there, lane, small, large, True, LANES)


@triton.jit
def _winner(sums, at, there, lane):  # type: ignore[no-untyped-def]
    """The index of the minimum sum of each row [PIXELS], the first of equal ones, and that sum."""
    both = tl.load(sums + at, mask=there, other=_BEYOND).to(tl.int32) * _PACKED + lane
    least = tl.min(both, 1)
    return least % _PACKED, least // _PACKED


@_kernel
def winners(  # type: ignore[no-untyped-def]
    sums, left, right, low, pixels, width, count, PIXELS: tl.constexpr, LANES: tl.constexpr
):  # fmt: skip
    """Disparities float32 [F, h, w] of both eyes' pixels, the left ones' to fractions of a pixel.

    The right eye's pixel x matches the left eye's x + d at disparity d. Costs grow about linearly away from the best
    match, so its fraction is where two lines of equal and opposite slope through the neighbours intersect.
    """
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    lane = tl.arange(0, LANES)[None, :]
    inside = pixel < pixels
    there = inside[:, None] & (lane < count)
    start = pixel * count
    best, least = _winner(sums, start[:, None] + lane, there, lane)
    between = inside & (best > 0) & (best < count - 1)
    below = tl.load(sums + start + best - 1, mask=between, other=0).to(tl.int32) - least
    above = tl.load(sums + start + best + 1, mask=between, other=0).to(tl.int32) - least
    steeper = tl.maximum(tl.maximum(below, above), 1).to(tl.float32)
    fraction = tl.where(between, (below - above).to(tl.float32) / (2.0 * steeper), 0.0)
    tl.store(left + pixel, (low + best).to(tl.float32) + fraction, mask=inside)
    x = (pixel % width)[:, None]
    to_match = tl.minimum(tl.maximum(x + low + lane, 0), width - 1) - x
    best, _ = _winner(sums, (pixel[:, None] + to_match) * count + lane, there, lane)
    tl.store(right + pixel, (low + best).to(tl.float32), mask=inside)


@_kernel
def smooth_lines(  # type: ignore[no-untyped-def]
    guide, first, second, gains, lines, length, line_stride, step_stride, frame_size, strength, steepness,
    LINES: tl.constexpr,
):  # fmt: skip
    """Solve (I + strength A) u = v along every line for two images at once, in place: one pass of Min et al. 2014.

    A is the Laplacian of a chain whose links weigh 2^(-steepness |difference of guide|). guide uint8, first, second and
    the scratch `gains` float32 [F, h, w]; lines as in add_paths. The system is tridiagonal (Thomas's algorithm):
    forward u_k = (v_k + a u_(k-1)) / (1 + a + c - a g_(k-1)), g_k = c / (the same), with links a before and c behind;
    then backward u_k += g_k u_(k+1). The result is a mean with positive weights, so it is stable.
    """
    line = tl.program_id(0) * LINES + tl.arange(0, LINES)
    there = line < lines
    start = tl.program_id(1) * frame_size + line * line_stride
    guide_at, first_at, second_at, gains_at = guide + start, first + start, second + start, gains + start
    here = tl.load(guide_at, mask=there, other=0).to(tl.float32)
    before = tl.zeros((LINES,), tl.float32)
    gain, one, two = before, before, before
    k = 1
    while k <= length:
        v_one, v_two = tl.load(first_at, mask=there, other=0.0), tl.load(second_at, mask=there, other=0.0)
        more = tl.where(there, k, length) < length  # Triton 3.9 interprets no mask made of a scalar comparison
        guide_at += step_stride
        following = tl.load(guide_at, mask=more, other=0).to(tl.float32)
        behind = tl.where(more, strength * tl.exp2(-steepness * tl.abs(here - following)), 0.0)
        share = 1.0 / (1.0 + before + behind - before * gain)
        one, two, gain = (v_one + before * one) * share, (v_two + before * two) * share, behind * share
        tl.store(first_at, one, mask=there)
        tl.store(second_at, two, mask=there)
        tl.store(gains_at, gain, mask=there)
        here, before = following, behind
        first_at += step_stride
        second_at += step_stride
        gains_at += step_stride
        k += 1
    tl.debug_barrier()  # what was stored is read again, perhaps by another thread
    one, two = tl.zeros((LINES,), tl.float32), tl.zeros((LINES,), tl.float32)
    while k > 1:
        first_at -= step_stride
        second_at -= step_stride
        gains_at -= step_stride
        gain = tl.load(gains_at, mask=there, other=0.0)
        one = tl.load(first_at, mask=there, other=0.0) + gain * one
        two = tl.load(second_at, mask=there, other=0.0) + gain * two
        tl.store(first_at, one, mask=there)
        tl.store(second_at, two, mask=there)
        k -= 1
