"""Gaussians to the image and back, on the device: the per-Gaussian half of the rasteriser.

N Gaussians, F frames; rows of N floats: state [F, 10 or more, N] = mean 0:3, quaternion wxyz 3:7, log-scale 7:10
(deformed to each frame's time), opacity_logit [N], colour [F, 3, N]. A splat is a Gaussian on the image, RECORD floats:
    0 1   mean2d x, y in px
    2 3 4 the conic times -log2(e) / 2, -log2(e), -log2(e) / 2: power2 = lo + k_xx dx^2 + k_xy dx dy + k_yy dy^2
    5     lo = log2(opacity), so that alpha = 2**power2
    6 7 8 colour
    9     camera z
    10    a value of the caller's that is blended as colour is
    11    spare
Arithmetic is float64 as on the CPU (worker/raster/cpu/project.py), storage float32; exponentials have float32's
precision and end at 2**20, so no log-scale or logit, however far out, leaves the numbers.
"""

from __future__ import annotations

import triton
import triton.language as tl

from worker.raster import EPS2D, LIMIT, MIN_ALPHA, NEAR
from worker.raster.cuda.bins import DEPTH_BITS, EXTENT, count_tiles

RECORD = 12
"""Floats a splat record holds: 48 bytes, three loads of 16."""
SUMS = 10
"""What a splat's slots add up to: the moments 1, x, y, xx, xy, yy of dL/dpower about mean2d, dL/d(r, g, b, z)."""
PROJECT_BLOCK = 128

_RECORD, _EXTENT, _SUMS = tl.constexpr(RECORD), tl.constexpr(EXTENT), tl.constexpr(SUMS)
_NEAR, _EPS2D, _LIMIT = tl.constexpr(NEAR), tl.constexpr(EPS2D), tl.constexpr(LIMIT)
_LOG2E, _LN2 = tl.constexpr(1.4426950408889634), tl.constexpr(0.6931471805599453)
_LOG2_MIN_ALPHA = tl.constexpr(-7.994353436858858)
assert abs(2.0**_LOG2_MIN_ALPHA.value - MIN_ALPHA) < 1e-12
_MOST_POWER = tl.constexpr(20.0)
_EXTENT_SLACK = tl.constexpr(1e-3)  # of the squared Mahalanobis radius: where alpha is 1/2000 below MIN_ALPHA
_LARGEST = tl.constexpr(1e300)
_DEPTHS = tl.constexpr(1 << DEPTH_BITS)
_NEAR_BITS = tl.constexpr(0x3E4CCCCD)  # of NEAR as a float32
_HALF_RANGE = tl.constexpr(1 << 31)


@triton.jit
def _exp(x):  # type: ignore[no-untyped-def]
    """e^x of a float32, at most 2**_MOST_POWER."""
    return tl.exp2(tl.minimum(x * _LOG2E, _MOST_POWER))


