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


@njit(cache=True, nogil=True, inline="always")
def _rotation(qw, qx, qy, qz):  # type: ignore[no-untyped-def]
    """Rotation matrix of a unit quaternion wxyz, row-major."""
    return (
        1 - 2 * (qy * qy + qz * qz),
        2 * (qx * qy - qw * qz),
        2 * (qx * qz + qw * qy),
        2 * (qx * qy + qw * qz),
        1 - 2 * (qx * qx + qz * qz),
        2 * (qy * qz - qw * qx),
        2 * (qx * qz - qw * qy),
        2 * (qy * qz + qw * qx),
        1 - 2 * (qx * qx + qy * qy),
    )


@njit(cache=True, nogil=True, inline="always")
def _clamped(u, low, high):  # type: ignore[no-untyped-def]
    return min(max(u, low), high)


@njit(cache=True, nogil=True)
def project(thread, threads, camera, state, opacity_logit, colour, splats, radius2):  # type: ignore[no-untyped-def]
    """Fill splats [N, SPLAT] and radius2 [N]: 2 ln(opacity / MIN_ALPHA), the squared Mahalanobis radius, or -1 if culled.

    camera: float64 [18] = fx, fy, cx, cy, W, H, camera_from_world row-major [3, 4].
    """
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    w00, w01, w02, w03 = camera[6], camera[7], camera[8], camera[9]
    w10, w11, w12, w13 = camera[10], camera[11], camera[12], camera[13]
    w20, w21, w22, w23 = camera[14], camera[15], camera[16], camera[17]
    low_x, high_x = (-cx - LIMIT * width) / fx, (width - cx + LIMIT * width) / fx
    low_y, high_y = (-cy - LIMIT * height) / fy, (height - cy + LIMIT * height) / fy
    count = state.shape[1]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        radius2[g] = -1.0
        m0, m1, m2 = float(state[0, g]), float(state[1, g]), float(state[2, g])
        z = w20 * m0 + w21 * m1 + w22 * m2 + w23
        opacity = 1.0 / (1.0 + math.exp(-float(opacity_logit[g])))
        if not (z > NEAR and opacity >= MIN_ALPHA):
            continue
        x = w00 * m0 + w01 * m1 + w02 * m2 + w03
        y = w10 * m0 + w11 * m1 + w12 * m2 + w13
        q0, q1, q2, q3 = float(state[3, g]), float(state[4, g]), float(state[5, g]), float(state[6, g])
        n = 1.0 / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(q0 * n, q1 * n, q2 * n, q3 * n)
        s0, s1, s2 = math.exp(float(state[7, g])), math.exp(float(state[8, g])), math.exp(float(state[9, g]))
        # A = J W (2 x 3), then K = A R S (2 x 3), cov2d = K K^T + EPS2D I.
        u, v = _clamped(x / z, low_x, high_x), _clamped(y / z, low_y, high_y)
        j0, j1 = fx / z, fy / z
        a00, a01, a02 = j0 * (w00 - u * w20), j0 * (w01 - u * w21), j0 * (w02 - u * w22)
        a10, a11, a12 = j1 * (w10 - v * w20), j1 * (w11 - v * w21), j1 * (w12 - v * w22)
        k00, k01, k02 = (
            (a00 * r00 + a01 * r10 + a02 * r20) * s0,
            (a00 * r01 + a01 * r11 + a02 * r21) * s1,
            (a00 * r02 + a01 * r12 + a02 * r22) * s2,
        )
        k10, k11, k12 = (
            (a10 * r00 + a11 * r10 + a12 * r20) * s0,
            (a10 * r01 + a11 * r11 + a12 * r21) * s1,
            (a10 * r02 + a11 * r12 + a12 * r22) * s2,
        )
        cxx = k00 * k00 + k01 * k01 + k02 * k02 + EPS2D
        cxy = k00 * k10 + k01 * k11 + k02 * k12
        cyy = k10 * k10 + k11 * k11 + k12 * k12 + EPS2D
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
        splats[g, 2], splats[g, 3], splats[g, 4] = (
            -0.5 * LOG2E * cyy / det,
            LOG2E * cxy / det,
            -0.5 * LOG2E * cxx / det,
        )
        splats[g, 5] = math.log2(opacity)
        splats[g, 6], splats[g, 7], splats[g, 8] = colour[0, g], colour[1, g], colour[2, g]
        splats[g, 9] = z


