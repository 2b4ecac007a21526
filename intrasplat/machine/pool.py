"""Threads that share work which releases the GIL."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from intrasplat.machine.cores import cores


@contextmanager
def thread_a_core(name: str) -> Iterator[ThreadPoolExecutor]:
    """A pool of a thread per core, which ends with the context. An exception cancels the jobs that have not begun."""
    pool = ThreadPoolExecutor(cores(), thread_name_prefix=name)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
