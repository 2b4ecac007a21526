"""OpenCV keeps to one thread while ours call it, so that the same pair gives the same depth bit for bit."""

from __future__ import annotations

import os

import cv2
import pytest

from intrasplat.machine.opencv import one_opencv_thread, silent_stderr


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


def test_what_a_library_remarks_is_not_heard_and_what_comes_later_is(capfd: pytest.CaptureFixture[str]) -> None:
    with silent_stderr():
        os.write(2, b"a remark\n")
    os.write(2, b"a warning\n")
    assert capfd.readouterr().err == "a warning\n"
