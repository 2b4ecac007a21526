"""Large arrays mapped from unnamed files: the system caches as much of them as fits into memory.

A process's resident memory includes the pages of such an array that it has touched, until let_go(). The pages then
remain in the system's page cache, which shrinks when memory is needed.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from intrasplat.files.disk_errors import DISK_FULL_ERRNOS, StoreFullError

AROUND_BYTES = 1 << 16
"""Linux maps this much around an accessed page, so pages beside an array are released with it."""


def mapped_zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """An array of zeros in a file in tempfile.gettempdir(), which is deleted with the last view of the array.

    Raises:
        StoreFullError: the disk is full.
    """
    needed_bytes = max(int(np.prod(shape)) * np.dtype(dtype).itemsize, 1)
    with tempfile.TemporaryFile(prefix="intrasplat-") as file:
        try:
            if hasattr(os, "posix_fallocate"):  # reserve: else a full disk would kill the process (SIGBUS) on writing
                os.posix_fallocate(file.fileno(), 0, needed_bytes)
            else:
                file.truncate(needed_bytes)
        except OSError as error:
            if error.errno not in DISK_FULL_ERRNOS:
                raise
            problem = f"The disk is full: {needed_bytes >> 20} MiB are needed for a clip's frames."
            raise StoreFullError(problem, f"Free space in {tempfile.gettempdir()}.") from error
        return np.asarray(np.memmap(file, dtype, "r+", shape=shape))


def let_go(array: NDArray[Any]) -> None:
    """Release the pages of a contiguous mapped array from this process's memory. Access reads them back.

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
