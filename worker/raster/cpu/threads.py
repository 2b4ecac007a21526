"""Run a kernel on every core. Kernels hold no GIL and take (thread, threads, ...) as their first arguments.

Plain threads instead of Numba's ``prange``: half the compilation time, no shared threading layer (a render may run
beside training), and a fixed share for each thread, so that the same machine gives the same bits.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

THREADS = int(os.environ.get("INTRASPLAT_THREADS", 0)) or len(os.sched_getaffinity(0))
"""Threads a kernel is split over: the cores this process may use, or INTRASPLAT_THREADS."""


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=max(1, THREADS - 1), thread_name_prefix="raster")


def run(kernel: Callable[..., object], *args: object) -> None:
    """Call kernel(thread, THREADS, *args) once a thread and wait for all; an error in any is raised here."""
    others = [_pool().submit(kernel, thread, THREADS, *args) for thread in range(1, THREADS)]
    kernel(0, THREADS, *args)
    for other in others:
        other.result()
