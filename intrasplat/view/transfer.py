"""The kernels of a view's detail: motion, carried residuals and the picture's levels (intrasplat/view/detail.py).

Symbols: H W pixels of the view, h w of the recorded picture, m n of the coarse view.
"""

from __future__ import annotations

import time

import numpy as np

from intrasplat.machine.cache import kernel

_LEAST_Z = np.float32(1e-3)
_ONE, _HALF, _ZERO, _WHITE = np.float32(1), np.float32(0.5), np.float32(0), np.float32(255)
ONE = 1 << 14
"""Residuals, in [-1, 1], and their validity are stored in 16 bits, in units of 1 / ONE."""


@kernel(error_model="numpy", fuses=True)
def carry(  # type: ignore[no-untyped-def]
    thread, threads, depth_mm, lens, eye_from_view, moved_mm, planes, there_mm, eye_lens, max_error, weight, total
):
    """Add a residual, and its weight, where the points of the view were at its frame.

    depth_mm       [H, W] camera z of the view; nothing is added where it is 0
    lens           fx fy cx cy of the view, px; eye_lens: of the recorded picture
    eye_from_view  [3, 4] mm, from the view at its time to the eye at the residual's
    moved_mm       [m, n, 3] motion of the points between the two times, in the eye's axes, of a coarser view
    planes         [h + 2, w + 2, 4] int16, with a border of zeros: R G B times validity, and validity, times ONE
    there_mm       [h + 2, w + 2] depth of the model in the eye
    max_error      relative difference of depth from which on the eye sees another point
    weight         of the residual
    total          [H, W, 4] R G B times weight, and weight: added to
    """
    height, width = depth_mm.shape
    rows, columns = moved_mm.shape[:2]
    last_u, last_v = np.float32(there_mm.shape[1]) - _ONE - _HALF, np.float32(there_mm.shape[0]) - _ONE - _HALF
    inverse_error, unit = _ONE / max_error, weight / np.float32(ONE)
    cells, shares = _places(width, columns)
    tall_cells, tall_shares = _places(height, rows)
    line, pose = np.empty((3, columns + 1), np.float32), eye_from_view
    fx, fy, cx, cy = eye_lens[0], eye_lens[1], eye_lens[2] + _HALF, eye_lens[3] + _HALF
    xs = (np.arange(width).astype(np.float32) + _HALF - lens[2]) / lens[0]
    us, vs, zs = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    for i in range(height * thread // threads, height * (thread + 1) // threads):
        y = (np.float32(i) + _HALF - lens[3]) / lens[1]
        ax, ay, az = (pose[0, 1] * y + pose[0, 2]), (pose[1, 1] * y + pose[1, 2]), (pose[2, 1] * y + pose[2, 2])
        above = tall_cells[i]
        below = min(above + 1, rows - 1)
        for j in range(columns + 1):
            j0 = min(j, columns - 1)
            for n in range(3):
                line[n, j] = moved_mm[above, j0, n] + tall_shares[i] * (moved_mm[below, j0, n] - moved_mm[above, j0, n])
        for j in range(width):
            j0, f = cells[j], shares[j]
            us[j] = line[0, j0] + f * (line[0, j0 + 1] - line[0, j0])
            vs[j] = line[1, j0] + f * (line[1, j0 + 1] - line[1, j0])
            zs[j] = line[2, j0] + f * (line[2, j0 + 1] - line[2, j0])
        for j in range(width):  # without branches and look-ups, so that several pixels are computed at once
            d, x = depth_mm[i, j], xs[j]
            z = d * (pose[2, 0] * x + az) + pose[2, 3] + zs[j]
            inverse_z = _ONE / max(z, _LEAST_Z)
            us[j] = fx * (d * (pose[0, 0] * x + ax) + pose[0, 3] + us[j]) * inverse_z + cx
            vs[j] = fy * (d * (pose[1, 0] * x + ay) + pose[1, 3] + vs[j]) * inverse_z + cy
            zs[j] = z if d > _ZERO else _ZERO
        for j in range(width):
            z, u, v = zs[j], us[j], vs[j]
            if not (z >= _LEAST_Z and u >= _HALF and v >= _HALF and u < last_u and v < last_v):
                continue
            k, m = np.int32(v), np.int32(u)
            fv, fu = v - np.float32(k), u - np.float32(m)
            # unsigned, since Numba looks whether a signed index counts from the end
            k0, k1, m0, m1 = np.uint64(k), np.uint64(k + 1), np.uint64(m), np.uint64(m + 1)
            a, b, c, e = (_ONE - fv) * (_ONE - fu), (_ONE - fv) * fu, fv * (_ONE - fu), fv * fu
            there = a * there_mm[k0, m0] + b * there_mm[k0, m1] + c * there_mm[k1, m0] + e * there_mm[k1, m1]
            apart = (z - there) / z * inverse_error
            near = _ONE - apart * apart
            if near <= _ZERO:
                continue
            scale = near * near * unit
            a, b, c, e = a * scale, b * scale, c * scale, e * scale
            for n in range(4):
                total[i, j, n] += (
                    a * np.float32(planes[k0, m0, n]) + b * np.float32(planes[k0, m1, n])
                    + c * np.float32(planes[k1, m0, n]) + e * np.float32(planes[k1, m1, n])
                )  # fmt: skip


@kernel(inline="always")
def _places(pixels, cells):  # type: ignore[no-untyped-def]
    """[pixels] the cell whose middle lies before each pixel's, and how far towards the next one it lies."""
    before, share = np.empty(pixels, np.int32), np.empty(pixels, np.float32)
    for pixel in range(pixels):
        place = (pixel + 0.5) * cells / pixels - 0.5
        place = min(max(place, 0.0), cells - 1.0)
        before[pixel] = int(place)
        share[pixel] = place - before[pixel]
    return before, share


@kernel(error_model="numpy")
def gather(means, others, opacity, pose, lens, depth_mm, max_error, sums):  # type: ignore[no-untyped-def]
    """Sum the motion of the Gaussians that a view shows in the cells of a coarse view.

    means            [3, N] centres at the view's time, mm, world
    others           [F, 3, N] centres at other times
    opacity          [N]
    pose             [3, 4] view_from_world, mm
    lens, depth_mm   fx fy cx cy, px, and [H, W] camera z of the view
    max_error        relative difference of depth up to which a Gaussian is one that the view shows
    sums             [m, n, 3 F + 1] opacity times motion, mm, and opacity: added to
    """
    height, width = depth_mm.shape
    rows, columns = sums.shape[:2]
    for k in range(means.shape[1]):
        x, y, z = means[0, k], means[1, k], means[2, k]
        ahead = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if ahead < _LEAST_Z:
            continue
        across = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        down = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        u, v = lens[0] * across / ahead + lens[2], lens[1] * down / ahead + lens[3]
        if not (u >= _ZERO and v >= _ZERO and u < np.float32(width) and v < np.float32(height)):
            continue
        j, i = int(u), int(v)
        if abs(ahead - depth_mm[i, j]) > max_error * ahead:
            continue
        weight, cell = opacity[k], sums[i * rows // height, j * columns // width]
        for other in range(others.shape[0]):
            for axis in range(3):
                cell[3 * other + axis] += weight * (others[other, axis, k] - means[axis, k])
        cell[3 * others.shape[0]] += weight


@kernel(fuses=True)
def in_levels(thread, threads, colours, added, light, levels):  # type: ignore[no-untyped-def]
    """levels [H, W, 3] uint8 of colours [3, H, W] + added [H, W, 3], times light [H, W, 3]."""
    height, width = colours.shape[1:]
    for i in range(height * thread // threads, height * (thread + 1) // threads):
        for j in range(width):
            for n in range(3):
                level = (colours[n, i, j] + added[i, j, n]) * light[i, j, n] * _WHITE + _HALF
                levels[i, j, n] = np.uint8(_ZERO if level < _ZERO else _WHITE if level > _WHITE else level)


def compile_transfer() -> float:
    """Compile these kernels for this processor, or load them from the cache; return the seconds it took."""
    start = time.perf_counter()
    one, number, lens = np.ones((2, 2), np.float32), np.float32(1), np.ones(4, np.float32)
    pose, total = np.eye(4, dtype=np.float32)[:3], np.zeros((2, 2, 4), np.float32)
    planes, moved = np.zeros((4, 4, 4), np.int16), np.zeros((1, 1, 3), np.float32)
    carry(0, 1, one, lens, pose, moved, planes, np.ones((4, 4), np.float32), lens, number, number, total)
    points = np.ones((3, 1), np.float32)
    gather(points, points[None], points[0], pose, lens, one, number, np.zeros((1, 1, 4), np.float32))
    levels = np.zeros((2, 2, 3), np.uint8)
    for added in (total[..., :3], np.zeros((2, 2, 3), np.float32)):  # both layouts in which it comes
        in_levels(0, 1, np.ones((3, 2, 2), np.float32), added, np.broadcast_to(number, levels.shape), levels)
    return time.perf_counter() - start
