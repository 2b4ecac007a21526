"""The gradients of every Gaussian from those of its instances, on the device.

Two kernels: sum_slots adds up a splat's slots (blend.py), always in the same order, and project_backward differentiates
project.py.
"""

from __future__ import annotations

import triton
import triton.language as tl

from intrasplat.splat.cuda.bins import SLOT
from intrasplat.splat.cuda.geometry import (
    dot,
    exp,
    image_row,
    limits,
    low_pass,
    mean_of,
    nearness,
    rotation_of,
    seen,
    variances_of,
)
from intrasplat.splat.layout import CAMERA, CHANNELS, HEIGHT, LOG_SCALE_ROW, POSE, QUATERNION_ROW, WIDTH

SUMS = 10
"""Numbers of a splat's sum over slots: the moments 1, x, y, xx, xy, yy of dL/dpower about mean2d, dL/d(r, g, b, z)."""
SPLATS_BLOCK, LANES, SUM_WARPS = 16, 8, 1
"""sum_slots: splats per program, slots of each that are added at once, warps. A splat has some five to ten slots; one
with hundreds delays only its own program."""
BACKWARD_BLOCK = 128
POSE_SHARE = 12

_SLOT, _SHARE = tl.constexpr(SLOT), tl.constexpr(POSE_SHARE)
_CAMERA, _POSE = tl.constexpr(CAMERA), tl.constexpr(POSE)
_WIDTH, _HEIGHT = tl.constexpr(WIDTH), tl.constexpr(HEIGHT)
_ROWS, _Q, _S = tl.constexpr(CHANNELS), tl.constexpr(QUATERNION_ROW), tl.constexpr(LOG_SCALE_ROW)


