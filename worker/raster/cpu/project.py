"""Gaussians to the image and back: the per-Gaussian half of the rasteriser.

N Gaussians, stored as rows of N: state [10, N] = mean 0:3, quaternion wxyz 3:7, log-scale 7:10 (deformed to the frame's
time), opacity_logit [N], colour [3, N]. A splat is a Gaussian on the image, SPLAT floats:
    0 1   mean2d x, y in px
    2 3 4 the conic times -log2(e) / 2, -log2(e), -log2(e) / 2: power2 = lo + k_xx dx^2 + k_xy dx dy + k_yy dy^2
    5     lo = log2(opacity), so that alpha = 2**power2
    6 7 8 colour
    9     camera z
Arithmetic is float64 a Gaussian (it is a twentieth of the step), storage float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from worker.raster import EPS2D, LIMIT, MIN_ALPHA, NEAR

SPLAT = 12
"""Floats a splat record holds; ten are used, twelve keep records on 16-byte boundaries."""
GRADIENT = 10
"""Sums the blend returns for one splat: dL/d(r, g, b, z), then the moments 1, x, y, xx, xy, yy of dL/dpower."""
LOG2E = 1.4426950408889634


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _each(a, b):  # type: ignore[no-untyped-def]
    """Product entry by entry."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@njit(cache=True, nogil=True)
def _sum(p, a, q, b):  # type: ignore[no-untyped-def]
    """p a + q b of numbers p, q and triples a, b."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@njit(cache=True, nogil=True)
def _through(a, m):  # type: ignore[no-untyped-def]
    """a^T M, M as three rows."""
    return (
        a[0] * m[0][0] + a[1] * m[1][0] + a[2] * m[2][0],
        a[0] * m[0][1] + a[1] * m[1][1] + a[2] * m[2][1],
        a[0] * m[0][2] + a[1] * m[1][2] + a[2] * m[2][2],
    )


@njit(cache=True, nogil=True)
def _onto(m, a):  # type: ignore[no-untyped-def]
    """M a, M as three rows."""
    return _dot(m[0], a), _dot(m[1], a), _dot(m[2], a)


@njit(cache=True, nogil=True)
def _rows_of(state, first, g):  # type: ignore[no-untyped-def]
    """Three consecutive rows of the state at Gaussian g."""
    return float(state[first, g]), float(state[first + 1, g]), float(state[first + 2, g])


@njit(cache=True, nogil=True)
def _quaternion(state, g):  # type: ignore[no-untyped-def]
    """Unit quaternion wxyz of Gaussian g and 1 / the length it was stored with."""
    q0, q1, q2, q3 = float(state[3, g]), float(state[4, g]), float(state[5, g]), float(state[6, g])
    n = 1.0 / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    return (q0 * n, q1 * n, q2 * n, q3 * n), n


@njit(cache=True, nogil=True)
def _rotation(q):  # type: ignore[no-untyped-def]
    """Rotation matrix of a unit quaternion wxyz, as three rows."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@njit(cache=True, nogil=True)
def _quaternion_gradient(q, n, p):  # type: ignore[no-untyped-def]
    """dL/d(stored quaternion) from P = dL/dR, q of unit length: through R(q), then (I - q q^T) / |stored|."""
    w, x, y, z = q
    d0 = 2 * (x * (p[2][1] - p[1][2]) + y * (p[0][2] - p[2][0]) + z * (p[1][0] - p[0][1]))
    d1 = 2 * (y * (p[0][1] + p[1][0]) + z * (p[0][2] + p[2][0]) + w * (p[2][1] - p[1][2])) - 4 * x * (p[1][1] + p[2][2])
    d2 = 2 * (x * (p[0][1] + p[1][0]) + z * (p[1][2] + p[2][1]) + w * (p[0][2] - p[2][0])) - 4 * y * (p[0][0] + p[2][2])
    d3 = 2 * (x * (p[0][2] + p[2][0]) + y * (p[1][2] + p[2][1]) + w * (p[1][0] - p[0][1])) - 4 * z * (p[0][0] + p[1][1])
    along = d0 * w + d1 * x + d2 * y + d3 * z
    return n * (d0 - along * w), n * (d1 - along * x), n * (d2 - along * y), n * (d3 - along * z)


@njit(cache=True, nogil=True)
def _pose(camera):  # type: ignore[no-untyped-def]
    """W as three rows, and the translation."""
    return (
        (camera[6], camera[7], camera[8]),
        (camera[10], camera[11], camera[12]),
        (camera[14], camera[15], camera[16]),
    ), (camera[9], camera[13], camera[17])


