"""Memory that has been freed goes back to the system, as far as the C library is glibc."""

from __future__ import annotations

import ctypes
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Of glibc's mallopt."""
USUAL_BYTES, LITTLE_BYTES = 64 << 20, 16 << 20
"""The first is as much as glibc comes to keep by itself. Keeping little slows what allocates much, as stereo does."""


def keep_free_memory(most_bytes: int) -> None:
    """Return free memory to the system; from here on glibc keeps at most so much for later at the end of each heap.

    Each thread that has allocated has a heap. An array of half as much lies in none, and is returned when it is freed.
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
