"""Run a kernel on every core. Kernels hold no GIL and take (thread, threads, ...) as their first arguments.

Plain threads instead of Numba's ``prange``: half the compilation time, no shared threading layer (a render may run
beside training), and a fixed share for each thread, so that the same machine gives the same bits.

Callers may come from several threads at once: all share one pool, and none waits for another, because a kernel never
starts a kernel; each caller works on its own first share meanwhile.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache


def _available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


THREADS = int(os.environ.get("INTRASPLAT_THREADS", 0)) or _available_cores()
"""Threads a kernel is split over: the cores this process may use, or INTRASPLAT_THREADS."""


@cache
def _pool(process_id: int) -> ThreadPoolExecutor:
    del process_id  # a forked process inherits the pool's object but none of its threads: it needs one of its own
    return ThreadPoolExecutor(max_workers=max(1, THREADS - 1), thread_name_prefix="raster")


def run(kernel: Callable[..., object], *args: object) -> None:
    """Call kernel(thread, THREADS, *args) once a thread and wait for all; an error in any is raised here."""
    others = [_pool(os.getpid()).submit(kernel, thread, THREADS, *args) for thread in range(1, THREADS)]
    try:
        kernel(0, THREADS, *args)
    finally:
        wait(others)  # they write into the caller's arrays
    for other in others:
        other.result()
