"""Checks calibrations without a decoder.

OpenCV's XML is parsed in the decoding process. Here only its names and its end are looked for, so that only files are
refused that the parser would certainly refuse.
"""

from __future__ import annotations

import re

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.names import check_names, name_of
from intrasplat.intake.calibration.text import read_calibration
from intrasplat.intake.calibration.types import StereoCalibration

_WORD = re.compile(r"[\w.-]+")


def look_at_calibration(text: str) -> StereoCalibration | None:
    """The calibration in a text of any format; None for XML, and for a file that names no image size.

    Raises:
        InputError: no camera can be read from it, or it is implausible for a stereo endoscope.
    """
    calibration = read_calibration(text)
    if calibration is None and text.lstrip().startswith("<"):
        check_names({name_of(word) for word in _WORD.findall(text)})
        if "</opencv_storage>" not in text:
            raise InputError(FIELD, "the OpenCV file was cut short: its end is missing.", "Copy or export it again.")
    return calibration
