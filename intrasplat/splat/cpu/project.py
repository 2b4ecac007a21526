"""The per-Gaussian half of the rasteriser: projection onto the image, and its gradients.

N Gaussians, stored as rows of N: state [10 or more, N] (intrasplat/splat/layout.py) deformed to the frame's time,
opacity_logit [N], colour [3, N]. A splat is a Gaussian on the image, SPLAT floats:
    0 1   mean2d x, y in px
    2 3 4 the conic times -log2(e) / 2, -log2(e), -log2(e) / 2: power2 = lo + k_xx dx^2 + k_xy dx dy + k_yy dy^2
    5     lo = log2(opacity), so that alpha = 2**power2
    6 7 8 colour
    9     camera z
    10    2**(2 k_yy): the factor, per row, of the ratio of alpha between neighbouring rows (BEND of blend.py)
    11    a value of the caller's that is blended as colour is, at first 0
Arithmetic is float64 on LANES Gaussians at once, storage float32. Exponentials have float32's precision and are limited
to 2**MAX_LOG2_EXP, so that results stay finite for any log-scale and logit.
"""

from __future__ import annotations

import numpy as np

from intrasplat.machine.cache import kernel
from intrasplat.splat.constants import EPS2D, IMAGE_MARGIN, LN2, LOG2E, MAX_DETERMINANT, MAX_LOG2_EXP, MIN_ALPHA, NEAR
from intrasplat.splat.cpu.bins import EXTENT, GRADIENT
from intrasplat.splat.cpu.simd import (
    exp2,
    lane_sum,
    load,
    load_strided,
    log2,
    maximum,
    minimum,
    narrow,
    splat,
    sqrt,
    store,
    store_strided,
    where_less,
    widen,
)
from intrasplat.splat.cpu.vectors import LANES
from intrasplat.splat.layout import (
    CX,
    CY,
    ENLARGED,
    FX,
    FY,
    HEIGHT,
    LOG_SCALE_ROW,
    MEAN_ROW,
    POSE,
    QUATERNION_ROW,
    RECORDED,
    WIDTH,
)

SPLAT = 12
"""Floats in a splat record."""


@kernel
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _each(a, b):  # type: ignore[no-untyped-def]
    """Elementwise product."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@kernel
def _sum(p, a, q, b):  # type: ignore[no-untyped-def]
    """p a + q b of numbers p, q and triples a, b."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@kernel
def _through(a, m):  # type: ignore[no-untyped-def]
    """a^T M, M as three rows."""
    return (
        a[0] * m[0][0] + a[1] * m[1][0] + a[2] * m[2][0],
        a[0] * m[0][1] + a[1] * m[1][1] + a[2] * m[2][1],
        a[0] * m[0][2] + a[1] * m[1][2] + a[2] * m[2][2],
    )


@kernel
def _onto(m, a):  # type: ignore[no-untyped-def]
    """M a, M as three rows."""
    return _dot(m[0], a), _dot(m[1], a), _dot(m[2], a)


@kernel
def _rows_of(state, first, i):  # type: ignore[no-untyped-def]
    """Three consecutive rows of the state at the Gaussians from i."""
    return widen(load(state[first], i)), widen(load(state[first + 1], i)), widen(load(state[first + 2], i))


@kernel
def _exp(x):  # type: ignore[no-untyped-def]
    """e^x, at most 2**MAX_LOG2_EXP; NaN of NaN."""
    power, most = x * LOG2E, widen(splat(np.float32(MAX_LOG2_EXP)))
    return widen(exp2(narrow(where_less(most, power, most, power))))


@kernel
def _quaternion(state, i):  # type: ignore[no-untyped-def]
    """Unit quaternions wxyz of the Gaussians from i and 1 / the lengths they were stored with."""
    q0 = widen(load(state[QUATERNION_ROW], i))
    q1, q2, q3 = _rows_of(state, QUATERNION_ROW + 1, i)
    n = 1.0 / sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    return (q0 * n, q1 * n, q2 * n, q3 * n), n


