"""Run a kernel on every core. Kernels hold no GIL and take (thread, threads, ...) as their first arguments.

Plain threads instead of Numba's ``prange``: half the compilation time, no shared threading layer (a render may run
beside training), and a fixed share for each thread, so that the same machine gives the same bits.

Callers may come from several threads at once: all share one pool, and none waits for another, because a kernel never
starts a kernel; each caller works on its own first share meanwhile.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

import torch

from contract.wire.errors import InputError
from worker.machine.parts import Parts

THREADS_VARIABLE = "INTRASPLAT_THREADS"

WAKE_S = 0.002
"""A part of beside(): what comes meanwhile waits no longer."""

T = TypeVar("T")

_own = threading.local()
"""Of each calling thread: elsewhere_s, CPU seconds that its kernels used on other threads; is_alone."""


def _available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def thread_count() -> int:
    """Threads a kernel is split over, for the whole life of this process: INTRASPLAT_THREADS, or the cores it may use.

    Raises:
        InputError: INTRASPLAT_THREADS is set to anything but a whole number above 0.
    """
    given = os.environ.get(THREADS_VARIABLE)
    if not given:
        return _available_cores()
    if not given.isdecimal() or int(given) == 0:
        remedy = "Set it to a whole number above 0, or leave it unset to use every core."
        raise InputError(THREADS_VARIABLE, f"{given!r} is no number of threads.", remedy)
    return int(given)


@cache
def _pool(process_id: int) -> ThreadPoolExecutor:
    del process_id  # a forked process inherits the pool's object but none of its threads: it needs one of its own
    return ThreadPoolExecutor(max_workers=max(1, thread_count() - 1), thread_name_prefix="raster")


@cache
def _beside(process_id: int) -> ThreadPoolExecutor:
    del process_id  # as in _pool
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="beside")


def run(kernel: Callable[..., object], *args: object) -> None:
    """Call kernel(thread, threads, *args) for each share, each on a thread of its own unless alone(), and wait for all.

    An error in any is raised here.
    """
    threads = thread_count()
    if getattr(_own, "is_alone", False):
        for thread in range(threads):
            kernel(thread, threads, *args)
        return
    others = [_pool(os.getpid()).submit(_timed, kernel, thread, threads, *args) for thread in range(1, threads)]
    try:
        kernel(0, threads, *args)
    finally:
        wait(others)  # they write into the caller's arrays
    _own.elsewhere_s = getattr(_own, "elsewhere_s", 0.0) + sum(other.result() for other in others)


def flushing(kernel: Callable[..., object]) -> Callable[..., None]:
    """The kernel, in which subnormal numbers count as 0, on whatever thread it runs.

    Adam's moments fade through them, and a processor takes long over each (docs/decisions/080-subnormal-numbers.md).
    """

    def flushed(*args: object) -> None:
        torch.set_flush_denormal(True)
        try:
            kernel(*args)
        finally:
            torch.set_flush_denormal(False)

    return flushed


@contextmanager
def alone(*, is_alone: bool = True) -> Iterator[None]:
    """Kernels that this thread runs meanwhile use no other thread, and come to the same bits.

    Shares of a render in the pool would keep those of a training step waiting.
    """
    before, _own.is_alone = getattr(_own, "is_alone", False), is_alone
    try:
        yield
    finally:
        _own.is_alone = before


def beside(work: Callable[[], T]) -> Parts[T]:
    """What work() returns. Another thread does it, and this one waits for it, WAKE_S in each part.

    Its CPU seconds count as this thread's. If the parts are closed, the work ends by itself.
    """
    spent_s = 0.0

    def timed() -> T:
        nonlocal spent_s
        start_s = time.thread_time()
        try:
            return work()
        finally:
            spent_s = time.thread_time() - start_s

    done = _beside(os.getpid()).submit(timed)
    while not wait([done], WAKE_S).done:
        yield
    _own.elsewhere_s = getattr(_own, "elsewhere_s", 0.0) + spent_s
    return done.result()


def cpu_time_s() -> float:
    """CPU seconds that this thread has used so far, with what its kernels used on other threads."""
    return time.thread_time() + float(getattr(_own, "elsewhere_s", 0.0))


def _timed(kernel: Callable[..., object], *args: object) -> float:
    """Call the kernel; the CPU seconds that it took."""
    start_s = time.thread_time()
    kernel(*args)
    return time.thread_time() - start_s
