"""The processors of this machine."""

from __future__ import annotations

import os


def cores() -> int:
    """The number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def keep_libraries_to_one_thread() -> None:
    """Make OpenBLAS and OpenMP compute on the calling thread alone, unless the environment sets their threads.

    Call it before NumPy is imported. Our own threads use every core. Threads of the libraries would spin while they
    wait for each other, and slow the kernels.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
