"""The arrays that the decoding process leaves in its folder, as bare bytes: without a header nothing can be forged.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

STEREO, DEPTH = "stereo", "depth"
MASKS = ("tissue", "tissue_right")
"""The arrays that a stereo clip may lack."""

_TYPES: dict[str, type[np.generic]] = {
    "left": np.uint8,
    "right": np.uint8,
    "rgb": np.uint8,
    "tissue": np.uint8,
    "tissue_right": np.uint8,
    "depth_mm": np.float32,
    "depth_confidence": np.uint8,
    "world_from_camera": np.float64,
    "frame_times_s": np.float64,
}
_SHAPES: dict[str, Callable[[int, int, int], tuple[int, ...]]] = {
    "left": lambda t, h, w: (t, h, w, 3),
    "right": lambda t, h, w: (t, h, w, 3),
    "rgb": lambda t, h, w: (t, h, w, 3),
    "tissue": lambda t, h, w: (t, h, w),
    "tissue_right": lambda t, h, w: (t, h, w),
    "depth_mm": lambda t, h, w: (t, h, w),
    "depth_confidence": lambda t, h, w: (t, h, w),
    "world_from_camera": lambda t, h, w: (t, 4, 4),
    "frame_times_s": lambda t, h, w: (t,),
}


def write_arrays(folder: Path, arrays: Iterable[tuple[str, NDArray[Any]]]) -> None:
    """Append each array to the file of its name. An array may come whole or frame by frame."""
    files: dict[str, Any] = {}
    try:
        for name, array in arrays:
            if name not in files:
                files[name] = (folder / name).open("xb")
            files[name].write(np.ascontiguousarray(array, dtype=_TYPES[name]).data)
    finally:
        for file in files.values():
            file.close()


def map_array(folder: Path, name: str, size: tuple[int, int, int]) -> NDArray[Any]:
    """The array of that name in a clip of `size` (T, H, W), mapped into memory. Writing to it changes no file.

    The file may be removed at once; the mapping lives as long as the array.

    Raises:
        ValueError: it is not a regular file, or its size is not the array's.
        OSError: there is no such file.
    """
    shape, dtype = _SHAPES[name](*size), np.dtype(_TYPES[name])
    descriptor = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with open(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        wanted_bytes = int(np.prod(shape)) * dtype.itemsize
        if not stat.S_ISREG(found.st_mode) or found.st_size != wanted_bytes:
            raise ValueError(f"{name} has {found.st_size} bytes, not {wanted_bytes}")
        return np.asarray(np.memmap(file, dtype=dtype, mode="c", shape=shape))