@kernel
def _rotation(q):  # type: ignore[no-untyped-def]
    """Rotation matrix of a unit quaternion wxyz, as three rows."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@kernel
def _quaternion_gradient(q, n, p):  # type: ignore[no-untyped-def]
    """dL/d(stored quaternion) from P = dL/dR, q of unit length: through R(q), then (I - q q^T) / |stored|."""
    w, x, y, z = q
    d0 = 2 * (x * (p[2][1] - p[1][2]) + y * (p[0][2] - p[2][0]) + z * (p[1][0] - p[0][1]))
    d1 = 2 * (y * (p[0][1] + p[1][0]) + z * (p[0][2] + p[2][0]) + w * (p[2][1] - p[1][2])) - 4 * x * (p[1][1] + p[2][2])
    d2 = 2 * (x * (p[0][1] + p[1][0]) + z * (p[1][2] + p[2][1]) + w * (p[0][2] - p[2][0])) - 4 * y * (p[0][0] + p[2][2])
    d3 = 2 * (x * (p[0][2] + p[2][0]) + y * (p[1][2] + p[2][1]) + w * (p[1][0] - p[0][1])) - 4 * z * (p[0][0] + p[1][1])
    along = d0 * w + d1 * x + d2 * y + d3 * z
    return n * (d0 - along * w), n * (d1 - along * x), n * (d2 - along * y), n * (d3 - along * z)


@kernel
def _pose(camera):  # type: ignore[no-untyped-def]
    """W as three rows, and the translation."""
    return (
        (camera[POSE], camera[POSE + 1], camera[POSE + 2]),
        (camera[POSE + 4], camera[POSE + 5], camera[POSE + 6]),
        (camera[POSE + 8], camera[POSE + 9], camera[POSE + 10]),
    ), (camera[POSE + 3], camera[POSE + 7], camera[POSE + 11])


@kernel
def _limits(camera):  # type: ignore[no-untyped-def]
    """Least and greatest x / z and y / z to which u and v are clamped (Camera.ratio_limits)."""
    fx, fy, cx, cy = camera[FX], camera[FY], camera[CX], camera[CY]
    width, height = camera[WIDTH], camera[HEIGHT]
    return (
        (-cx - IMAGE_MARGIN * width) / fx,
        (width - cx + IMAGE_MARGIN * width) / fx,
        (-cy - IMAGE_MARGIN * height) / fy,
        (height - cy + IMAGE_MARGIN * height) / fy,
    )


@kernel
def _low_pass(camera, mean, inverse_z):  # type: ignore[no-untyped-def]
    """The terms added to the variances along x and y, EPS2D m_x^2 and EPS2D m_y^2 (intrasplat/splat/camera.py)."""
    row = (camera[RECORDED], camera[RECORDED + 1], camera[RECORDED + 2])
    nearer = (_dot(row, mean) + camera[RECORDED + 3]) * inverse_z
    one = widen(splat(np.float32(1.0)))
    m_x, m_y = maximum(camera[ENLARGED] * nearer, one), maximum(camera[ENLARGED + 1] * nearer, one)
    return EPS2D * m_x * m_x, EPS2D * m_y * m_y


@kernel
def _clamped(ratio, low, high):  # type: ignore[no-untyped-def]
    """ratio clamped to [low, high]."""
    return minimum(maximum(ratio, low), high)


@kernel
def _unless_culled(extent2, z, det, centre, reach, width, height):  # type: ignore[no-untyped-def]
    """extent2, or -1 where there is no ellipse, or no pixel centre of the image in its bounding box."""
    zero = widen(splat(np.float32(0.0)))
    culled = zero - 1.0
    visible = where_less(zero, det, extent2, culled)
    visible = where_less(det, zero + MAX_DETERMINANT, visible, culled)
    visible = where_less(zero + NEAR, z, visible, culled)
    visible = where_less(centre[0] + reach[0], zero + 0.5, culled, visible)
    visible = where_less(zero + (width - 0.5), centre[0] - reach[0], culled, visible)
    visible = where_less(centre[1] + reach[1], zero + 0.5, culled, visible)
    return where_less(zero + (height - 0.5), centre[1] - reach[1], culled, visible)


@kernel
def _store_splats(splats, at, centre, covariance, inverse_det, log2_opacity, z):  # type: ignore[no-untyped-def]
    """Write LANES splats without their colour, from splats[at] on."""
    cxx, cxy, cyy = covariance
    k_yy = -0.5 * LOG2E * cxx * inverse_det
    store_strided(splats, at, SPLAT, narrow(centre[0]))
    store_strided(splats, at + 1, SPLAT, narrow(centre[1]))
    store_strided(splats, at + 2, SPLAT, narrow(-0.5 * LOG2E * cyy * inverse_det))
    store_strided(splats, at + 3, SPLAT, narrow(LOG2E * cxy * inverse_det))
    store_strided(splats, at + 4, SPLAT, narrow(k_yy))
    store_strided(splats, at + 5, SPLAT, narrow(log2_opacity))
    store_strided(splats, at + 9, SPLAT, narrow(z))
    store_strided(splats, at + 10, SPLAT, exp2(narrow(2.0 * k_yy)))
    store_strided(splats, at + 11, SPLAT, splat(np.float32(0.0)))


@kernel
def _store_extents(extent, at, covariance, det, extent2, reach):  # type: ignore[no-untyped-def]
    """Write the numbers of bins.EXTENT. The conic's a, b, c are cyy, -cxy, cxx over det, and ac - b^2 is 1 / det."""
    cxx, cxy, cyy = covariance
    inverse_cxx = 1.0 / cxx
    store_strided(extent, at, EXTENT, narrow(reach[0]))
    store_strided(extent, at + 1, EXTENT, narrow(cxy / cyy * reach[1]))
    store_strided(extent, at + 2, EXTENT, narrow(cxy * inverse_cxx))
    store_strided(extent, at + 3, EXTENT, narrow(extent2 * det * inverse_cxx))
    store_strided(extent, at + 4, EXTENT, narrow(det * inverse_cxx * inverse_cxx))
    store_strided(extent, at + 5, EXTENT, narrow(reach[1]))