@njit(cache=True, nogil=True)
def _limits(camera):  # type: ignore[no-untyped-def]
    """Least and greatest x / z and y / z at which J is taken (Camera.ratio_limits)."""
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    return (
        (-cx - LIMIT * width) / fx,
        (width - cx + LIMIT * width) / fx,
        (-cy - LIMIT * height) / fy,
        (height - cy + LIMIT * height) / fy,
    )


@njit(cache=True, nogil=True)
def _clamped(x, y, z, limits):  # type: ignore[no-untyped-def]
    """u and v."""
    return min(max(x / z, limits[0]), limits[1]), min(max(y / z, limits[2]), limits[3])


@njit(cache=True, nogil=True)
def project(thread, threads, camera, state, opacity_logit, colour, splats, radius2):  # type: ignore[no-untyped-def]
    """Fill splats [N, SPLAT] and radius2 [N]: 2 ln(opacity / MIN_ALPHA), the squared Mahalanobis radius; -1 if culled.

    camera: float64 [18] = fx, fy, cx, cy, W, H, camera_from_world row-major [3, 4].
    """
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    w, shift = _pose(camera)
    limits = _limits(camera)
    count = state.shape[1]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        radius2[g] = -1.0
        mean = _rows_of(state, 0, g)
        z = _dot(w[2], mean) + shift[2]
        opacity = 1.0 / (1.0 + math.exp(-float(opacity_logit[g])))
        if not (z > NEAR and opacity >= MIN_ALPHA):
            continue
        x, y = _dot(w[0], mean) + shift[0], _dot(w[1], mean) + shift[1]
        q, _ = _quaternion(state, g)
        r = _rotation(q)
        s0, s1, s2 = _rows_of(state, 7, g)
        scale = (math.exp(s0), math.exp(s1), math.exp(s2))
        # A = J W (2 x 3), then K = A R S (2 x 3), cov2d = K K^T + EPS2D I.
        u, v = _clamped(x, y, z, limits)
        k0 = _each(_through(_sum(fx / z, w[0], -fx / z * u, w[2]), r), scale)
        k1 = _each(_through(_sum(fy / z, w[1], -fy / z * v, w[2]), r), scale)
        cxx, cxy, cyy = _dot(k0, k0) + EPS2D, _dot(k0, k1), _dot(k1, k1) + EPS2D
        det = cxx * cyy - cxy * cxy
        if not (det > 0.0 and math.isfinite(det)):
            continue
        extent2 = 2.0 * math.log(opacity / MIN_ALPHA)
        mx, my = fx * x / z + cx, fy * y / z + cy
        reach_x, reach_y = math.sqrt(extent2 * cxx), math.sqrt(extent2 * cyy)
        if mx + reach_x < 0.5 or mx - reach_x > width - 0.5 or my + reach_y < 0.5 or my - reach_y > height - 0.5:
            continue
        radius2[g] = extent2
        splats[g, 0], splats[g, 1] = mx, my
        splats[g, 2] = -0.5 * LOG2E * cyy / det
        splats[g, 3] = LOG2E * cxy / det
        splats[g, 4] = -0.5 * LOG2E * cxx / det
        splats[g, 5] = math.log2(opacity)
        splats[g, 6], splats[g, 7], splats[g, 8] = colour[0, g], colour[1, g], colour[2, g]
        splats[g, 9] = z


