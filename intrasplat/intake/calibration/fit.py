"""Fits a calibration to a clip: scales it to the size of the eyes, or refuses it."""

from __future__ import annotations

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.types import RectifiedCalibration, StereoCalibration

MAX_ASPECT_CHANGE = 0.005  # 1348x1080 read as 640x512 is still one scale; a cropped image is not
MAX_SCALE = 8.0
"""4K reduced to 480 columns; a calibration that needs a larger scale, either way, belongs to another recording."""


def fitted(calibration: StereoCalibration, eye_width: int, eye_height: int) -> StereoCalibration:
    """The calibration at the size of the clip's eyes; `scaled_from` has its own size if that differs.

    Raises:
        InputError: its aspect differs, which would mean an unknown crop, or its size is far from the clip's.
    """
    if (calibration.width, calibration.height) == (eye_width, eye_height):
        return calibration
    sx, sy = eye_width / calibration.width, eye_height / calibration.height
    if abs(sx / sy - 1) > MAX_ASPECT_CHANGE:
        raise InputError(
            FIELD,
            f"it is for {calibration.width}x{calibration.height} pixels an eye, the clip has {eye_width}x{eye_height}: "
            "not one uniform scale.",
            "Give the calibration of these frames, one eye's width and height, or the frames uncropped.",
        )
    if not 1 / MAX_SCALE <= sx <= MAX_SCALE:
        raise InputError(
            FIELD,
            f"it is for {calibration.width}x{calibration.height} pixels an eye, the clip has {eye_width}x{eye_height}: "
            f"more than {MAX_SCALE:g} times apart.",
            "Give the calibration of these frames; check its width and height.",
        )
    resized = calibration.resized(eye_width, eye_height)
    return resized.model_copy(update={"scaled_from": (calibration.width, calibration.height)})


def check_centred(calibration: StereoCalibration) -> None:
    """Check a calibration whose file gives no size: both principal points must lie near the middle of these eyes.

    Raises:
        InputError: one does not.
    """
    if isinstance(calibration, RectifiedCalibration):
        return
    for name, eye in (("left", calibration.left), ("right", calibration.right)):
        if not (0.25 <= eye.cx_px / calibration.width <= 0.75 and 0.25 <= eye.cy_px / calibration.height <= 0.75):
            raise InputError(
                FIELD,
                f"it names no image size, and the {name} principal point ({eye.cx_px:.0f}, {eye.cy_px:.0f}) is not in "
                f"the middle half of {calibration.width}x{calibration.height} pixels.",
                "Give the calibration of these frames, or add image_width and image_height to the file.",
            )