@kernel
def project(  # type: ignore[no-untyped-def]
    thread, threads, camera, state, opacity_logit, colour, splats, radius2, extent
):
    """Fill splats [N * SPLAT], extent [N * EXTENT] (bins.py) and radius2 [N].

    radius2 is 2 ln(opacity / MIN_ALPHA), the squared Mahalanobis radius, or -1 for a culled Gaussian, whose other
    numbers are meaningless. camera: float64 [CAMERA] (intrasplat/splat/layout.py).
    """
    fx, fy, cx, cy = camera[FX], camera[FY], camera[CX], camera[CY]
    width, height = camera[WIDTH], camera[HEIGHT]
    w, shift = _pose(camera)
    zero = widen(splat(np.float32(0.0)))
    limits = _limits(camera)
    low_u, high_u, low_v, high_v = zero + limits[0], zero + limits[1], zero + limits[2], zero + limits[3]
    vectors = state.shape[1] // LANES
    for k in range(vectors * thread // threads, vectors * (thread + 1) // threads):
        i = k * LANES
        mean = _rows_of(state, MEAN_ROW, i)
        x, y, z = _dot(w[0], mean) + shift[0], _dot(w[1], mean) + shift[1], _dot(w[2], mean) + shift[2]
        q, _ = _quaternion(state, i)
        r = _rotation(q)
        s0, s1, s2 = _rows_of(state, LOG_SCALE_ROW, i)
        scale = (_exp(s0), _exp(s1), _exp(s2))
        # A = J W (2 x 3), then K = A R S (2 x 3), cov2d = K K^T + the low-pass.
        inverse_z = 1.0 / z
        u, v = _clamped(x * inverse_z, low_u, high_u), _clamped(y * inverse_z, low_v, high_v)
        j0, j1 = fx * inverse_z, fy * inverse_z
        k0 = _each(_through(_sum(j0, w[0], zero - j0 * u, w[2]), r), scale)
        k1 = _each(_through(_sum(j1, w[1], zero - j1 * v, w[2]), r), scale)
        low_x, low_y = _low_pass(camera, mean, inverse_z)
        cxx, cxy, cyy = _dot(k0, k0) + low_x, _dot(k0, k1), _dot(k1, k1) + low_y
        log2_opacity = zero - log2(1.0 + _exp(zero - widen(load(opacity_logit, i))))
        extent2 = 2.0 * LN2 * (log2_opacity - np.log2(MIN_ALPHA))
        det = cxx * cyy - cxy * cxy
        centre, reach = (j0 * x + cx, j1 * y + cy), (sqrt(extent2 * cxx), sqrt(extent2 * cyy))
        store(radius2, i, narrow(_unless_culled(extent2, z, det, centre, reach, width, height)))
        _store_splats(splats, i * SPLAT, centre, (cxx, cxy, cyy), 1.0 / det, log2_opacity, z)
        for channel in range(3):
            store_strided(splats, i * SPLAT + 6 + channel, SPLAT, load(colour[channel], i))
        _store_extents(extent, i * EXTENT, (cxx, cxy, cyy), det, extent2, reach)


@kernel
def _more(total, a, visible):  # type: ignore[no-untyped-def]
    """total + a, triples of wides, in the lanes where visible >= 0."""
    zero = widen(splat(np.float32(0.0)))
    culled = widen(visible)
    return (
        total[0] + where_less(culled, zero, zero, a[0]),
        total[1] + where_less(culled, zero, zero, a[1]),
        total[2] + where_less(culled, zero, zero, a[2]),
    )


@kernel
def _add_accumulators(first, accumulators, sums, totals):  # type: ignore[no-untyped-def]
    """The blend's gradients of LANES Gaussians, summed over their accumulators, into totals [LANES * GRADIENT]."""
    for lane in range(LANES):
        head = tail = splat(np.float32(0.0))
        start = np.int64(accumulators[first + lane, 0])
        for accumulator in range(start, start + accumulators[first + lane, 1]):
            head = head + load(sums, accumulator * GRADIENT)
            tail = tail + load(sums, accumulator * GRADIENT + GRADIENT - LANES)
        store(totals, lane * GRADIENT + GRADIENT - LANES, tail)
        store(totals, lane * GRADIENT, head)


@kernel(inline="always")
def _put(row, i, value, adds):  # type: ignore[no-untyped-def]
    """Write LANES numbers into row[i]; add them where adds is true."""
    if adds:
        value = load(row, i) + value
    store(row, i, value)


@kernel
def project_backward(  # type: ignore[no-untyped-def]
    thread, threads, camera, state, opacity_logit, radius2, accumulators, sums, adds, adds_state,
    v_state, v_opacity_logit, v_colour, v_mean2d_norm, v_pose,
):  # fmt: skip
    """Sum the blend's gradients of each Gaussian over its accumulators (bins.py), and compute those of its parameters.

    sums [accumulators * GRADIENT]. Every v_* row is written (zeros for culled Gaussians). adds_state adds to v_state;
    adds adds to v_opacity_logit, and v_mean2d_norm becomes the larger of old and new. v_mean2d_norm [N]: |dL/dmean2d|
    in normalised device coordinates (x times W / 2, y times H / 2), the unit in which densification thresholds are
    published. v_pose [threads, 12]: the thread's share of dL/d camera_from_world.

    With G = dL/dconic: dL/dcov2d = -conic G conic; dL/dSigma = A^T dL/dcov2d A.
    One long function, because each step of this chain needs most of what the steps before it computed.
    """
    fx, fy, width, height = camera[FX], camera[FY], camera[WIDTH], camera[HEIGHT]
    w, shift = _pose(camera)
    none, zero = splat(np.float32(0.0)), widen(splat(np.float32(0.0)))
    limits = _limits(camera)
    low_u, high_u, low_v, high_v = zero + limits[0], zero + limits[1], zero + limits[2], zero + limits[3]
    pose_x = pose_y = pose_z = pose_t = (zero, zero, zero)
    totals = np.empty(LANES * GRADIENT, np.float32)
    vectors = state.shape[1] // LANES
    for k in range(vectors * thread // threads, vectors * (thread + 1) // threads):
        i = k * LANES
        _add_accumulators(i, accumulators, sums, totals)
        visible = load(radius2, i)
        store(v_colour[0], i, load_strided(totals, 0, GRADIENT))
        store(v_colour[1], i, load_strided(totals, 1, GRADIENT))
        store(v_colour[2], i, load_strided(totals, 2, GRADIENT))
        odds = _exp(zero - widen(load(opacity_logit, i)))
        # odds / (1 + odds) = 1 - opacity, exact also where opacity rounds to 1
        _put(v_opacity_logit, i, narrow(widen(load_strided(totals, 4, GRADIENT)) * odds / (1.0 + odds)), adds)

        # Repeats the parts of the forward pass that are needed: B = A R, cov2d = B S^2 B^T + the low-pass.
        mean = _rows_of(state, MEAN_ROW, i)
        x, y, z = _dot(w[0], mean) + shift[0], _dot(w[1], mean) + shift[1], _dot(w[2], mean) + shift[2]
        inverse_z = 1.0 / z
        q, n = _quaternion(state, i)
        r = _rotation(q)
        s0, s1, s2 = _rows_of(state, LOG_SCALE_ROW, i)
        scale = (_exp(s0), _exp(s1), _exp(s2))
        variance = _each(scale, scale)
        ratio_x, ratio_y = x * inverse_z, y * inverse_z
        u, v = _clamped(ratio_x, low_u, high_u), _clamped(ratio_y, low_v, high_v)
        j0, j1 = fx * inverse_z, fy * inverse_z
        a0, a1 = _sum(j0, w[0], zero - j0 * u, w[2]), _sum(j1, w[1], zero - j1 * v, w[2])
        b0, b1 = _through(a0, r), _through(a1, r)
        t0, t1 = _each(b0, variance), _each(b1, variance)
        low_x, low_y = _low_pass(camera, mean, inverse_z)
        cxx, cxy, cyy = _dot(t0, b0) + low_x, _dot(t0, b1), _dot(t1, b1) + low_y
        inverse_det = 1.0 / (cxx * cyy - cxy * cxy)
        ka, kb, kc = cyy * inverse_det, zero - cxy * inverse_det, cxx * inverse_det

        m_x, m_y = widen(load_strided(totals, 5, GRADIENT)), widen(load_strided(totals, 6, GRADIENT))
        v_mx, v_my = ka * m_x + kb * m_y, kb * m_x + kc * m_y
        on_image = v_mx * v_mx * (0.25 * width * width) + v_my * v_my * (0.25 * height * height)
        norm = where_less(visible, none, none, narrow(sqrt(on_image)))
        store(v_mean2d_norm, i, maximum(load(v_mean2d_norm, i), norm) if adds else norm)
        g00 = -0.5 * widen(load_strided(totals, 7, GRADIENT))  # dL/dconic, symmetric halves
        g01 = -0.5 * widen(load_strided(totals, 8, GRADIENT))
        g11 = -0.5 * widen(load_strided(totals, 9, GRADIENT))
        h00, h01 = ka * g00 + kb * g01, ka * g01 + kb * g11
        h10, h11 = kb * g00 + kc * g01, kb * g01 + kc * g11
        c00, c01, c11 = zero - (h00 * ka + h01 * kb), zero - (h00 * kb + h01 * kc), zero - (h10 * kb + h11 * kc)

        # dL/dB = 2 dL/dcov2d B S^2 =: E; dL/dlog s_k = b_k . e_k, the sum over both rows of column k.
        e0, e1 = _sum(2 * c00, t0, 2 * c01, t1), _sum(2 * c01, t0, 2 * c11, t1)
        by_scale = _each(b0, e0), _each(b1, e1)
        for c in range(3):
            log_scale = where_less(visible, none, none, narrow(by_scale[0][c] + by_scale[1][c]))
            _put(v_state[LOG_SCALE_ROW + c], i, log_scale, adds_state)

        # dL/dR = A^T E, then through R(q / |q|).
        p = (_sum(a0[0], e0, a1[0], e1), _sum(a0[1], e0, a1[1], e1), _sum(a0[2], e0, a1[2], e1))
        v_quaternion = _quaternion_gradient(q, n, p)
        for c in range(4):
            _put(v_state[QUATERNION_ROW + c], i, where_less(visible, none, none, narrow(v_quaternion[c])), adds_state)

        # dL/dA = E R^T =: F, then to the camera point through A = diag(j) (W_xy - (u, v) W_z).
        f0, f1 = _onto(r, e0), _onto(r, e1)
        v_x, v_y = j0 * v_mx, j1 * v_my
        v_z = widen(load_strided(totals, 3, GRADIENT)) - (x * v_x + y * v_y + _dot(f0, a0) + _dot(f1, a1)) * inverse_z
        v_u = zero - j0 * _dot(f0, w[2])
        v_v = zero - j1 * _dot(f1, w[2])
        v_u = where_less(low_u, ratio_x, where_less(ratio_x, high_u, v_u, zero), zero) * inverse_z
        v_v = where_less(low_v, ratio_y, where_less(ratio_y, high_v, v_v, zero), zero) * inverse_z
        v_x, v_y, v_z = v_x + v_u, v_y + v_v, v_z - v_u * ratio_x - v_v * ratio_y
        v_mean = _through((v_x, v_y, v_z), w)
        for c in range(3):
            _put(v_state[MEAN_ROW + c], i, where_less(visible, none, none, narrow(v_mean[c])), adds_state)
        # dL/d camera_from_world: what reaches x, y, z times the mean, and J^T dL/dA.
        j0_u, j1_v = j0 * u, j1 * v
        to_x, to_y = _sum(v_x, mean, j0, f0), _sum(v_y, mean, j1, f1)
        to_z = _sum(v_z, mean, zero - 1.0, _sum(j0_u, f0, j1_v, f1))
        pose_x, pose_y = _more(pose_x, to_x, visible), _more(pose_y, to_y, visible)
        pose_z, pose_t = _more(pose_z, to_z, visible), _more(pose_t, (v_x, v_y, v_z), visible)
    for c in range(3):
        v_pose[thread, c], v_pose[thread, 4 + c] = lane_sum(pose_x[c]), lane_sum(pose_y[c])
        v_pose[thread, 8 + c], v_pose[thread, 4 * c + 3] = lane_sum(pose_z[c]), lane_sum(pose_t[c])
