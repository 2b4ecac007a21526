"""What a frame of a scene has a rasteriser do, counted on the CPU: instances, chunks, evaluated and blended pairs.

Symbols: N Gaussians, P pixels of a tile, K splats of a chunk. An instance is a (splat, tile) pair. The rules are those
of worker/raster/cuda: a tile is listed in the rows of tiles where the splat's ellipse reaches one of its pixel centres
(bins.py); a tile takes its splats nearest first, in chunks of K, until every pixel of it is full (blend.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from worker.raster import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from worker.raster.cpu.model import FusedModel

LN2 = math.log(2.0)
_MIN_ALPHA, _MAX_ALPHA, _STOP = np.float32(MIN_ALPHA), np.float32(MAX_ALPHA), np.float32(MIN_TRANSMITTANCE)


@dataclass(frozen=True)
class Counts:
    """Of one frame, for tiles of a shape.

    instances   (splat, tile) pairs
    most_tiles  that one splat touches
    chunks      that are evaluated, full or not, before their tiles are full
    most_chunks of one tile: no schedule ends before it
    visited     instances in those chunks
    evaluated   pairs of a pixel and a place in a chunk: what the arithmetic is done for
    blended     pairs that contribute: what cannot be avoided
    """

    tile_width: int
    tile_height: int
    chunk: int
    tiles: int
    instances: int
    most_tiles: int
    chunks: int
    most_chunks: int
    visited: int
    evaluated: int
    blended: int


def count(model: FusedModel, camera: NDArray[np.float64], t: float, shape: tuple[int, int], chunk: int) -> Counts:
    """Counts of the model at t through the camera (camera_vector), in tiles of shape (width, height)."""
    model.project(camera, t, model.sh_degree)
    raster, (wide, high) = model.rasterizer, shape
    drawn = np.flatnonzero(raster.radius2 >= 0)
    splats = raster.splats[drawn[np.argsort(raster.splats[drawn, 9], kind="stable")]].astype(np.float64)
    tiles_x, tiles_y = -(-raster.width // wide), -(-raster.height // high)
    size = raster.width, raster.height
    extents = _extents(splats)
    nothing = np.zeros(0, np.int32)
    listed, most_tiles = _list_tiles(splats, extents, *size, wide, high, np.zeros(tiles_x * tiles_y, np.int64), nothing)
    start = np.concatenate([[0], np.cumsum(listed)])
    owner = np.zeros(start[-1], np.int32)
    _list_tiles(splats, extents, *size, wide, high, start[:-1].copy(), owner)
    chunks, visited, blended = _blend(splats.astype(np.float32), start, owner, *size, wide, high, chunk)
    return Counts(
        wide, high, chunk, tiles_x * tiles_y, int(start[-1]), most_tiles, int(chunks.sum()), int(chunks.max()),
        visited, int(chunks.sum()) * chunk * wide * high, blended,
    )  # fmt: skip


def _extents(splats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of every ellipse alpha = MIN_ALPHA [N, 5]: half-height; dy where it is furthest right; middle of a chord over dy;
    squared half-chord at dy = 0 and what it loses with dy^2."""
    a, b, c = -2 * LN2 * splats[:, 2], -LN2 * splats[:, 3], -2 * LN2 * splats[:, 4]
    r = np.maximum(2 * LN2 * (splats[:, 5] - math.log2(MIN_ALPHA)), 0)
    determinant = a * c - b * b
    high = np.sqrt(r * a / determinant)
    turn = -b * np.sqrt(r / (c * determinant))
    return np.stack([high, turn, -b / a, r / a, determinant / (a * a)], axis=1)


@njit(cache=False)
def _list_tiles(splats, extents, width, height, wide, high, place, owner):  # type: ignore[no-untyped-def]
    """Count the instances of every tile, place [tiles] from 0 on; or, where owner is not empty, write them from place
    on. The instances of each tile, and the most of a splat."""
    tiles_x = -(-width // wide)
    most = 0
    for g in range(splats.shape[0]):
        x, y = splats[g, 0], splats[g, 1]
        reach, turn, lean, square, fall = extents[g]
        own = 0
        first_row = max(math.floor((y - reach - 0.5) / high), 0)
        for row in range(first_row, min(math.floor((y + reach - 0.5) / high), -(-height // high) - 1) + 1):
            low = max(row * high + 0.5 - y, -reach)
            last = min(min(row * high + high, height) - 0.5 - y, reach)
            if low > last:
                continue
            at = min(max(turn, low), last)
            right = lean * at + math.sqrt(max(square - fall * at * at, 0.0))
            at = min(max(-turn, low), last)
            left = lean * at - math.sqrt(max(square - fall * at * at, 0.0))
            begin, end = max(math.ceil(x + left - 0.5), 0), min(math.floor(x + right - 0.5), width - 1)
            if begin > end:
                continue
            for column in range(begin // wide, end // wide + 1):
                tile = row * tiles_x + column
                if owner.shape[0]:
                    owner[place[tile]] = g
                place[tile] += 1
                own += 1
        most = max(most, own)
    return place, most


@njit(cache=False)
def _blend(splats, start, owner, width, height, wide, high, chunk):  # type: ignore[no-untyped-def]
    """Chunks of every tile until it is full, instances in them, and pairs blended."""
    tiles_x = -(-width // wide)
    chunks = np.zeros(start.shape[0] - 1, np.int64)
    visited, blended = 0, 0
    for tile in range(start.shape[0] - 1):
        left, top = tile % tiles_x * wide, tile // tiles_x * high
        across, down = min(wide, width - left), min(high, height - top)
        transmittance = np.ones((down, across), np.float32)
        i, end = start[tile], start[tile + 1]
        while i < end and transmittance.max() >= _STOP:
            chunks[tile] += 1
            for k in range(i, min(i + chunk, end)):
                visited += 1
                x, y, k_xx, k_xy, k_yy, log2_opacity = splats[owner[k], :6]
                for row in range(down):
                    dy = np.float32(top + row + 0.5) - y
                    for column in range(across):
                        dx = np.float32(left + column + 0.5) - x
                        alpha = 2.0 ** (log2_opacity + k_xx * dx * dx + k_xy * dx * dy + k_yy * dy * dy)
                        if alpha >= _MIN_ALPHA and transmittance[row, column] >= _STOP:
                            transmittance[row, column] *= np.float32(1.0) - min(alpha, _MAX_ALPHA)
                            blended += 1
            i += chunk
    return chunks, visited, blended
