"""Triangles to pixels: a z-buffer that keeps the material point of each pixel.

Symbols: V vertices, F triangles, A attributes of a vertex, H W pixels.

A pixel keeps its triangle and its perspective-correct barycentric weights. Depth, colour coordinates, normals and the
point's position at any other time are interpolated from these, so they agree exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.machine.cache import kernel

NEAR_MM = 2.0  # triangles with a corner nearer than this are not drawn
EDGE_TOLERANCE = 1e-9  # of a weight, so that rounding leaves no hole between two triangles


@dataclass(frozen=True)
class Fragments:
    """The fragment at each pixel's centre.

    depth_mm  [H, W]    float32, camera z, 0 where nothing is hit
    triangle  [H, W]    int32, index into triangles, -1 where nothing is hit
    weights   [H, W, 3] float32, barycentric weights of the triangle's corners (on the surface, not on the screen)
    """

    depth_mm: NDArray[np.float32]
    triangle: NDArray[np.int32]
    weights: NDArray[np.float32]


def rasterize_mesh(
    vertices_mm: NDArray[np.float64],
    triangles: NDArray[np.int32],
    world_from_camera: NDArray[np.float64],
    intrinsics: Intrinsics,
) -> Fragments:
    """The nearest triangle at every pixel centre. vertices_mm [V, 3] world, triangles [F, 3]; both sides are drawn."""
    rotation, centre = world_from_camera[:3, :3], world_from_camera[:3, 3]
    shape = (intrinsics.height, intrinsics.width)
    depth_mm = np.zeros(shape, dtype=np.float32)
    triangle = np.full(shape, -1, dtype=np.int32)
    weights = np.zeros((*shape, 3), dtype=np.float32)
    x, y, z = (np.empty(vertices_mm.shape[0]) for _ in range(3))
    pinhole = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx - 0.5, intrinsics.cy - 0.5])
    _project(vertices_mm, rotation.copy(), centre.copy(), pinhole, x, y, z)
    _fill(x, y, z, triangles, depth_mm, triangle, weights)
    return Fragments(depth_mm, triangle, weights)


def interpolate(
    fragments: Fragments, triangles: NDArray[np.int32], attributes: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Attributes [V, A] of the vertices at every pixel: [H, W, A], 0 where nothing is hit."""
    shape = fragments.triangle.shape
    result = np.zeros((*shape, attributes.shape[1]), dtype=np.float32)
    _gather(fragments.triangle, fragments.weights, triangles, attributes, result)
    return result


def grid_triangles(rows: int, columns: int, first_vertex: int = 0) -> NDArray[np.int32]:
    """Two triangles for each cell of a rows x columns grid of vertices: [2 (rows - 1) (columns - 1), 3]."""
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns) + first_vertex
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    upper, lower = np.stack([a, b, c], -1), np.stack([b, d, c], -1)
    return np.ascontiguousarray(np.stack([upper, lower], 2).reshape(-1, 3))


def grid_normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normals [rows, columns, 3] of a grid of points, on the side of frame 0's camera.

    Where the grid is folded to a line, the normal is (0, 0, -1).
    """
    along_rows, along_columns = np.gradient(points, axis=(0, 1))
    normals = np.cross(along_rows, along_columns)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit: NDArray[np.float64] = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), (0.0, 0.0, -1.0))
    return unit


@kernel
def _project(
    vertices_mm: NDArray[np.float64],
    rotation: NDArray[np.float64],
    centre: NDArray[np.float64],
    pinhole: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
) -> None:
    """Write x, y [V] (px, pixel centres at whole numbers) and z [V] (mm); behind the camera only z is valid."""
    for v in range(vertices_mm.shape[0]):
        a, b, c = vertices_mm[v, 0] - centre[0], vertices_mm[v, 1] - centre[1], vertices_mm[v, 2] - centre[2]
        z[v] = a * rotation[0, 2] + b * rotation[1, 2] + c * rotation[2, 2]
        ahead = max(z[v], NEAR_MM)
        x[v] = pinhole[0] * (a * rotation[0, 0] + b * rotation[1, 0] + c * rotation[2, 0]) / ahead + pinhole[2]
        y[v] = pinhole[1] * (a * rotation[0, 1] + b * rotation[1, 1] + c * rotation[2, 1]) / ahead + pinhole[3]


@kernel
def _fill(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    triangles: NDArray[np.int32],
    depth_mm: NDArray[np.float32],
    triangle: NDArray[np.int32],
    weights: NDArray[np.float32],
) -> None:
    """x, y [V] are in pixels with pixel centres at whole numbers; z [V] in mm."""
    height, width = depth_mm.shape
    for f in range(triangles.shape[0]):
        i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        if z[i] <= NEAR_MM or z[j] <= NEAR_MM or z[k] <= NEAR_MM:
            continue
        left = max(0, int(np.ceil(min(x[i], x[j], x[k]))))
        right = min(width - 1, int(np.floor(max(x[i], x[j], x[k]))))
        top = max(0, int(np.ceil(min(y[i], y[j], y[k]))))
        bottom = min(height - 1, int(np.floor(max(y[i], y[j], y[k]))))
        area = (x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i])
        if left > right or top > bottom or area == 0.0:
            continue
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                wi = ((x[j] - column) * (y[k] - row) - (x[k] - column) * (y[j] - row)) / area
                wj = ((x[k] - column) * (y[i] - row) - (x[i] - column) * (y[k] - row)) / area
                wk = 1.0 - wi - wj
                if min(wi, wj, wk) < -EDGE_TOLERANCE:
                    continue
                # 1/z is linear on the screen, so screen weights over z are the surface's weights
                wi, wj, wk = wi / z[i], wj / z[j], wk / z[k]
                depth = 1.0 / (wi + wj + wk)
                if triangle[row, column] >= 0 and depth >= depth_mm[row, column]:
                    continue
                depth_mm[row, column] = depth
                triangle[row, column] = f
                weights[row, column, 0] = wi * depth
                weights[row, column, 1] = wj * depth
                weights[row, column, 2] = wk * depth


@kernel
def _gather(
    triangle: NDArray[np.int32],
    weights: NDArray[np.float32],
    triangles: NDArray[np.int32],
    attributes: NDArray[np.float32],
    result: NDArray[np.float32],
) -> None:
    height, width, count = result.shape
    for row in range(height):
        for column in range(width):
            f = triangle[row, column]
            if f < 0:
                continue
            for corner in range(3):
                vertex = triangles[f, corner]
                weight = weights[row, column, corner]
                for a in range(count):
                    result[row, column, a] += weight * attributes[vertex, a]
