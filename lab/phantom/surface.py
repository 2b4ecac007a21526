"""The tissue's shape: grids of material points, and their positions at any frame.

Symbols: V vertices, F triangles. Material coordinates (u, v) are mm to the right and down on the sheet at rest; the
atlas is the picture all colours are looked up in, the sheet above and the cut's groove below it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from lab.phantom.camera import farther_mm
from lab.phantom.fields import Image32, lobed, smooth_field
from lab.phantom.mesh import grid_normals, grid_triangles
from lab.phantom.motion import CUT_HALF_LENGTH_MM, CUT_SLANT, Cut, TissueMotion, make_motion
from lab.phantom.settings import MEAN_DEPTH_MM, PhantomSettings

DEPTH_RANGE_MM = (58.0, 104.0)  # of the sheet at rest
SHEET_PER_VIEW = 1.75  # size of the sheet over the view at mean depth, with a margin for motion and other views
MIN_HALF_MM = 30.0  # minimum half size of the sheet, so that a cut fits into the flattest picture
TILT_MM_PER_MM = (0.06, -0.2)  # (right, down): the lower edge is nearer, as seen along a cavity
LOOPS_MM = ((34.0, 11.0, 0.12), (13.0, 1.9, 0.15))  # (wavelength, height, crease) of folds and of lobes on them
RELIEF_MM = (4.5, 0.16)  # (wavelength, height)

STEP_PX = 3.0  # grid step of the mesh, in pixels at mean depth
STEP_MM = (0.25, 0.9)  # and its limits
GROOVE_COLUMNS = 25
GROOVE_WIDTH_MM = 26.0  # of the atlas, across the open groove and its walls
GUTTER_TEXELS = 4
TEXEL_PX = 0.8  # a texel of the atlas in pixels at mean depth


@dataclass(frozen=True)
class Atlas:
    """Position of sheet and groove on the atlas. Sizes in texels; both start at column 0."""

    texel_mm: float
    sheet_shape: tuple[int, int]
    groove_shape: tuple[int, int]

    @property
    def groove_row(self) -> int:
        return self.sheet_shape[0] + GUTTER_TEXELS

    @property
    def shape(self) -> tuple[int, int]:
        rows = self.groove_row + self.groove_shape[0] if self.groove_shape[0] else self.sheet_shape[0]
        return rows, max(self.sheet_shape[1], self.groove_shape[1])


@dataclass(frozen=True)
class Patch:
    """A grid of material points: rest [rows, columns, 3] mm and atlas coordinates [rows, columns, 2] in texels."""

    rest_mm: NDArray[np.float64]
    atlas_xy: NDArray[np.float32]
    side: float = 0.0  # of the cut: -1 left, +1 right, 0 without a cut


@dataclass(frozen=True)
class Surface:
    """The tissue of a phantom.

    triangles [F, 3] int32, atlas_xy [V, 2] float32: fixed. Vertices move: vertices_mm(frame).
    """

    half_extent_mm: tuple[float, float]
    rest_z_mm: Image32  # over the sheet, on a regular grid
    atlas: Atlas
    motion: TissueMotion
    patches: tuple[Patch, ...]
    groove_rows: slice
    triangles: NDArray[np.int32] = field(init=False)
    atlas_xy: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        triangles, first = [], 0
        for patch in self.patches:
            rows, columns = patch.rest_mm.shape[:2]
            triangles.append(grid_triangles(rows, columns, first))
            first += rows * columns
        object.__setattr__(self, "triangles", np.concatenate(triangles))
        object.__setattr__(self, "atlas_xy", np.concatenate([p.atlas_xy.reshape(-1, 2) for p in self.patches]))

    def vertices_mm(self, frame: float) -> NDArray[np.float64]:
        """World positions [V, 3] of the material points."""
        return np.concatenate([grid.reshape(-1, 3) for grid in self._grids(frame)])

    def vertices_and_normals(self, frame: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """World positions [V, 3] and unit normals [V, 3]."""
        grids = self._grids(frame)
        normals = [grid_normals(grid).reshape(-1, 3) for grid in grids]
        return np.concatenate([grid.reshape(-1, 3) for grid in grids]), np.concatenate(normals).astype(np.float32)

    def point_mm(self, u_mm: float, v_mm: float, frame: float) -> NDArray[np.float64]:
        """World position [3] of the sheet's material point (u, v)."""
        rest = np.array([u_mm, v_mm, self.rest_depth_mm(np.array([u_mm]), np.array([v_mm]))[0]])
        return self.motion(rest, frame)

    def rest_depth_mm(self, u_mm: NDArray[np.float64], v_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """z of the sheet at rest; u and v of one shape."""
        return _look_up(self.rest_z_mm, self.half_extent_mm, u_mm, v_mm)

    def _grids(self, frame: float) -> list[NDArray[np.float64]]:
        if not isinstance(self.motion, Cut):
            return [self.motion(patch.rest_mm, frame) for patch in self.patches]
        left, right, groove = self.patches
        lips = left.rest_mm[self.groove_rows, -1], right.rest_mm[self.groove_rows, 0]
        across = np.sin(np.linspace(-np.pi / 2, np.pi / 2, groove.rest_mm.shape[1]))
        return [
            self.motion.move(left.rest_mm, frame, left.side),
            self.motion.move(right.rest_mm, frame, right.side),
            self.motion.groove(*lips, frame, across),
        ]


def room_mm(settings: PhantomSettings) -> tuple[float, float]:
    """Half the extent (right, down) of the sheet for a fixed endoscope: the view, and a margin for motion and views."""
    pixel_mm = MEAN_DEPTH_MM / settings.intrinsics.fx
    half_u, half_v = (
        max(SHEET_PER_VIEW * pixel_mm * side / 2, MIN_HALF_MM) for side in (settings.width, settings.height)
    )
    return half_u, half_v


def make_surface(settings: PhantomSettings, rng: np.random.Generator) -> Surface:
    """The tissue's shape. The sheet reaches as far as the endoscope looks; its mesh and atlas follow the pixels."""
    pixel_mm = MEAN_DEPTH_MM / settings.intrinsics.fx
    farther = farther_mm(settings, DEPTH_RANGE_MM[1])
    half_u, half_v = (half + more for half, more in zip(room_mm(settings), farther, strict=True))
    rest_z_mm = _rest_depth((2 * half_v, 2 * half_u), rng)
    motion = make_motion(settings.motion, settings.period_frames)
    texel_mm = TEXEL_PX * pixel_mm
    sheet_shape = (int(2 * half_v / texel_mm) + 1, int(2 * half_u / texel_mm) + 1)
    step = float(np.clip(STEP_PX * pixel_mm, *STEP_MM))
    v = np.linspace(-half_v, half_v, 2 * int(half_v / step) + 1)
    groove_rows = slice(*np.searchsorted(v, (-CUT_HALF_LENGTH_MM - step, CUT_HALF_LENGTH_MM + step)))
    groove_shape = (0, 0)
    if isinstance(motion, Cut):
        groove_shape = (int(np.ptp(v[groove_rows]) / texel_mm) + 1, int(GROOVE_WIDTH_MM / texel_mm) + 1)
    atlas = Atlas(texel_mm, sheet_shape, groove_shape)
    sheet = _Sheet((half_u, half_v), rest_z_mm, sheet_shape)
    if not isinstance(motion, Cut):
        u = np.linspace(-half_u, half_u, 2 * int(half_u / step) + 1)
        patches: tuple[Patch, ...] = (sheet.patch(np.broadcast_to(u, (v.size, u.size)), v, 0.0),)
    else:
        patches = _cut_patches(sheet, v, step, groove_rows, atlas)
    return Surface((half_u, half_v), rest_z_mm, atlas, motion, patches, groove_rows)


@dataclass(frozen=True)
class _Sheet:
    half_extent_mm: tuple[float, float]
    rest_z_mm: Image32
    shape: tuple[int, int]

    def patch(self, u: NDArray[np.float64], v: NDArray[np.float64], side: float) -> Patch:
        """u [rows, columns], v [rows]."""
        v = np.broadcast_to(v[:, None], u.shape)
        z = _look_up(self.rest_z_mm, self.half_extent_mm, u, v)
        xy = [
            (place / (2 * half) + 0.5) * (count - 1)
            for place, half, count in zip((u, v), self.half_extent_mm, self.shape[::-1], strict=True)
        ]
        return Patch(np.stack([u, v, z], -1), np.stack(xy, -1).astype(np.float32), side)


def _cut_patches(
    sheet: _Sheet, v: NDArray[np.float64], step: float, groove_rows: slice, atlas: Atlas
) -> tuple[Patch, ...]:
    """The sheet left and right of the cut, and the groove between; adjoining lips share material points."""
    half_u = sheet.half_extent_mm[0]
    share = np.linspace(0, 1, int(half_u / step) + 1)
    line = CUT_SLANT * v[:, None]
    left = sheet.patch(-half_u + share * (line + half_u), v, -1.0)
    right = sheet.patch(line + share * (half_u - line), v, 1.0)
    lips = left.rest_mm[groove_rows, -1]
    rest = np.repeat(lips[:, None], GROOVE_COLUMNS, axis=1)
    rows, columns = atlas.groove_shape
    x, y = np.meshgrid(np.linspace(0, columns - 1, GROOVE_COLUMNS), np.linspace(0, rows - 1, lips.shape[0]))
    groove = Patch(rest, np.stack([x, y + atlas.groove_row], -1).astype(np.float32))
    return left, right, groove


def _rest_depth(extent_mm: tuple[float, float], rng: np.random.Generator) -> Image32:
    """z [rows, columns] of the sheet at rest: loops with creases between, lobes on them, fine relief, a tilt."""
    shape = (int(extent_mm[0] / STEP_MM[0]) + 1, int(extent_mm[1] / STEP_MM[0]) + 1)
    y = np.linspace(-0.5, 0.5, shape[0])[:, None] * extent_mm[0]
    x = np.linspace(-0.5, 0.5, shape[1])[None, :] * extent_mm[1]
    towards = np.zeros(shape, dtype=np.float32)
    for wavelength, height, crease in LOOPS_MM:
        towards += height * np.minimum(lobed(smooth_field(rng, extent_mm, wavelength, shape), crease), 2.0)
    wavelength, height = RELIEF_MM
    towards += height * smooth_field(rng, extent_mm, wavelength, shape)
    z = MEAN_DEPTH_MM + TILT_MM_PER_MM[0] * x + TILT_MM_PER_MM[1] * y - (towards - towards.mean())
    middle, half = sum(DEPTH_RANGE_MM) / 2, float(np.ptp(DEPTH_RANGE_MM)) / 2
    return np.asarray(middle + half * np.tanh((z - middle) / half), dtype=np.float32)


def _look_up(
    image: Image32, half_extent_mm: tuple[float, float], u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    rows, columns = image.shape
    x = (u / (2 * half_extent_mm[0]) + 0.5) * (columns - 1)
    y = (v / (2 * half_extent_mm[1]) + 0.5) * (rows - 1)
    return np.asarray(map_coordinates(image.astype(np.float64), [y, x], order=1, mode="nearest"), dtype=np.float64)