@njit(cache=True, nogil=True)
def project_backward(  # type: ignore[no-untyped-def]
    thread, threads, camera, state, opacity_logit, radius2, slot_start, slots,
    v_state, v_opacity_logit, v_colour, v_mean2d_norm, v_pose,
):  # fmt: skip
    """Sum the blend's gradients of each Gaussian over its tiles and carry them back to its parameters.

    slots [M, GRADIENT], those of Gaussian g at slot_start[g] : slot_start[g + 1]. Every v_* row is written (zeros for
    culled Gaussians). v_mean2d_norm [N]: |dL/dmean2d| in normalised device
    coordinates (x times W / 2, y times H / 2), the unit in which densification thresholds are published. v_pose [threads, 12]: the thread's
    share of dL/d camera_from_world. With G = dL/dconic: dL/dcov2d = -conic G conic; dL/dSigma = A^T dL/dcov2d A.
    """
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    w00, w01, w02, w03 = camera[6], camera[7], camera[8], camera[9]
    w10, w11, w12, w13 = camera[10], camera[11], camera[12], camera[13]
    w20, w21, w22, w23 = camera[14], camera[15], camera[16], camera[17]
    low_x, high_x = (-cx - LIMIT * width) / fx, (width - cx + LIMIT * width) / fx
    low_y, high_y = (-cy - LIMIT * height) / fy, (height - cy + LIMIT * height) / fy
    v_pose[thread, :] = 0.0
    total = np.zeros(GRADIENT)
    count = state.shape[1]
    for g in range(count * thread // threads, count * (thread + 1) // threads):
        if radius2[g] < 0.0 or slot_start[g] == slot_start[g + 1]:
            v_state[:, g] = 0.0
            v_colour[:, g] = 0.0
            v_opacity_logit[g] = 0.0
            v_mean2d_norm[g] = 0.0
            continue
        total[:] = 0.0
        for slot in range(slot_start[g], slot_start[g + 1]):
            for k in range(GRADIENT):
                total[k] += slots[slot, k]
        v_colour[0, g], v_colour[1, g], v_colour[2, g] = total[0], total[1], total[2]
        opacity = 1.0 / (1.0 + math.exp(-float(opacity_logit[g])))
        v_opacity_logit[g] = total[4] * (1.0 - opacity)

        # The forward pass again, as far as the backward needs it.
        m0, m1, m2 = float(state[0, g]), float(state[1, g]), float(state[2, g])
        x = w00 * m0 + w01 * m1 + w02 * m2 + w03
        y = w10 * m0 + w11 * m1 + w12 * m2 + w13
        z = w20 * m0 + w21 * m1 + w22 * m2 + w23
        q0, q1, q2, q3 = float(state[3, g]), float(state[4, g]), float(state[5, g]), float(state[6, g])
        n = 1.0 / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        q0, q1, q2, q3 = q0 * n, q1 * n, q2 * n, q3 * n
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(q0, q1, q2, q3)
        s0, s1, s2 = math.exp(float(state[7, g])), math.exp(float(state[8, g])), math.exp(float(state[9, g]))
        u, v = _clamped(x / z, low_x, high_x), _clamped(y / z, low_y, high_y)
        j0, j1 = fx / z, fy / z
        a00, a01, a02 = j0 * (w00 - u * w20), j0 * (w01 - u * w21), j0 * (w02 - u * w22)
        a10, a11, a12 = j1 * (w10 - v * w20), j1 * (w11 - v * w21), j1 * (w12 - v * w22)
        # B = A R: cov2d = B S^2 B^T.
        b00, b01, b02 = (
            a00 * r00 + a01 * r10 + a02 * r20,
            a00 * r01 + a01 * r11 + a02 * r21,
            a00 * r02 + a01 * r12 + a02 * r22,
        )
        b10, b11, b12 = (
            a10 * r00 + a11 * r10 + a12 * r20,
            a10 * r01 + a11 * r11 + a12 * r21,
            a10 * r02 + a11 * r12 + a12 * r22,
        )
        t0, t1, t2 = s0 * s0, s1 * s1, s2 * s2
        cxx = b00 * b00 * t0 + b01 * b01 * t1 + b02 * b02 * t2 + EPS2D
        cxy = b00 * b10 * t0 + b01 * b11 * t1 + b02 * b12 * t2
        cyy = b10 * b10 * t0 + b11 * b11 * t1 + b12 * b12 * t2 + EPS2D
        inverse_det = 1.0 / (cxx * cyy - cxy * cxy)
        ka, kb, kc = cyy * inverse_det, -cxy * inverse_det, cxx * inverse_det

        v_mx, v_my = ka * total[5] + kb * total[6], kb * total[5] + kc * total[6]
        v_mean2d_norm[g] = 0.5 * math.sqrt(v_mx * v_mx * width * width + v_my * v_my * height * height)
        g00, g01, g11 = -0.5 * total[7], -0.5 * total[8], -0.5 * total[9]  # dL/dconic, symmetric halves
        h00, h01 = ka * g00 + kb * g01, ka * g01 + kb * g11
        h10, h11 = kb * g00 + kc * g01, kb * g01 + kc * g11
        c00, c01, c11 = -(h00 * ka + h01 * kb), -(h00 * kb + h01 * kc), -(h10 * kb + h11 * kc)

        # dL/dB = 2 dL/dcov2d B S^2; dL/dlog s_k = 2 s_k^2 b_k^T dL/dcov2d b_k.
        e00, e01, e02 = c00 * b00 + c01 * b10, c00 * b01 + c01 * b11, c00 * b02 + c01 * b12
        e10, e11, e12 = c01 * b00 + c11 * b10, c01 * b01 + c11 * b11, c01 * b02 + c11 * b12
        v_state[7, g] = 2.0 * t0 * (b00 * e00 + b10 * e10)
        v_state[8, g] = 2.0 * t1 * (b01 * e01 + b11 * e11)
        v_state[9, g] = 2.0 * t2 * (b02 * e02 + b12 * e12)
        e00, e10, e01, e11, e02, e12 = (
            2 * e00 * t0,
            2 * e10 * t0,
            2 * e01 * t1,
            2 * e11 * t1,
            2 * e02 * t2,
            2 * e12 * t2,
        )

        # dL/dR = A^T dL/dB, then through R(q / |q|).
        p00, p01, p02 = a00 * e00 + a10 * e10, a00 * e01 + a10 * e11, a00 * e02 + a10 * e12
        p10, p11, p12 = a01 * e00 + a11 * e10, a01 * e01 + a11 * e11, a01 * e02 + a11 * e12
        p20, p21, p22 = a02 * e00 + a12 * e10, a02 * e01 + a12 * e11, a02 * e02 + a12 * e12
        d0 = 2 * (q1 * (p21 - p12) + q2 * (p02 - p20) + q3 * (p10 - p01))
        d1 = 2 * (q2 * (p01 + p10) + q3 * (p02 + p20) + q0 * (p21 - p12)) - 4 * q1 * (p11 + p22)
        d2 = 2 * (q1 * (p01 + p10) + q3 * (p12 + p21) + q0 * (p02 - p20)) - 4 * q2 * (p00 + p22)
        d3 = 2 * (q1 * (p02 + p20) + q2 * (p12 + p21) + q0 * (p10 - p01)) - 4 * q3 * (p00 + p11)
        along = d0 * q0 + d1 * q1 + d2 * q2 + d3 * q3
        v_state[3, g], v_state[4, g] = n * (d0 - along * q0), n * (d1 - along * q1)
        v_state[5, g], v_state[6, g] = n * (d2 - along * q2), n * (d3 - along * q3)

        # dL/dA = dL/dB R^T, then to the camera point through A = diag(j) (W_xy - (u, v) W_z).
        f00, f01, f02 = (
            e00 * r00 + e01 * r01 + e02 * r02,
            e00 * r10 + e01 * r11 + e02 * r12,
            e00 * r20 + e01 * r21 + e02 * r22,
        )
        f10, f11, f12 = (
            e10 * r00 + e11 * r01 + e12 * r02,
            e10 * r10 + e11 * r11 + e12 * r12,
            e10 * r20 + e11 * r21 + e12 * r22,
        )
        v_u = -j0 * (f00 * w20 + f01 * w21 + f02 * w22)
        v_v = -j1 * (f10 * w20 + f11 * w21 + f12 * w22)
        v_x, v_y = j0 * v_mx, j1 * v_my
        v_z = total[3] - (j0 * x * v_mx + j1 * y * v_my) / z
        v_z -= (f00 * a00 + f01 * a01 + f02 * a02 + f10 * a10 + f11 * a11 + f12 * a12) / z
        if low_x < x / z < high_x:
            v_x += v_u / z
            v_z -= v_u * x / (z * z)
        if low_y < y / z < high_y:
            v_y += v_v / z
            v_z -= v_v * y / (z * z)
        v_state[0, g] = w00 * v_x + w10 * v_y + w20 * v_z
        v_state[1, g] = w01 * v_x + w11 * v_y + w21 * v_z
        v_state[2, g] = w02 * v_x + w12 * v_y + w22 * v_z
        pose = v_pose[thread]
        pose[0] += v_x * m0 + j0 * f00
        pose[1] += v_x * m1 + j0 * f01
        pose[2] += v_x * m2 + j0 * f02
        pose[3] += v_x
        pose[4] += v_y * m0 + j1 * f10
        pose[5] += v_y * m1 + j1 * f11
        pose[6] += v_y * m2 + j1 * f12
        pose[7] += v_y
        pose[8] += v_z * m0 - j0 * u * f00 - j1 * v * f10
        pose[9] += v_z * m1 - j0 * u * f01 - j1 * v * f11
        pose[10] += v_z * m2 - j0 * u * f02 - j1 * v * f12
        pose[11] += v_z
