"""Device functions of a Gaussian and its camera that project.py and project_backward.py share.

N Gaussians; state: one frame's rows of N floats, as in project.py; camera: its CAMERA numbers. Arithmetic is float64 as
on the CPU. Exponentials have float32's precision and are limited to 2**20, so results are finite for any log-scale and
logit.
"""

from __future__ import annotations

import triton
import triton.language as tl

from intrasplat.splat.constants import EPS2D, IMAGE_MARGIN, LN2, LOG2E, MAX_LOG2_EXP
from intrasplat.splat.layout import CX, ENLARGED, FX, LOG_SCALE_ROW, MEAN_ROW, POSE, QUATERNION_ROW, RECORDED, WIDTH

_MARGIN, _LOG2E = tl.constexpr(IMAGE_MARGIN), tl.constexpr(LOG2E)
_MIN_EXPONENT, _MAX_EXPONENT = tl.constexpr(-200.0), tl.constexpr(MAX_LOG2_EXP * LN2)  # below: 0 as a float32
_X, _Q, _S = tl.constexpr(MEAN_ROW), tl.constexpr(QUATERNION_ROW), tl.constexpr(LOG_SCALE_ROW)
_FOCAL, _CENTRE, _SIZE, _POSE = tl.constexpr(FX), tl.constexpr(CX), tl.constexpr(WIDTH), tl.constexpr(POSE)
_EPS2D, _ENLARGED, _RECORDED = tl.constexpr(EPS2D), tl.constexpr(ENLARGED), tl.constexpr(RECORDED)


@triton.jit
def exp(x):  # type: ignore[no-untyped-def]
    """e^x of a float32, at most 2**20; NaN of NaN."""
    clamped = tl.maximum(x, _MIN_EXPONENT, propagate_nan=tl.PropagateNan.ALL)
    return tl.exp2(tl.minimum(clamped, _MAX_EXPONENT, propagate_nan=tl.PropagateNan.ALL) * _LOG2E)


@triton.jit
def rotation_of(state, n, there, N):  # type: ignore[no-untyped-def]
    """Unit quaternion wxyz, 1 / its stored length, and its rotation matrix, row by row."""
    w = tl.load(state + N * _Q + n, mask=there, other=1.0).to(tl.float64)
    x = tl.load(state + N * (_Q + 1) + n, mask=there, other=0.0).to(tl.float64)
    y = tl.load(state + N * (_Q + 2) + n, mask=there, other=0.0).to(tl.float64)
    z = tl.load(state + N * (_Q + 3) + n, mask=there, other=0.0).to(tl.float64)
    inverse = 1.0 / tl.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    return (
        w, x, y, z, inverse,
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def variances_of(state, n, there, N):  # type: ignore[no-untyped-def]
    """Squared scales."""
    a = exp(tl.load(state + N * _S + n, mask=there, other=0.0)).to(tl.float64)
    b = exp(tl.load(state + N * (_S + 1) + n, mask=there, other=0.0)).to(tl.float64)
    c = exp(tl.load(state + N * (_S + 2) + n, mask=there, other=0.0)).to(tl.float64)
    return a * a, b * b, c * c


@triton.jit
def mean_of(state, n, there, N):  # type: ignore[no-untyped-def]
    a = tl.load(state + N * _X + n, mask=there, other=0.0).to(tl.float64)
    b = tl.load(state + N * (_X + 1) + n, mask=there, other=0.0).to(tl.float64)
    c = tl.load(state + N * (_X + 2) + n, mask=there, other=0.0).to(tl.float64)
    return a, b, c


@triton.jit
def dot(a0, a1, a2, b0, b1, b2):  # type: ignore[no-untyped-def]
    return a0 * b0 + a1 * b1 + a2 * b2


@triton.jit
def seen(camera, a, b, c):  # type: ignore[no-untyped-def]
    """Camera coordinates of world points."""
    row = camera + _POSE
    x = dot(tl.load(row), tl.load(row + 1), tl.load(row + 2), a, b, c) + tl.load(row + 3)
    y = dot(tl.load(row + 4), tl.load(row + 5), tl.load(row + 6), a, b, c) + tl.load(row + 7)
    z = dot(tl.load(row + 8), tl.load(row + 9), tl.load(row + 10), a, b, c) + tl.load(row + 11)
    return x, y, z


@triton.jit
def nearness(camera, a, b, c, inverse_z):  # type: ignore[no-untyped-def]
    """z_r / z of world points: depth in the recording's camera over depth in this one (intrasplat/splat/camera.py)."""
    row = camera + _RECORDED
    return (dot(tl.load(row), tl.load(row + 1), tl.load(row + 2), a, b, c) + tl.load(row + 3)) * inverse_z


@triton.jit
def low_pass(camera, first: tl.constexpr, nearer):  # type: ignore[no-untyped-def]
    """The term added to the variance along x (first 0) or y (first 1)."""
    m = tl.maximum(tl.load(camera + _ENLARGED + first) * nearer, 1.0)
    return _EPS2D * m * m


@triton.jit
def limits(camera, first: tl.constexpr):  # type: ignore[no-untyped-def]
    """Least and greatest x / z (first 0) or y / z (first 1) to which u or v is clamped (Camera.ratio_limits)."""
    focal, centre = tl.load(camera + _FOCAL + first), tl.load(camera + _CENTRE + first)
    size = tl.load(camera + _SIZE + first)
    return (-centre - size * _MARGIN) / focal, (size - centre + size * _MARGIN) / focal


@triton.jit
def image_row(camera, first: tl.constexpr, ratio, inverse_z):  # type: ignore[no-untyped-def]
    """A row of A = J W (2 x 3): its factor j = focal / z, the clamped ratio u, and j (W_row - u W_z)."""
    low, high = limits(camera, first)
    clamped = tl.minimum(tl.maximum(ratio, low), high)
    j = tl.load(camera + _FOCAL + first) * inverse_z
    row, away = camera + _POSE + 4 * first, camera + _POSE + 8
    return (
        j,
        clamped,
        j * (tl.load(row) - clamped * tl.load(away)),
        j * (tl.load(row + 1) - clamped * tl.load(away + 1)),
        j * (tl.load(row + 2) - clamped * tl.load(away + 2)),
    )
