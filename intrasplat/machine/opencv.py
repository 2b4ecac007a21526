"""Limits OpenCV to one thread, while this program's threads call it in parallel; and silences its messages."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

STDERR = 2
"""File descriptor of stderr, to which libraries write."""


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Context manager in which OpenCV does not split its loops; afterwards the process-wide setting is restored.

    OpenCV splits a loop by its number of free threads, which is random with parallel callers. A few pixels of depth
    then differed at times, and a stopped run did not find its input again.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Context manager without stderr: nothing else silences OpenCV's message, on every WebM it writes, that VP9 has no
    tag there. For commands with one thread, around calls whose failure is detected by other means.
    """
    sys.stderr.flush()
    saved = os.dup(STDERR)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), STDERR)
        yield
    finally:
        os.dup2(saved, STDERR)
        os.close(saved)
