"""The projection of Gaussians onto the image, on the device; project_backward.py has its gradients.

N Gaussians, F frames; rows of N floats: state [F, 10 or more, N] (intrasplat/splat/layout.py) deformed to each
frame's time, opacity_logit [N], colour [F, 3, N]. A splat is a Gaussian on the image, RECORD floats:
    0 1   mean2d x, y in px
    2 3 4 the conic times -log2(e) / 2, -log2(e), -log2(e) / 2: power2 = lo + k_xx dx^2 + k_xy dx dy + k_yy dy^2
    5     lo = log2(opacity), so that alpha = 2**power2
    6     a value of the caller's that is blended as colour is
    7     spare
    8 9 10  colour
    11    camera z
Arithmetic is float64 as on the CPU (geometry.py), storage float32.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from intrasplat.splat.constants import LN2, LOG2E, MAX_DETERMINANT, MIN_ALPHA, NEAR
from intrasplat.splat.cuda.bins import DEPTH_BITS, EXTENT, count_tiles
from intrasplat.splat.cuda.geometry import (
    dot,
    exp,
    image_row,
    low_pass,
    mean_of,
    nearness,
    rotation_of,
    seen,
    variances_of,
)
from intrasplat.splat.layout import CAMERA, CX, CY

RECORD = 12
"""Floats in a splat record: 48 bytes, three loads of 16."""
PROJECT_BLOCK = 128

_RECORD, _EXTENT = tl.constexpr(RECORD), tl.constexpr(EXTENT)
_NEAR = tl.constexpr(NEAR)
_LOG2E, _LN2 = tl.constexpr(LOG2E), tl.constexpr(LN2)
_LOG2_MIN_ALPHA = tl.constexpr(math.log2(MIN_ALPHA))
_CAMERA, _CX, _CY = tl.constexpr(CAMERA), tl.constexpr(CX), tl.constexpr(CY)
_EXTENT_SLACK = tl.constexpr(1e-3)  # of the squared Mahalanobis radius: where alpha is 1/2000 below MIN_ALPHA
_MAX_DETERMINANT = tl.constexpr(MAX_DETERMINANT)
_DEPTHS = tl.constexpr(1 << DEPTH_BITS)
_NEAR_BITS = tl.constexpr(0x3E4CCCCD)  # of NEAR as a float32
_HALF_RANGE = tl.constexpr(1 << 31)
_LOW_WORD = tl.constexpr(0xFFFFFFFF)


@triton.jit
def _store_pair(at, first, second, there):  # type: ignore[no-untyped-def]
    """Store two neighbouring float32 as one int64: half as many stores, and each lane writes other 32 bytes."""
    low = first.to(tl.int32, bitcast=True).to(tl.int64) & _LOW_WORD
    tl.store(at, (second.to(tl.int32, bitcast=True).to(tl.int64) << 32) | low, mask=there)


@triton.jit(do_not_specialize=["N"])
def project(  # type: ignore[no-untyped-def]
    camera, state, opacity_logit, colour, records, extent, count, depth_key,
    N, state_rows, width, height, tiles_x, tiles_y,
    TILE_W: tl.constexpr, TILE_H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the splats of frame program_id(1). records [F N, RECORD] and extent [F N, EXTENT] (bins.py) are float32 in
    pairs as int64. count [F N]: tiles of a splat, 0 if culled. depth_key [F N]: sorts by frame, then depth, culled
    ones last.

    camera: float64 [F, CAMERA] (intrasplat/splat/layout.py).
    """
    f = tl.program_id(1)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = n < N
    camera += f * _CAMERA
    state += (f * state_rows).to(tl.int64) * N
    a, b, c = mean_of(state, n, there, N)
    x, y, z = seen(camera, a, b, c)
    in_front = there & (z > _NEAR)
    inverse_z = 1.0 / tl.where(in_front, z, 1.0)
    nearer = nearness(camera, a, b, c, inverse_z)
    _, _, _, _, _, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(state, n, there, N)
    v0, v1, v2 = variances_of(state, n, there, N)
    j0, _, a00, a01, a02 = image_row(camera, 0, x * inverse_z, inverse_z)
    j1, _, a10, a11, a12 = image_row(camera, 1, y * inverse_z, inverse_z)
    # B = A R, cov2d = B S^2 B^T + the low-pass
    b00, b01 = dot(a00, a01, a02, r00, r10, r20), dot(a00, a01, a02, r01, r11, r21)
    b02, b10 = dot(a00, a01, a02, r02, r12, r22), dot(a10, a11, a12, r00, r10, r20)
    b11, b12 = dot(a10, a11, a12, r01, r11, r21), dot(a10, a11, a12, r02, r12, r22)
    cxx = dot(b00 * b00, b01 * b01, b02 * b02, v0, v1, v2) + low_pass(camera, 0, nearer)
    cxy = dot(b00 * b10, b01 * b11, b02 * b12, v0, v1, v2)
    cyy = dot(b10 * b10, b11 * b11, b12 * b12, v0, v1, v2) + low_pass(camera, 1, nearer)
    det = cxx * cyy - cxy * cxy
    logit = tl.load(opacity_logit + n, mask=there, other=0.0)
    log2_opacity = -tl.log2(1.0 + exp(-logit))

    extent2 = (log2_opacity - _LOG2_MIN_ALPHA) * (2.0 * _LN2) + _EXTENT_SLACK
    drawn = in_front & (extent2 >= 0.0) & (det > 0.0) & (det < _MAX_DETERMINANT)
    # A splat that is not drawn gets finite numbers too, so that no tile number comes from a NaN.
    cxx, cxy, cyy = tl.where(drawn, cxx, 1.0), tl.where(drawn, cxy, 0.0), tl.where(drawn, cyy, 1.0)
    x, y, det = tl.where(drawn, x, 0.0), tl.where(drawn, y, 0.0), tl.where(drawn, det, 1.0)
    inverse_det = 1.0 / det
    mean_x, mean_y = (j0 * x + tl.load(camera + _CX)).to(tl.float32), (j1 * y + tl.load(camera + _CY)).to(tl.float32)
    extent2 = tl.where(drawn, extent2, 0.0).to(tl.float64)
    reach = tl.sqrt(extent2 * cyy).to(tl.float32)
    extreme = (cxy * tl.sqrt(extent2 / cxx)).to(tl.float32)
    slope = (cxy / cyy).to(tl.float32)
    square, fall = (extent2 * det / cyy).to(tl.float32), (det / (cyy * cyy)).to(tl.float32)
    tiles = count_tiles(
        mean_x, mean_y, reach, extreme, slope, square, fall, drawn, width, height, tiles_y, TILE_W, TILE_H
    )  # fmt: skip
    splat = f * N + n
    tl.store(count + splat, tiles, mask=there)
    depth = z.to(tl.float32)
    bits = tl.minimum(tl.maximum(depth.to(tl.int32, bitcast=True) - _NEAR_BITS, 0), _DEPTHS - 2)
    bits = tl.where(tiles > 0, bits, _DEPTHS - 1)
    key = f.to(tl.int64) * _DEPTHS + bits - _HALF_RANGE
    tl.store(depth_key + splat, key.to(tl.int32), mask=there)

    at = extent + splat * (_EXTENT // 2)
    _store_pair(at, mean_x, mean_y, there)
    _store_pair(at + 1, reach, extreme, there)
    _store_pair(at + 2, slope, square, there)
    _store_pair(at + 3, fall, fall, there)
    k_xx, k_xy = cyy * inverse_det * (-0.5 * _LOG2E), cxy * inverse_det * _LOG2E
    k_yy = cxx * inverse_det * (-0.5 * _LOG2E)
    colour += (3 * f).to(tl.int64) * N + n
    red = tl.load(colour, mask=there, other=0.0)
    green = tl.load(colour + N, mask=there, other=0.0)
    blue = tl.load(colour + 2 * N, mask=there, other=0.0)
    at = records + splat * (_RECORD // 2)
    _store_pair(at, mean_x, mean_y, there)
    _store_pair(at + 1, k_xx.to(tl.float32), k_xy.to(tl.float32), there)
    _store_pair(at + 2, k_yy.to(tl.float32), log2_opacity, there)
    _store_pair(at + 3, tl.zeros_like(depth), tl.zeros_like(depth), there)
    _store_pair(at + 4, red, green, there)
    _store_pair(at + 5, blue, depth, there)
