"""The tissue's surface at one moment as a coloured mesh, fused from the depth of several views.

The depths of the endoscope's view and of four around it are fused into a truncated signed distance (Curless and Levoy,
A volumetric method for building complex models from range images, SIGGRAPH 1996). scikit-image meshes its zero level.

Symbols: X Y Z voxels, H W pixels, V vertices, F faces.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from intrasplat.camera import Intrinsics, unproject
from intrasplat.errors import InputError
from intrasplat.export.target import ExportTarget
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.render import render_frame

SIDE_DEG = 8.0
"""Angle between the endoscope's view and those around it, about the middle of what it sees."""
MAX_VOXELS = 4_000_000
MIN_VOXEL_PX = 1.5
"""Smallest side of a voxel, in pixels at the median depth."""
TRUNCATION = 4.0
"""Truncation distance: so many voxels in front of a surface and behind it."""
MAX_STEP = 0.03
"""A pixel is an edge, and belongs to no surface, if its neighbours' depths differ by more than this share."""
STRAYS = 0.5
"""Percentage of outliers: points that may lie outside the volume, at each side."""
MIN_PIECE = 0.01
"""Connected pieces with a smaller share of the faces are removed."""
SLAB_VOXELS = 500_000

Points = NDArray[np.float32]


@dataclass(frozen=True)
class Mesh:
    """vertices [V, 3] mm in the world, colour [V, 3] in [0, 1], faces [F, 3] counter-clockwise from outside."""

    vertices_mm: Points
    colour: Points
    faces: NDArray[np.uint32]


@dataclass(frozen=True)
class _SurfaceView:
    """depth_mm [H, W], 0 where it is not used; rgb [H, W, 3] uint8."""

    depth_mm: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    pose: NDArray[np.float64]
    camera: Intrinsics

    def points_mm(self) -> NDArray[np.float64]:
        """[M, 3] points that the view sees, in the world."""
        pixels = np.flatnonzero(self.depth_mm)
        return unproject(pixels, self.depth_mm.ravel()[pixels], self.camera, self.pose)


def surface(target: ExportTarget) -> Generator[bytes, None, Mesh]:
    """Return the mesh at the target's moment; yield b"" now and then meanwhile.

    Raises:
        InputError: the views show nothing solid.
    """
    from skimage.measure import marching_cubes

    views = []
    for view in _views(target):
        views.append(view)
        yield b""
    points_mm = np.concatenate([view.points_mm() for view in views])
    volume = yield from _fused(views, points_mm)
    observed = volume.weight > 0
    if not (observed.any() and volume.distance[observed].min() < 0 < volume.distance[observed].max()):
        raise _nothing()
    yield b""
    vertices, faces, _, _ = marching_cubes(volume.distance, 0.0, mask=_whole_cubes(observed))
    if not len(faces):
        raise _nothing()
    yield b""
    vertices, faces = _large_pieces(vertices.astype(np.float32), faces.astype(np.uint32))
    weight = np.maximum(map_coordinates(volume.weight, vertices.T, order=1), 1e-6)
    channels = [map_coordinates(each, vertices.T, order=1) / weight for each in volume.colour]
    colour = np.clip(np.stack(channels, axis=1) / 255, 0, 1).astype(np.float32)
    return Mesh((vertices * volume.voxel_mm + volume.first_mm).astype(np.float32), colour, faces)


def _views(target: ExportTarget) -> Iterator[_SurfaceView]:
    """The endoscope's own view at the target's moment, and four around it."""
    scene, t = target.scene, target.t
    own = endoscope_pose(scene, t)
    pivot_mm = 0.0
    for yaw_deg, pitch_deg in ((0, 0), (SIDE_DEG, 0), (-SIDE_DEG, 0), (0, SIDE_DEG), (0, -SIDE_DEG)):
        around = OrbitPose(yaw_deg=yaw_deg, pitch_deg=pitch_deg, zoom=1)
        pose = own @ np.array(world_from_camera(around, pivot_mm))
        frame = render_frame(scene, t, pose, device=target.device, detail="off")
        depth_mm = np.where(frame.unseen | _edges(frame.depth_mm), np.float32(0), frame.depth_mm)
        if pivot_mm == 0.0:
            if not depth_mm.any():
                raise _nothing()
            pivot_mm = float(np.median(depth_mm[depth_mm > 0]))
        yield _SurfaceView(depth_mm, frame.rgb, pose, scene.intrinsics)


def _nothing() -> InputError:
    return InputError("t", "Nothing solid is seen at this time, so there is no surface.", "Choose another time.")


