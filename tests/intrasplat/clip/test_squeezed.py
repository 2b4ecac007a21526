"""Eyes that are squeezed to half their width or height, with the calibration of the whole or of the squeezed eye."""

from __future__ import annotations

import numpy as np
import pytest

from intrasplat.clip import StereoClip
from intrasplat.clip.calibration import rectify
from intrasplat.errors import InputError
from intrasplat.intake.calibration.fit import fitted
from intrasplat.intake.calibration.types import RawCalibration, RawEye, RectifiedCalibration

WHOLE = RectifiedCalibration(
    model="rectified", width=320, height=256, fx_px=284.8, fy_px=284.8, cx_px=160, cy_px=128, baseline_mm=4.3
)
TURN = np.deg2rad(1.5)
EYE = RawEye(fx_px=284.8, fy_px=284.8, cx_px=159.5, cy_px=127.5, distortion=(0.05, -0.02, 0.001, 0.0, 0.0))
RAW = RawCalibration(
    model="raw",
    width=320,
    height=256,
    left=EYE,
    right=EYE,
    right_from_left_rotation=((np.cos(TURN), 0, np.sin(TURN)), (0, 1, 0), (-np.sin(TURN), 0, np.cos(TURN))),
    right_from_left_translation_mm=(-4.3, 0.05, 0.02),
)


@pytest.mark.parametrize(("width", "height"), [(160, 256), (80, 128), (320, 128)])
def test_a_calibration_of_the_whole_eye_fits_a_half_without_a_word_of_the_video(width: int, height: int) -> None:
    scaled = fitted(WHOLE, width, height)
    assert (scaled.width, scaled.height, scaled.scaled_from) == (width, height, (320, 256))
    assert isinstance(scaled, RectifiedCalibration)
    assert scaled.fx_px / width == pytest.approx(WHOLE.fx_px / 320)
    assert scaled.fy_px / height == pytest.approx(WHOLE.fy_px / 256)


def test_other_pixels_are_believed_if_the_video_names_them() -> None:
    assert fitted(WHOLE, 220, 256, pixel_aspect=16 / 11).scaled_from == (320, 256)
    with pytest.raises(InputError, match="not one uniform scale"):
        fitted(WHOLE, 220, 256)
    with pytest.raises(InputError, match="not one uniform scale"):
        fitted(WHOLE, 220, 256, pixel_aspect=2.0)


def test_a_size_of_both_eyes_is_no_squeeze() -> None:
    with pytest.raises(InputError, match="not one uniform scale"):
        fitted(WHOLE.model_copy(update={"width": 640}), 320, 256)


def test_a_calibration_of_the_squeezed_eye_is_used_as_it_is() -> None:
    squeezed = WHOLE.resized(160, 256)
    assert fitted(squeezed, 160, 256, pixel_aspect=2.0) == squeezed


@pytest.mark.parametrize(("width", "height"), [(160, 256), (320, 128)])
def test_squeezed_eyes_are_rectified_as_whole_ones_and_keep_their_view(width: int, height: int) -> None:
    def rectified(calibration: RawCalibration):
        shape = calibration.height, calibration.width
        frame = np.zeros((*shape, 3), np.uint8)
        return rectify(StereoClip(1, *shape, lambda: iter([(frame, frame)]), None, np.zeros(1)), calibration)

    whole, squeezed = rectified(RAW), rectified(RAW.resized(width, height))
    sx, sy = width / 320, height / 256
    assert squeezed.intrinsics.fx == pytest.approx(whole.intrinsics.fx * sx, rel=1e-3)
    assert squeezed.intrinsics.fy == pytest.approx(whole.intrinsics.fy * sy, rel=1e-3)
    assert squeezed.intrinsics.cx == pytest.approx(whole.intrinsics.cx * sx, abs=0.05)
    assert squeezed.intrinsics.cy == pytest.approx(whole.intrinsics.cy * sy, abs=0.05)
    assert squeezed.baseline_mm == pytest.approx(whole.baseline_mm)
    assert squeezed.disparity_offset_px == pytest.approx(whole.disparity_offset_px * sx, abs=0.05)
    assert squeezed.warnings == whole.warnings  # neither is magnified
