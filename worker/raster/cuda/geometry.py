"""What project.py and project_backward.py both compute of a Gaussian and its camera; device functions.

N Gaussians; state: one frame's rows of N floats, as in project.py; camera: its 18 numbers. Arithmetic is float64 as on
the CPU; exponentials have float32's precision and end at 2**20, so no log-scale or logit, however far out, leaves the
numbers.
"""

from __future__ import annotations

import triton
import triton.language as tl

from worker.raster import LIMIT

_LIMIT, _LOG2E = tl.constexpr(LIMIT), tl.constexpr(1.4426950408889634)
_LEAST, _MOST = tl.constexpr(-200.0), tl.constexpr(13.862943611198906)  # 0 as a float32, and 20 ln 2


@triton.jit
def exp(x):  # type: ignore[no-untyped-def]
    """e^x of a float32, at most 2**20; NaN of NaN."""
    held = tl.maximum(x, _LEAST, propagate_nan=tl.PropagateNan.ALL)
    return tl.exp2(tl.minimum(held, _MOST, propagate_nan=tl.PropagateNan.ALL) * _LOG2E)


@triton.jit
def rotation_of(state, n, there, N):  # type: ignore[no-untyped-def]
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
def variances_of(state, n, there, N):  # type: ignore[no-untyped-def]
    """Squared scales."""
    a = exp(tl.load(state + 7 * N + n, mask=there, other=0.0)).to(tl.float64)
    b = exp(tl.load(state + 8 * N + n, mask=there, other=0.0)).to(tl.float64)
    c = exp(tl.load(state + 9 * N + n, mask=there, other=0.0)).to(tl.float64)
    return a * a, b * b, c * c


@triton.jit
def mean_of(state, n, there, N):  # type: ignore[no-untyped-def]
    a = tl.load(state + n, mask=there, other=0.0).to(tl.float64)
    b = tl.load(state + N + n, mask=there, other=0.0).to(tl.float64)
    c = tl.load(state + 2 * N + n, mask=there, other=0.0).to(tl.float64)
    return a, b, c


@triton.jit
def dot(a0, a1, a2, b0, b1, b2):  # type: ignore[no-untyped-def]
    return a0 * b0 + a1 * b1 + a2 * b2


@triton.jit
def seen(camera, a, b, c):  # type: ignore[no-untyped-def]
    """Camera coordinates of world points."""
    x = dot(tl.load(camera + 6), tl.load(camera + 7), tl.load(camera + 8), a, b, c) + tl.load(camera + 9)
    y = dot(tl.load(camera + 10), tl.load(camera + 11), tl.load(camera + 12), a, b, c) + tl.load(camera + 13)
    z = dot(tl.load(camera + 14), tl.load(camera + 15), tl.load(camera + 16), a, b, c) + tl.load(camera + 17)
    return x, y, z


@triton.jit
def limits(camera, first: tl.constexpr):  # type: ignore[no-untyped-def]
    """Least and greatest x / z (first 0) or y / z (first 1) at which J is taken (Camera.ratio_limits)."""
    focal, centre, size = tl.load(camera + first), tl.load(camera + 2 + first), tl.load(camera + 4 + first)
    return (-centre - size * _LIMIT) / focal, (size - centre + size * _LIMIT) / focal


@triton.jit
def image_row(camera, first: tl.constexpr, ratio, inverse_z):  # type: ignore[no-untyped-def]
    """A row of A = J W (2 x 3): its factor j = focal / z, the clamped ratio u, and j (W_row - u W_z)."""
    low, high = limits(camera, first)
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
