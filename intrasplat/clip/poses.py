"""`poses_bounds.npy`: camera poses of the EndoNeRF layout.

Symbols: T frames; a row of the file holds a 3x5 matrix [rotation | translation | (H, W, f)] row by row, then two depth
bounds.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import InputError
from intrasplat.names import POSES_FILE, PoseConvention

RIGID_TOLERANCE = 1e-3  # on the entries of R^T R: float32 files and rounding pass, scaled or sheared matrices do not
_ROW_LENGTH = 17
_REMEDY = "Write it as [T, 17] floating-point numbers, 3x5 [R | t | (H, W, f)] and two bounds per row."

# Columns of the stored rotation that are OpenCV's x (right), y (down), z (forward), and their signs.
_OPENCV_COLUMNS: dict[str, tuple[list[int], list[float]]] = {
    "opengl": ([0, 1, 2], [1.0, -1.0, -1.0]),  # stored: right, up, back
    "llff": ([1, 0, 2], [1.0, 1.0, -1.0]),  # stored: down, right, back
}


@dataclass(frozen=True)
class Poses:
    """world_from_camera [T, 4, 4] float64 mm, OpenCV axes, world = camera of frame 0; size and focal in pixels.

    first_pose [4, 4]: frame 0 in the file's world.
    """

    world_from_camera: NDArray[np.float64]
    first_pose: NDArray[np.float64]
    height: int
    width: int
    focal_px: float


def parse_poses(data: bytes, frame_count: int, convention: PoseConvention) -> Poses:
    """The poses in a file, converted. InputError if shape, count, numbers, rotations or sizes are wrong."""
    rows = _load(data)
    if len(rows) != frame_count:
        raise _error(f"has {len(rows)} poses for {frame_count} images.", "Give one pose for each image.")
    if not np.isfinite(rows).all():
        frame = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise _error(f"holds NaN or infinity in frame {frame}.", "Write finite poses.")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    height, width, focal_px = _common_size(matrices[:, :, 4])
    columns, signs = _OPENCV_COLUMNS[convention]
    world_from_camera = np.tile(np.eye(4), (frame_count, 1, 1))
    world_from_camera[:, :3, :3] = _nearest_rotations(matrices[:, :, columns] * signs)
    world_from_camera[:, :3, 3] = matrices[:, :, 3]
    return Poses(_relative_to_first(world_from_camera), world_from_camera[0], height, width, focal_px)


def _load(data: bytes) -> NDArray[np.float64]:
    """The array [T, 17]. Its header is checked before allocation, and pickled objects are refused."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"format version {version}")
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
        if dtype.hasobject or dtype.kind not in "fiu":
            raise ValueError(f"values of type {dtype}")
        if len(shape) != 2 or shape[1] != _ROW_LENGTH or shape[0] < 1:
            raise _error(f"has shape {list(shape)}, not [T, {_ROW_LENGTH}].", _REMEDY)
        if len(data) - stream.tell() != shape[0] * shape[1] * dtype.itemsize:
            raise ValueError("content and header differ in size")
        stream.seek(0)
        return np.asarray(np.load(stream, allow_pickle=False), dtype=np.float64)
    except (ValueError, EOFError, OSError) as error:
        raise _error(f"is not a readable array ({error}).", _REMEDY) from error


def _common_size(sizes: NDArray[np.float64]) -> tuple[int, int, float]:
    if not np.allclose(sizes, sizes[0], rtol=1e-6):
        frame = int(np.flatnonzero(~np.isclose(sizes, sizes[0], rtol=1e-6).all(axis=1))[0])
        raise _error(f"changes (H, W, f) in frame {frame}.", "Give a clip of one size without zoom.")
    height, width, focal_px = (float(value) for value in sizes[0])
    if height != round(height) or width != round(width) or min(height, width) < 1 or focal_px <= 0:
        raise _error(
            f"says (H, W, f) = ({height:g}, {width:g}, {focal_px:g}).",
            "Write the image size and focal length in pixels.",
        )
    return int(height), int(width), focal_px


def _nearest_rotations(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations nearest to nearly orthogonal matrices (polar factor); InputError for other matrices."""
    gram = np.swapaxes(matrices, 1, 2) @ matrices
    skewed = np.abs(gram - np.eye(3)).max(axis=(1, 2)) > RIGID_TOLERANCE
    mirrored = np.linalg.det(matrices) < 0
    if (skewed | mirrored).any():
        frame = int(np.flatnonzero(skewed | mirrored)[0])
        problem = "is mirrored" if mirrored[frame] and not skewed[frame] else "is not a rotation (scaled or sheared)"
        raise _error(f"is not rigid: the 3x3 part of frame {frame} {problem}.", "Write rigid camera-to-world poses.")
    u, _, vt = np.linalg.svd(matrices)
    return np.asarray(u @ vt)


def _relative_to_first(world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same cameras in the world of frame 0's camera (multiplied from the left by its rigid inverse)."""
    first = world_from_camera[0]
    first_from_world = np.eye(4)
    first_from_world[:3, :3] = first[:3, :3].T
    first_from_world[:3, 3] = -first[:3, :3].T @ first[:3, 3]
    relative = first_from_world @ world_from_camera
    relative[0] = np.eye(4)
    return np.asarray(relative)


def _error(problem: str, remedy: str) -> InputError:
    return InputError("clip", f"{POSES_FILE} {problem}", remedy)
