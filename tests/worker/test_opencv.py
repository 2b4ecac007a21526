"""OpenCV keeps to one thread while ours call it, so that the same pair gives the same depth bit for bit."""

from __future__ import annotations

import cv2
import pytest

from worker.opencv import one_opencv_thread


def test_opencv_is_alone_inside_and_as_before_outside() -> None:
    before = cv2.getNumThreads()
    with one_opencv_thread():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == before


def test_the_setting_comes_back_after_an_error() -> None:
    before = cv2.getNumThreads()
    with pytest.raises(RuntimeError, match="inside"), one_opencv_thread():
        raise RuntimeError("inside")
    assert cv2.getNumThreads() == before
