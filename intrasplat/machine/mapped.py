"""Large arrays in files without a name, mapped: the system keeps as much of them in memory as it has room for.

A process's resident memory counts the pages of such an array that it has touched, until it lets go of them. They stay
in the system's page cache, which gives way to whatever needs the memory.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from intrasplat.files.disk_errors import NO_ROOM, StoreFullError

AROUND_BYTES = 1 << 16
"""Linux maps so much around what is asked for: what lies beside an array is let go with it."""


def mapped_zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Zeros in a file in tempfile.gettempdir(), which is gone with the last array that views it.

    Raises:
        StoreFullError: the disk is full.
    """
    needed_bytes = max(int(np.prod(shape)) * np.dtype(dtype).itemsize, 1)
    with tempfile.TemporaryFile(prefix="intrasplat-") as file:
        try:
            if hasattr(os, "posix_fallocate"):  # else a full disk would end the process when it writes
                os.posix_fallocate(file.fileno(), 0, needed_bytes)
            else:
                file.truncate(needed_bytes)
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise
            problem = f"The disk is full: {needed_bytes >> 20} MiB of a clip's frames found no room."
            raise StoreFullError(problem, f"Make room in {tempfile.gettempdir()}.") from error
        return np.asarray(np.memmap(file, dtype, "r+", shape=shape))


def let_go(array: NDArray[Any]) -> None:
    """Take what a contiguous array views of a file out of this process's memory. It comes back when it is asked for.

    Does nothing to an array that is not mapped for writing, as those of mapped_zeros are.
    """
    base: Any = array
    while base is not None and not isinstance(base, np.memmap):
        base = getattr(base, "base", None)
    pages: Any = getattr(base, "_mmap", None)
    if not isinstance(base, np.memmap) or base.mode != "r+" or not hasattr(pages, "madvise"):
        return
    start = array.ctypes.data - base.ctypes.data
    first, end = start // AROUND_BYTES * AROUND_BYTES, -(-(start + array.nbytes) // AROUND_BYTES) * AROUND_BYTES
    pages.madvise(mmap.MADV_DONTNEED, first, min(end, base.nbytes) - first)