def _edges(depth_mm: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[H, W] whether depth jumps."""
    square = np.ones((3, 3), np.uint8)
    far, near = cv2.dilate(depth_mm, square), cv2.erode(depth_mm, square)
    return np.asarray(far - near > MAX_STEP * far, np.bool_)


@dataclass(frozen=True)
class _Volume:
    """distance [X, Y, Z] in -1..1, weight [X, Y, Z], colour [3, X, Y, Z] times weight; first_mm: voxel (0, 0, 0)."""

    distance: NDArray[np.float32]
    weight: NDArray[np.float32]
    colour: NDArray[np.float32]
    first_mm: NDArray[np.float64]
    voxel_mm: float


def _fused(views: list[_SurfaceView], points_mm: NDArray[np.float64]) -> Generator[bytes, None, _Volume]:
    """Fuse all views into one volume around the points."""
    first_mm, last_mm = np.percentile(points_mm, (STRAYS, 100 - STRAYS), axis=0)
    own = views[0]
    pixel_mm = float(np.median(own.depth_mm[own.depth_mm > 0])) / own.camera.fx
    voxel_mm = max(MIN_VOXEL_PX * pixel_mm, float(np.prod(last_mm - first_mm + 1e-3) / MAX_VOXELS) ** (1 / 3))
    first_mm = first_mm - 2 * TRUNCATION * voxel_mm
    size = tuple(int(n) for n in np.ceil((last_mm - first_mm) / voxel_mm + 2 * TRUNCATION))
    distance, weight = np.zeros(size, np.float32), np.zeros(size, np.float32)
    colour = np.zeros((3, *size), np.float32)
    thick = max(1, SLAB_VOXELS // (size[1] * size[2]))
    for low in range(0, size[0], thick):
        slab = slice(low, min(low + thick, size[0]))
        axes = [np.arange(slab.start, slab.stop), np.arange(size[1]), np.arange(size[2])]
        at_mm = [(first_mm[axis] + voxel_mm * steps).astype(np.float32) for axis, steps in enumerate(axes)]
        for view in views:
            _fuse(view, at_mm, TRUNCATION * voxel_mm, distance[slab], weight[slab], colour[:, slab])
        yield b""
    distance /= np.maximum(weight, 1)
    return _Volume(distance, weight, colour, first_mm, voxel_mm)


def _fuse(
    view: _SurfaceView,
    at_mm: list[NDArray[np.float32]],
    truncation_mm: float,
    distance: NDArray[np.float32],
    weight: NDArray[np.float32],
    colour: NDArray[np.float32],
) -> None:
    """Add a view to the sums of distance, weight and colour of the voxels with the coordinates [X], [Y], [Z]."""
    camera, own = view.camera, np.linalg.inv(view.pose).astype(np.float32)
    x, y, z = at_mm[0][:, None, None], at_mm[1][None, :, None], at_mm[2][None, None, :]
    right, down, ahead = (own[row, 0] * x + own[row, 1] * y + own[row, 2] * z + own[row, 3] for row in range(3))
    safe = np.maximum(ahead, np.float32(1e-3))
    column = np.floor(np.float32(camera.fx) * right / safe + np.float32(camera.cx)).astype(np.int32)
    row = np.floor(np.float32(camera.fy) * down / safe + np.float32(camera.cy)).astype(np.int32)
    inside = (ahead > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixel = np.where(inside, row * camera.width + column, 0)
    depth_mm = view.depth_mm.ravel()[pixel]
    before_mm = depth_mm - ahead
    observed = inside & (depth_mm > 0) & (before_mm > -truncation_mm)
    share = np.minimum(before_mm / np.float32(truncation_mm), np.float32(1))
    distance += np.where(observed, share, np.float32(0))
    weight += observed
    for channel in range(3):
        colour[channel] += np.where(observed, view.rgb[..., channel].ravel()[pixel], np.uint8(0))


def _whole_cubes(observed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[X, Y, Z] whether all corners of the cube that ends at a voxel are known: scikit-image reads the last corner."""
    whole = observed.copy()
    for axis in range(3):
        first, rest = (np.moveaxis(whole, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        rest &= first.copy()
        np.moveaxis(whole, axis, 0)[0] = False
    return whole


def _large_pieces(vertices: Points, faces: NDArray[np.uint32]) -> tuple[Points, NDArray[np.uint32]]:
    """The mesh without pieces that have less than MIN_PIECE of the faces."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    links = coo_array((np.ones(len(ends), np.bool_), ends.T), shape=(len(vertices), len(vertices)))
    piece = connected_components(links, directed=False)[1][faces[:, 0]]
    large = np.bincount(piece) >= MIN_PIECE * len(faces)
    kept, renumbered = np.unique(faces[large[piece]], return_inverse=True)
    return vertices[kept], renumbered.reshape(-1, 3).astype(np.uint32)
