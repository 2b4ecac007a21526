"""OpenCV on one thread of its own, while this program's threads call it side by side."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2


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