@njit(cache=True, nogil=True)
def project_backward(  # type: ignore[no-untyped-def]
    thread, threads, camera, state, opacity_logit, radius2, slot_start, slot_count, slots,
    v_state, v_opacity_logit, v_colour, v_mean2d_norm, v_pose,
):  # fmt: skip
    """Sum the blend's gradients of each Gaussian over its tiles and carry them back to its parameters.

    slots [M, GRADIENT], those of Gaussian g the slot_count[g] from slot_start[g]. Every v_* row is written (zeros for
    culled Gaussians). v_mean2d_norm [N]: |dL/dmean2d| in normalised device coordinates (x times W / 2, y times H / 2),
    the unit in which densification thresholds are published. v_pose [threads, 12]: the thread's share of
    dL/d camera_from_world. With G = dL/dconic: dL/dcov2d = -conic G conic; dL/dSigma = A^T dL/dcov2d A.
    One long function, because each step of this chain needs most of what the steps before it computed.
    """
    fx, fy, width, height = camera[0], camera[1], camera[4], camera[5]
    w, shift = _pose(camera)
    limits = _limits(camera)
    v_pose[thread, :] = 0.0
    total = np.zeros(GRADIENT)
    count = state.shape[1]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        if radius2[g] < 0.0 or slot_count[g] == 0:
            v_state[:, g] = 0.0
            v_colour[:, g] = 0.0
            v_opacity_logit[g] = 0.0
            v_mean2d_norm[g] = 0.0
            continue
        total[:] = 0.0
        for slot in range(slot_start[g], slot_start[g] + slot_count[g]):
            for k in range(GRADIENT):
                total[k] += slots[slot, k]
        v_colour[0, g], v_colour[1, g], v_colour[2, g] = total[0], total[1], total[2]
        odds = math.exp(-float(opacity_logit[g]))
        v_opacity_logit[g] = total[4] * odds / (1.0 + odds)  # times 1 - opacity, exact also where opacity rounds to 1

        # The forward pass again, as far as the backward needs it: B = A R, cov2d = B S^2 B^T + EPS2D I.
        mean = _rows_of(state, 0, g)
        x, y, z = _dot(w[0], mean) + shift[0], _dot(w[1], mean) + shift[1], _dot(w[2], mean) + shift[2]
        q, n = _quaternion(state, g)
        r = _rotation(q)
        s0, s1, s2 = _rows_of(state, 7, g)
        variance = (math.exp(2.0 * s0), math.exp(2.0 * s1), math.exp(2.0 * s2))
        u, v = _clamped(x, y, z, limits)
        j0, j1 = fx / z, fy / z
        a0, a1 = _sum(j0, w[0], -j0 * u, w[2]), _sum(j1, w[1], -j1 * v, w[2])
        b0, b1 = _through(a0, r), _through(a1, r)
        t0, t1 = _each(b0, variance), _each(b1, variance)
        cxx, cxy, cyy = _dot(t0, b0) + EPS2D, _dot(t0, b1), _dot(t1, b1) + EPS2D
        inverse_det = 1.0 / (cxx * cyy - cxy * cxy)
        ka, kb, kc = cyy * inverse_det, -cxy * inverse_det, cxx * inverse_det

        v_mx, v_my = ka * total[5] + kb * total[6], kb * total[5] + kc * total[6]
        v_mean2d_norm[g] = 0.5 * math.sqrt(v_mx * v_mx * width * width + v_my * v_my * height * height)
        g00, g01, g11 = -0.5 * total[7], -0.5 * total[8], -0.5 * total[9]  # dL/dconic, symmetric halves
        h00, h01 = ka * g00 + kb * g01, ka * g01 + kb * g11
        h10, h11 = kb * g00 + kc * g01, kb * g01 + kc * g11
        c00, c01, c11 = -(h00 * ka + h01 * kb), -(h00 * kb + h01 * kc), -(h10 * kb + h11 * kc)

        # dL/dB = 2 dL/dcov2d B S^2 =: E; dL/dlog s_k = b_k . e_k, the sum over both rows of column k.
        e0, e1 = _sum(2 * c00, t0, 2 * c01, t1), _sum(2 * c01, t0, 2 * c11, t1)
        v_state[7, g] = b0[0] * e0[0] + b1[0] * e1[0]
        v_state[8, g] = b0[1] * e0[1] + b1[1] * e1[1]
        v_state[9, g] = b0[2] * e0[2] + b1[2] * e1[2]

        # dL/dR = A^T E, then through R(q / |q|).
        p = (_sum(a0[0], e0, a1[0], e1), _sum(a0[1], e0, a1[1], e1), _sum(a0[2], e0, a1[2], e1))
        v_state[3, g], v_state[4, g], v_state[5, g], v_state[6, g] = _quaternion_gradient(q, n, p)

        # dL/dA = E R^T =: F, then to the camera point through A = diag(j) (W_xy - (u, v) W_z).
        f0, f1 = _onto(r, e0), _onto(r, e1)
        v_x, v_y = j0 * v_mx, j1 * v_my
        v_z = total[3] - (x * v_x + y * v_y + _dot(f0, a0) + _dot(f1, a1)) / z
        if limits[0] < x / z < limits[1]:
            v_u = -j0 * _dot(f0, w[2])
            v_x += v_u / z
            v_z -= v_u * x / (z * z)
        if limits[2] < y / z < limits[3]:
            v_v = -j1 * _dot(f1, w[2])
            v_y += v_v / z
            v_z -= v_v * y / (z * z)
        v_state[0, g], v_state[1, g], v_state[2, g] = _through((v_x, v_y, v_z), w)
        pose = v_pose[thread]
        for k in range(3):
            pose[k] += v_x * mean[k] + j0 * f0[k]
            pose[4 + k] += v_y * mean[k] + j1 * f1[k]
            pose[8 + k] += v_z * mean[k] - j0 * u * f0[k] - j1 * v * f1[k]
        pose[3] += v_x
        pose[7] += v_y
        pose[11] += v_z
