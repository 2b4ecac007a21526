"""Returns freed memory to the system, if the C library is glibc."""

from __future__ import annotations

import ctypes
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt."""
USUAL_BYTES, LITTLE_BYTES = 64 << 20, 16 << 20
"""The first is what glibc finally keeps by itself. A small value slows code that allocates much, such as stereo."""


def keep_free_memory(most_bytes: int) -> None:
    """Return free memory to the system; from now on glibc keeps at most most_bytes at the end of each heap.

    Each thread that has allocated has a heap. An array of half that size lies outside heaps and is returned when freed.
    """
    libc = _glibc()
    if libc is not None:
        libc.mallopt(M_TRIM_THRESHOLD, most_bytes)
        libc.mallopt(M_MMAP_THRESHOLD, most_bytes // 2)
        libc.malloc_trim(0)


@cache
def _glibc() -> ctypes.CDLL | None:
    """The C library, if it has glibc's malloc_trim."""
    libc = ctypes.CDLL(None)
    return libc if hasattr(libc, "malloc_trim") else None