@triton.jit
def _two(slots, slot, part: tl.constexpr, there):  # type: ignore[no-untyped-def]
    """Floats 2 part and 2 part + 1 of slots, read as one int64."""
    both = tl.load(slots + slot.to(tl.int64) * (_SLOT // 2) + part, mask=there, other=0)
    return both.to(tl.int32).to(tl.float32, bitcast=True), (both >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit(do_not_specialize=["capacity", "splats"])
def sum_slots(  # type: ignore[no-untyped-def]
    slots, key, slot_start, count, records, sums,
    capacity, splats, no_tile,
    RECORD: tl.constexpr, BLOCK: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write sums [SUMS, F N] of every splat's slots, moments about its mean2d; zeros for a splat without slots.

    slots: float32 [M, SLOT] as int64 [M, SLOT / 2]. key [M] (bins.py): NO_TILE for a slot that no tile has.
    """
    splat = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    lane = tl.arange(0, LANES)[None, :]
    there = splat < splats
    own = tl.load(count + splat, mask=there, other=0)
    start = tl.load(slot_start + splat, mask=own > 0, other=0)
    mean_x = tl.load(records + splat * RECORD, mask=own > 0, other=0.0)
    mean_y = tl.load(records + splat * RECORD + 1, mask=own > 0, other=0.0)
    zero = tl.zeros((BLOCK, LANES), tl.float32)
    m, m_x, m_y, m_xx, m_xy, m_yy = zero, zero, zero, zero, zero, zero
    red, green, blue, depth = zero, zero, zero, zero
    done = 0
    most = tl.max(own)
    while done < most:
        slot = start + done + lane
        # After an overflow counts and starts may be out of bounds; the step is void then, but must not read outside.
        valid = (done + lane < own) & (slot >= 0) & (slot < capacity)
        valid = valid & (tl.load(key + slot, mask=valid, other=0).to(tl.int32) != no_tile)
        p0, p_x = _two(slots, slot, 0, valid)
        p_y, p_xx = _two(slots, slot, 1, valid)
        p_xy, p_yy = _two(slots, slot, 2, valid)
        # d = (pixel - the tile's middle) + (that middle - mean2d)
        dx, dy = _two(slots, slot, 3, valid)
        dx, dy = dx - mean_x, dy - mean_y
        along_x, along_y = p_x + dx * p0, p_y + dy * p0
        m += p0
        m_x += along_x
        m_y += along_y
        m_xx += p_xx + dx * (p_x + along_x)
        m_xy += p_xy + dx * p_y + dy * along_x
        m_yy += p_yy + dy * (p_y + along_y)
        high_r, high_g = _two(slots, slot, 4, valid)
        high_b, high_z = _two(slots, slot, 5, valid)
        low_r, low_g = _two(slots, slot, 6, valid)
        low_b, low_z = _two(slots, slot, 7, valid)
        red += high_r + low_r
        green += high_g + low_g
        blue += high_b + low_b
        depth += high_z + low_z
        done += LANES
    splat = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = splat < splats
    out = sums + splat
    tl.store(out, tl.sum(m, 1), mask=there)
    tl.store(out + splats, tl.sum(m_x, 1), mask=there)
    tl.store(out + 2 * splats, tl.sum(m_y, 1), mask=there)
    tl.store(out + 3 * splats, tl.sum(m_xx, 1), mask=there)
    tl.store(out + 4 * splats, tl.sum(m_xy, 1), mask=there)
    tl.store(out + 5 * splats, tl.sum(m_yy, 1), mask=there)
    tl.store(out + 6 * splats, tl.sum(red, 1), mask=there)
    tl.store(out + 7 * splats, tl.sum(green, 1), mask=there)
    tl.store(out + 8 * splats, tl.sum(blue, 1), mask=there)
    tl.store(out + 9 * splats, tl.sum(depth, 1), mask=there)


@triton.jit
def _quaternion_gradient(w, x, y, z, p00, p01, p02, p10, p11, p12, p20, p21, p22):  # type: ignore[no-untyped-def]
    """dL/d(stored quaternion) times its length, from P = dL/dR: through R(q), then I - q q^T."""
    d0 = 2 * (x * (p21 - p12) + y * (p02 - p20) + z * (p10 - p01))
    d1 = 2 * (y * (p01 + p10) + z * (p02 + p20) + w * (p21 - p12)) - 4 * x * (p11 + p22)
    d2 = 2 * (x * (p01 + p10) + z * (p12 + p21) + w * (p02 - p20)) - 4 * y * (p00 + p22)
    d3 = 2 * (x * (p02 + p20) + y * (p12 + p21) + w * (p10 - p01)) - 4 * z * (p00 + p11)
    along = d0 * w + d1 * x + d2 * y + d3 * z
    return d0 - along * w, d1 - along * x, d2 - along * y, d3 - along * z


@triton.jit
def _store(out, value, drawn, there):  # type: ignore[no-untyped-def]
    """value as float32, 0 where the Gaussian was culled."""
    tl.store(out, tl.where(drawn, value, 0.0).to(tl.float32), mask=there)


@triton.jit
def _ratio_gradient(camera, first: tl.constexpr, v, ratio, inverse_z):  # type: ignore[no-untyped-def]
    """dL/d(x / z) through J, divided by z; 0 where J clamps x / z."""
    low, high = limits(camera, first)
    return tl.where((ratio > low) & (ratio < high), v, 0.0) * inverse_z


@triton.jit
def _sum_of(values, drawn):  # type: ignore[no-untyped-def]
    return tl.sum(tl.where(drawn, values, 0.0))


@triton.jit(do_not_specialize=["N", "splats"])
def project_backward(  # type: ignore[no-untyped-def]
    camera, state, opacity_logit, count, sums, v_state, v_opacity_logit, v_colour, v_mean2d_norm, v_pose,
    N, state_rows, splats,
    WITH_POSE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of frame program_id(1): v_state [F, 10, N], v_opacity_logit [F, N], v_colour [F, 3, N], zeros for
    culled Gaussians; v_mean2d_norm [F, N]: |dL/dmean2d| in normalised device coordinates (x times W / 2, y times
    H / 2), the unit in which densification thresholds are published. v_pose float64 [programs, F, 12]: each
    program's share of dL/d camera_from_world.

    With G = dL/dconic: dL/dcov2d = -conic G conic; dL/dSigma = A^T dL/dcov2d A.
    One long function, because each step of this chain needs most of what the steps before it computed.
    """
    f = tl.program_id(1)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = n < N
    splat = f * N + n
    drawn = tl.load(count + splat, mask=there, other=0) > 0
    camera += f * _CAMERA
    state += (f * state_rows).to(tl.int64) * N
    sums += splat
    colour = v_colour + (3 * f).to(tl.int64) * N + n
    _store(colour, tl.load(sums + 6 * splats, mask=drawn, other=0.0), drawn, there)
    _store(colour + N, tl.load(sums + 7 * splats, mask=drawn, other=0.0), drawn, there)
    _store(colour + 2 * N, tl.load(sums + 8 * splats, mask=drawn, other=0.0), drawn, there)
    odds = exp(-tl.load(opacity_logit + n, mask=there, other=0.0))
    # the factor 1 - opacity, exact also where opacity rounds to 1
    v_logit = tl.load(sums, mask=drawn, other=0.0) * odds / (1.0 + odds)
    _store(v_opacity_logit + splat, v_logit, drawn, there)

    # Repeats the parts of the forward pass that are needed: B = A R, cov2d = B S^2 B^T + the low-pass.
    a, b, c = mean_of(state, n, there, N)
    x, y, z = seen(camera, a, b, c)
    inverse_z = 1.0 / tl.where(drawn, z, 1.0)
    nearer = nearness(camera, a, b, c, inverse_z)
    ratio_x, ratio_y = x * inverse_z, y * inverse_z
    qw, qx, qy, qz, length, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(state, n, there, N)
    v0, v1, v2 = variances_of(state, n, there, N)
    j0, u, a00, a01, a02 = image_row(camera, 0, ratio_x, inverse_z)
    j1, v, a10, a11, a12 = image_row(camera, 1, ratio_y, inverse_z)
    b00, b01 = dot(a00, a01, a02, r00, r10, r20), dot(a00, a01, a02, r01, r11, r21)
    b02, b10 = dot(a00, a01, a02, r02, r12, r22), dot(a10, a11, a12, r00, r10, r20)
    b11, b12 = dot(a10, a11, a12, r01, r11, r21), dot(a10, a11, a12, r02, r12, r22)
    t00, t01, t02 = b00 * v0, b01 * v1, b02 * v2
    t10, t11, t12 = b10 * v0, b11 * v1, b12 * v2
    cxx = dot(t00, t01, t02, b00, b01, b02) + low_pass(camera, 0, nearer)
    cxy = dot(t00, t01, t02, b10, b11, b12)
    cyy = dot(t10, t11, t12, b10, b11, b12) + low_pass(camera, 1, nearer)
    inverse_det = 1.0 / (cxx * cyy - cxy * cxy)
    ka, kb, kc = cyy * inverse_det, -cxy * inverse_det, cxx * inverse_det

    m_x = tl.load(sums + splats, mask=drawn, other=0.0).to(tl.float64)
    m_y = tl.load(sums + 2 * splats, mask=drawn, other=0.0).to(tl.float64)
    v_mx, v_my = ka * m_x + kb * m_y, kb * m_x + kc * m_y
    across, down = 0.5 * tl.load(camera + _WIDTH) * v_mx, 0.5 * tl.load(camera + _HEIGHT) * v_my
    _store(v_mean2d_norm + splat, tl.sqrt(across * across + down * down), drawn, there)
    g00 = -0.5 * tl.load(sums + 3 * splats, mask=drawn, other=0.0).to(tl.float64)  # dL/dconic, symmetric halves
    g01 = -0.5 * tl.load(sums + 4 * splats, mask=drawn, other=0.0).to(tl.float64)
    g11 = -0.5 * tl.load(sums + 5 * splats, mask=drawn, other=0.0).to(tl.float64)
    h00, h01 = ka * g00 + kb * g01, ka * g01 + kb * g11
    h10, h11 = kb * g00 + kc * g01, kb * g01 + kc * g11
    c00, c01, c11 = -2 * (h00 * ka + h01 * kb), -2 * (h00 * kb + h01 * kc), -2 * (h10 * kb + h11 * kc)

    # dL/dB = 2 dL/dcov2d B S^2 =: E; dL/dlog s_k = b_k . e_k, the sum over both rows of column k.
    e00, e01, e02 = c00 * t00 + c01 * t10, c00 * t01 + c01 * t11, c00 * t02 + c01 * t12
    e10, e11, e12 = c01 * t00 + c11 * t10, c01 * t01 + c11 * t11, c01 * t02 + c11 * t12
    out = v_state + (f * _ROWS).to(tl.int64) * N + n
    _store(out + N * _S, b00 * e00 + b10 * e10, drawn, there)
    _store(out + N * (_S + 1), b01 * e01 + b11 * e11, drawn, there)
    _store(out + N * (_S + 2), b02 * e02 + b12 * e12, drawn, there)

    # dL/dR = A^T E, then through R(q / |q|).
    d0, d1, d2, d3 = _quaternion_gradient(
        qw, qx, qy, qz,
        a00 * e00 + a10 * e10, a00 * e01 + a10 * e11, a00 * e02 + a10 * e12,
        a01 * e00 + a11 * e10, a01 * e01 + a11 * e11, a01 * e02 + a11 * e12,
        a02 * e00 + a12 * e10, a02 * e01 + a12 * e11, a02 * e02 + a12 * e12,
    )  # fmt: skip
    _store(out + N * _Q, d0 * length, drawn, there)
    _store(out + N * (_Q + 1), d1 * length, drawn, there)
    _store(out + N * (_Q + 2), d2 * length, drawn, there)
    _store(out + N * (_Q + 3), d3 * length, drawn, there)

    # dL/dA = E R^T =: F, then to the camera point through A = diag(j) (W_xy - (u, v) W_z).
    f00, f01 = dot(e00, e01, e02, r00, r01, r02), dot(e00, e01, e02, r10, r11, r12)
    f02, f10 = dot(e00, e01, e02, r20, r21, r22), dot(e10, e11, e12, r00, r01, r02)
    f11, f12 = dot(e10, e11, e12, r10, r11, r12), dot(e10, e11, e12, r20, r21, r22)
    w = camera + _POSE  # rows of W are 4 numbers apart
    w0, w1, w2 = tl.load(w + 8), tl.load(w + 9), tl.load(w + 10)
    v_x, v_y = j0 * v_mx, j1 * v_my
    v_z = tl.load(sums + 9 * splats, mask=drawn, other=0.0).to(tl.float64)
    v_z -= (x * v_x + y * v_y + dot(f00, f01, f02, a00, a01, a02) + dot(f10, f11, f12, a10, a11, a12)) * inverse_z
    v_u = _ratio_gradient(camera, 0, -j0 * dot(f00, f01, f02, w0, w1, w2), ratio_x, inverse_z)
    v_v = _ratio_gradient(camera, 1, -j1 * dot(f10, f11, f12, w0, w1, w2), ratio_y, inverse_z)
    v_x += v_u
    v_y += v_v
    v_z -= v_u * ratio_x + v_v * ratio_y
    _store(out, v_x * tl.load(w) + v_y * tl.load(w + 4) + v_z * w0, drawn, there)
    _store(out + N, v_x * tl.load(w + 1) + v_y * tl.load(w + 5) + v_z * w1, drawn, there)
    _store(out + 2 * N, v_x * tl.load(w + 2) + v_y * tl.load(w + 6) + v_z * w2, drawn, there)

    if WITH_POSE:
        # What reaches x, y, z times the mean, and J^T dL/dA.
        pose = v_pose + (tl.program_id(0) * tl.num_programs(1) + f) * _SHARE
        tl.store(pose, _sum_of(v_x * a + j0 * f00, drawn))
        tl.store(pose + 1, _sum_of(v_x * b + j0 * f01, drawn))
        tl.store(pose + 2, _sum_of(v_x * c + j0 * f02, drawn))
        tl.store(pose + 3, _sum_of(v_x, drawn))
        tl.store(pose + 4, _sum_of(v_y * a + j1 * f10, drawn))
        tl.store(pose + 5, _sum_of(v_y * b + j1 * f11, drawn))
        tl.store(pose + 6, _sum_of(v_y * c + j1 * f12, drawn))
        tl.store(pose + 7, _sum_of(v_y, drawn))
        tl.store(pose + 8, _sum_of(v_z * a - j0 * u * f00 - j1 * v * f10, drawn))
        tl.store(pose + 9, _sum_of(v_z * b - j0 * u * f01 - j1 * v * f11, drawn))
        tl.store(pose + 10, _sum_of(v_z * c - j0 * u * f02 - j1 * v * f12, drawn))
        tl.store(pose + 11, _sum_of(v_z, drawn))
