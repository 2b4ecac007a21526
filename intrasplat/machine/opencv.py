"""OpenCV on one thread of its own, while this program's threads call it side by side; and without its remarks."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

STDERR = 2
"""Its file descriptor, to which libraries write."""


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Within it OpenCV does not split its loops; the former setting, which is the whole process's, comes back after.

    How OpenCV splits a loop depends on which of its threads are free. With callers side by side that is a matter of
    chance, and now and then a few pixels of depth came out otherwise: a stopped run did not find its input again.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Within it the process has no stderr: OpenCV remarks on every WebM it writes that VP9 has no tag there, and that
    cannot be turned off otherwise. For commands with one thread, around calls whose failure is told by other means.
    """
    sys.stderr.flush()
    kept = os.dup(STDERR)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), STDERR)
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
