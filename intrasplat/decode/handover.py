"""Arrays from the decoding process, stored in its folder as bare bytes: without a header, none can be forged.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

import os
import stat
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

EYES = ("left", "right")
MASKS = ("tissue", "tissue_right")
"""Names of the arrays that a stereo clip may lack."""
FIELDS = ("field_of_view", "field_of_view_right")
"""Names of the fields of view that the caller gave: none, the left eye's, or both."""

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
    "field_of_view": np.uint8,
    "field_of_view_right": np.uint8,
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
    "field_of_view": lambda t, h, w: (h, w),
    "field_of_view_right": lambda t, h, w: (h, w),
}


def write_arrays(folder: Path, arrays: Iterable[tuple[str, NDArray[Any]]]) -> None:
    """Append each array to the file of its name. An array may arrive whole or frame by frame."""
    files: dict[str, Any] = {}
    try:
        for name, array in arrays:
            if name not in files:
                files[name] = (folder / name).open("xb")
            files[name].write(np.ascontiguousarray(array, dtype=_TYPES[name]).data)
            files[name].flush()  # before the iterator computes the next one
    finally:
        for file in files.values():
            file.close()


class ArrayFile:
    """Reads frames of an array from the file of a process that may still write it.

    Raises:
        ValueError: it is not a regular file.
        OSError: there is no such file.
    """

    def __init__(self, folder: Path, name: str, size: tuple[int, int, int]) -> None:
        """size: T, H, W of the clip."""
        self._name, self._shape, self._dtype = name, _SHAPES[name](*size), np.dtype(_TYPES[name])
        self._descriptor = _open(folder, name)
        weakref.finalize(self, os.close, self._descriptor)

    def frame(self, index: int) -> NDArray[Any]:
        """One frame's part of the array. ValueError if the file is too short."""
        return self._read(self._shape[1:], index)

    def whole(self) -> NDArray[Any]:
        """The whole array. ValueError if the file has another size."""
        if os.fstat(self._descriptor).st_size != int(np.prod(self._shape)) * self._dtype.itemsize:
            raise ValueError(f"{self._name} has another size than {self._shape}")
        return self._read(self._shape, 0)

    def _read(self, shape: tuple[int, ...], index: int) -> NDArray[Any]:
        values = np.empty(shape, self._dtype)
        left = values.reshape(-1).view(np.uint8).data
        place = index * len(left)
        while left:
            read = os.preadv(self._descriptor, [left], place)
            if not read:
                raise ValueError(f"{self._name} ends at byte {place}")
            left, place = left[read:], place + read
        return values


def map_array(folder: Path, name: str, size: tuple[int, int, int]) -> NDArray[Any]:
    """The array of that name in a clip of `size` (T, H, W), mapped into memory. Writing to it changes no file.

    Call it after the writing process has ended. The file may be removed at once; the mapping lives with the array.

    Raises:
        ValueError: it is not a regular file, or its size is not the array's.
        OSError: there is no such file.
    """
    shape, dtype = _SHAPES[name](*size), np.dtype(_TYPES[name])
    with open(_open(folder, name), "rb") as file:
        found_bytes, wanted_bytes = os.fstat(file.fileno()).st_size, int(np.prod(shape)) * dtype.itemsize
        if found_bytes != wanted_bytes:
            raise ValueError(f"{name} has {found_bytes} bytes, not {wanted_bytes}")
        return np.asarray(np.memmap(file, dtype=dtype, mode="c", shape=shape))


def _open(folder: Path, name: str) -> int:
    """A file descriptor of an array's file."""
    descriptor = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(f"{name} is not a regular file")
    return descriptor
