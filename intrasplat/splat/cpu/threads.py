"""Run a kernel on every core. Kernels release the GIL and take (thread, threads, ...) as their first arguments.

Plain threads instead of Numba's ``prange``: half the compilation time, no shared threading layer (a render may run
beside training), and a fixed share for each thread, so that results on one machine are bit-identical.

Several threads may call run() at once and share one pool. They cannot deadlock, because a kernel never starts a kernel.
Each caller computes its own first share.
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

from intrasplat.errors import InputError
from intrasplat.machine.cores import cores
from intrasplat.machine.parts import Parts

THREADS_VARIABLE = "INTRASPLAT_THREADS"

WAKE_S = 0.002
"""Longest part of beside(): work that arrives meanwhile waits at most so long."""

T = TypeVar("T")

_own = threading.local()
"""Per calling thread: elsewhere_s, the CPU seconds that its kernels used on other threads; is_alone, see alone()."""


@cache
def thread_count() -> int:
    """Threads a kernel is split over, for the whole life of this process: INTRASPLAT_THREADS, or the cores it may use.

    Raises:
        InputError: INTRASPLAT_THREADS is set to anything but a whole number above 0.
    """
    given = os.environ.get(THREADS_VARIABLE)
    if not given:
        return cores()
    if not given.isdecimal() or int(given) == 0:
        remedy = "Set it to a whole number above 0, or leave it unset to use every core."
        raise InputError(THREADS_VARIABLE, f"{given!r} is no number of threads.", remedy)
    return int(given)


@cache
def _pool(process_id: int) -> ThreadPoolExecutor:
    del process_id  # the key of the cache: a forked process inherits the pool without its threads, so needs its own
    return ThreadPoolExecutor(max_workers=max(1, thread_count() - 1), thread_name_prefix="raster")


@cache
def _beside(process_id: int) -> ThreadPoolExecutor:
    del process_id  # as in _pool
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="beside")


def run(kernel: Callable[..., object], *args: object) -> None:
    """Call kernel(thread, threads, *args) for each share and wait for all; an error in any of them is raised here.

    Each share runs on a thread of its own, or within alone() all on this one.
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
    """The kernel with subnormal numbers flushed to 0, on any thread.

    Decaying moments of Adam become subnormal, and an Intel core takes a hundred cycles and more for each.
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
    """Within the with statement this thread's kernels use no other thread; results are bit-identical.

    Otherwise shares of a render in the pool would delay those of a training step.
    """
    before, _own.is_alone = getattr(_own, "is_alone", False), is_alone
    try:
        yield
    finally:
        _own.is_alone = before


def beside(work: Callable[[], T]) -> Parts[T]:
    """The result of work(), which runs on another thread while this one waits in parts of WAKE_S.

    Its CPU seconds count as this thread's. If the parts are closed, the work still runs to its end.
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
    """CPU seconds that this thread, and its kernels on other threads, have used so far."""
    return time.thread_time() + float(getattr(_own, "elsewhere_s", 0.0))


def _timed(kernel: Callable[..., object], *args: object) -> float:
    """Call the kernel; return its CPU seconds."""
    start_s = time.thread_time()
    kernel(*args)
    return time.thread_time() - start_s
