"""Fits a calibration to a clip: scales it to the size of the eyes, or refuses it."""

from __future__ import annotations

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.types import RectifiedCalibration, StereoCalibration

MAX_ASPECT_CHANGE = 0.005  # 1348x1080 read as 640x512 is still one scale; a cropped image is not
HALVES = (0.5, 2.0)
"""Width over height by which half side-by-side and half top-bottom video squeeze an eye."""
MAX_PIXEL_SKEW = 0.1
"""Of fx / fy from 1: the pixels of a calibration of whole eyes are nearly square."""
CENTRED = 0.35, 0.65
"""Usual principal point of an eye, in widths and heights; in a size of both eyes it would lie at 0.25."""
MAX_SCALE = 8.0
"""4K reduced to 480 columns; a calibration that needs a larger scale, either way, belongs to another recording."""


def fitted(
    calibration: StereoCalibration, eye_width: int, eye_height: int, pixel_aspect: float = 1.0
) -> StereoCalibration:
    """The calibration at the size of the clip's eyes; `scaled_from` has its own size if that differs.

    A calibration of whole eyes fits squeezed ones: of half side-by-side or half top-bottom video, or by the pixel
    aspect, width / height of a pixel, that the video names.

    Raises:
        InputError: its aspect differs otherwise, which would mean an unknown crop, or its size is far from the clip's.
    """
    if (calibration.width, calibration.height) == (eye_width, eye_height):
        return calibration
    sx, sy = eye_width / calibration.width, eye_height / calibration.height
    sizes = f"{calibration.width}x{calibration.height} pixels an eye, and the eyes have {eye_width}x{eye_height}"
    squeezes = (1.0, 1 / pixel_aspect, *(HALVES if _is_whole_eye(calibration) else ()))
    if min(abs(sx / sy / squeeze - 1) for squeeze in squeezes) > MAX_ASPECT_CHANGE:
        raise InputError(
            FIELD,
            f"it is for {sizes}: not one uniform scale.",
            "Give the calibration of these frames, one eye's width and height, or the frames uncropped.",
        )
    if not 1 / MAX_SCALE <= min(sx, sy) <= max(sx, sy) <= MAX_SCALE:
        raise InputError(
            FIELD,
            f"it is for {sizes}: more than {MAX_SCALE:g} times apart.",
            "Give the calibration of these frames; check its width and height.",
        )
    resized = calibration.resized(eye_width, eye_height)
    return resized.model_copy(update={"scaled_from": (calibration.width, calibration.height)})


def _is_whole_eye(calibration: StereoCalibration) -> bool:
    """Whether pixels are square and the axis is in the middle: not so if the size is that of both eyes together."""
    eye = calibration if isinstance(calibration, RectifiedCalibration) else calibration.left
    is_square = abs(eye.fx_px / eye.fy_px - 1) <= MAX_PIXEL_SKEW
    return is_square and all(
        CENTRED[0] <= at <= CENTRED[1] for at in (eye.cx_px / calibration.width, eye.cy_px / calibration.height)
    )


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