@triton.jit
def _rotation(state, n, there, N):  # type: ignore[no-untyped-def]
    """Unit quaternion wxyz, 1 / its stored length, and its rotation matrix, row by row."""
    w = tl.load(state + 3 * N + n, mask=there, other=1.0).to(tl.float64)
    x = tl.load(state + 4 * N + n, mask=there, other=0.0).to(tl.float64)
    y = tl.load(state + 5 * N + n, mask=there, other=0.0).to(tl.float64)
    z = tl.load(state + 6 * N + n, mask=there, other=0.0).to(tl.float64)
    inverse = 1.0 / tl.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    return (
        w, x, y, z, inverse,
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def _variances(state, n, there, N):  # type: ignore[no-untyped-def]
    """Squared scales."""
    a = _exp(tl.load(state + 7 * N + n, mask=there, other=0.0)).to(tl.float64)
    b = _exp(tl.load(state + 8 * N + n, mask=there, other=0.0)).to(tl.float64)
    c = _exp(tl.load(state + 9 * N + n, mask=there, other=0.0)).to(tl.float64)
    return a * a, b * b, c * c


@triton.jit
def _mean(state, n, there, N):  # type: ignore[no-untyped-def]
    a = tl.load(state + n, mask=there, other=0.0).to(tl.float64)
    b = tl.load(state + N + n, mask=there, other=0.0).to(tl.float64)
    c = tl.load(state + 2 * N + n, mask=there, other=0.0).to(tl.float64)
    return a, b, c


@triton.jit
def _dot(a0, a1, a2, b0, b1, b2):  # type: ignore[no-untyped-def]
    return a0 * b0 + a1 * b1 + a2 * b2


@triton.jit
def _seen(camera, a, b, c):  # type: ignore[no-untyped-def]
    """Camera coordinates of world points."""
    x = _dot(tl.load(camera + 6), tl.load(camera + 7), tl.load(camera + 8), a, b, c) + tl.load(camera + 9)
    y = _dot(tl.load(camera + 10), tl.load(camera + 11), tl.load(camera + 12), a, b, c) + tl.load(camera + 13)
    z = _dot(tl.load(camera + 14), tl.load(camera + 15), tl.load(camera + 16), a, b, c) + tl.load(camera + 17)
    return x, y, z


@triton.jit
def _limits(camera, first: tl.constexpr):  # type: ignore[no-untyped-def]
    """Least and greatest x / z (first 0) or y / z (first 1) at which J is taken (Camera.ratio_limits)."""
    focal, centre, size = tl.load(camera + first), tl.load(camera + 2 + first), tl.load(camera + 4 + first)
    return (-centre - size * _LIMIT) / focal, (size - centre + size * _LIMIT) / focal


@triton.jit
def _image_row(camera, first: tl.constexpr, ratio, inverse_z):  # type: ignore[no-untyped-def]
    """A row of A = J W (2 x 3): its factor j = focal / z, the clamped ratio u, and j (W_row - u W_z)."""
    low, high = _limits(camera, first)
    held = tl.minimum(tl.maximum(ratio, low), high)
    j = tl.load(camera + first) * inverse_z
    row = camera + 6 + 4 * first
    return (
        j,
        held,
        j * (tl.load(row) - held * tl.load(camera + 14)),
        j * (tl.load(row + 1) - held * tl.load(camera + 15)),
        j * (tl.load(row + 2) - held * tl.load(camera + 16)),
    )


@triton.jit
def project(  # type: ignore[no-untyped-def]
    camera, state, opacity_logit, colour, records, extent, count, depth_key,
    N, state_rows, width, height, tiles_x, tiles_y,
    TILE_W: tl.constexpr, TILE_H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Splats of frame program_id(1): records [F N, RECORD], extent [F N, EXTENT] (bins.py), count [F N] of tiles, 0 for
    a culled one, and depth_key [F N], which sorts by frame, then depth, culled ones last.

    camera: float64 [F, 18] = fx, fy, cx, cy, W, H, camera_from_world row-major [3, 4].
    """
    f = tl.program_id(1)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = n < N
    camera += 18 * f
    state += (f * state_rows).to(tl.int64) * N
    a, b, c = _mean(state, n, there, N)
    x, y, z = _seen(camera, a, b, c)
    in_front = there & (z > _NEAR)
    inverse_z = 1.0 / tl.where(in_front, z, 1.0)
    _, _, _, _, _, r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(state, n, there, N)
    v0, v1, v2 = _variances(state, n, there, N)
    j0, _, a00, a01, a02 = _image_row(camera, 0, x * inverse_z, inverse_z)
    j1, _, a10, a11, a12 = _image_row(camera, 1, y * inverse_z, inverse_z)
    # B = A R, cov2d = B S^2 B^T + EPS2D I
    b00, b01 = _dot(a00, a01, a02, r00, r10, r20), _dot(a00, a01, a02, r01, r11, r21)
    b02, b10 = _dot(a00, a01, a02, r02, r12, r22), _dot(a10, a11, a12, r00, r10, r20)
    b11, b12 = _dot(a10, a11, a12, r01, r11, r21), _dot(a10, a11, a12, r02, r12, r22)
    cxx = _dot(b00 * b00, b01 * b01, b02 * b02, v0, v1, v2) + _EPS2D
    cxy = _dot(b00 * b10, b01 * b11, b02 * b12, v0, v1, v2)
    cyy = _dot(b10 * b10, b11 * b11, b12 * b12, v0, v1, v2) + _EPS2D
    det = cxx * cyy - cxy * cxy
    inverse_det = 1.0 / det
    mean_x, mean_y = (j0 * x + tl.load(camera + 2)).to(tl.float32), (j1 * y + tl.load(camera + 3)).to(tl.float32)
    logit = tl.load(opacity_logit + n, mask=there, other=0.0)
    log2_opacity = -tl.log2(1.0 + _exp(-logit))

    extent2 = (log2_opacity - _LOG2_MIN_ALPHA) * (2.0 * _LN2) + _EXTENT_SLACK
    drawn = in_front & (extent2 >= 0.0) & (det > 0.0) & (det < _LARGEST)
    extent2 = tl.maximum(extent2, 0.0).to(tl.float64)
    reach = tl.sqrt(extent2 * cyy).to(tl.float32)
    turn = (cxy * tl.sqrt(extent2 / cxx)).to(tl.float32)
    lean = (cxy / cyy).to(tl.float32)
    square, fall = (extent2 * det / cyy).to(tl.float32), (det / (cyy * cyy)).to(tl.float32)
    tiles = count_tiles(
        mean_x, mean_y, reach, turn, lean, square, fall, drawn, width, height, tiles_y, TILE_W, TILE_H
    )  # fmt: skip
    splat = f * N + n
    tl.store(count + splat, tiles, mask=there)
    depth = z.to(tl.float32)
    bits = tl.minimum(tl.maximum(depth.to(tl.int32, bitcast=True) - _NEAR_BITS, 0), _DEPTHS - 2)
    bits = tl.where(tiles > 0, bits, _DEPTHS - 1)
    key = f.to(tl.int64) * _DEPTHS + bits - _HALF_RANGE
    tl.store(depth_key + splat, key.to(tl.int32), mask=there)

    at = extent + splat * _EXTENT
    tl.store(at, mean_x, mask=there)
    tl.store(at + 1, mean_y, mask=there)
    tl.store(at + 2, reach, mask=there)
    tl.store(at + 3, turn, mask=there)
    tl.store(at + 4, lean, mask=there)
    tl.store(at + 5, square, mask=there)
    tl.store(at + 6, fall, mask=there)
    at = records + splat * _RECORD
    tl.store(at, mean_x, mask=there)
    tl.store(at + 1, mean_y, mask=there)
    tl.store(at + 2, (cyy * inverse_det * (-0.5 * _LOG2E)).to(tl.float32), mask=there)
    tl.store(at + 3, (cxy * inverse_det * _LOG2E).to(tl.float32), mask=there)
    tl.store(at + 4, (cxx * inverse_det * (-0.5 * _LOG2E)).to(tl.float32), mask=there)
    tl.store(at + 5, log2_opacity, mask=there)
    colour += (3 * f).to(tl.int64) * N + n
    tl.store(at + 6, tl.load(colour, mask=there, other=0.0), mask=there)
    tl.store(at + 7, tl.load(colour + N, mask=there, other=0.0), mask=there)
    tl.store(at + 8, tl.load(colour + 2 * N, mask=there, other=0.0), mask=there)
    tl.store(at + 9, depth, mask=there)
    tl.store(at + 10, tl.zeros_like(depth), mask=there)
