"""Checks the text of OpenCV's calibration files; the parser itself runs in the decoding process.

Only files that the parser would certainly refuse are refused here: a missing name, a text that was cut short.
"""

from __future__ import annotations

import re
from collections.abc import Collection

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.text import FORMATS_REMEDY, read_calibration
from intrasplat.intake.calibration.types import StereoCalibration

OPENCV_KEYS = {
    "left_k": "m1 k1 kl kleft cameramatrix1 cameramatrixleft cameramatrixl leftcameramatrix",
    "right_k": "m2 k2 kr kright cameramatrix2 cameramatrixright cameramatrixr rightcameramatrix",
    "left_d": "d1 dl dleft distcoeffs1 distcoeff1 distcoeffsleft distcoeffleft distcoeffsl leftdistcoeffs "
    "distortion1 distortionleft distortioncoefficients1 distortioncoefficientsleft",
    "right_d": "d2 dr dright distcoeffs2 distcoeff2 distcoeffsright distcoeffright distcoeffsr rightdistcoeffs "
    "distortion2 distortionright distortioncoefficients2 distortioncoefficientsright",
    "rotation": "r rotation rotationmatrix rmat stereorotation",
    "translation": "t translation translationvector tvec stereotranslation",
    "size": "imagesize size",
    "width": "imagewidth width camerawidth",
    "height": "imageheight height cameraheight",
}
"""Spellings found in files; compared without case, underscores, dots and dashes."""

_REQUIRED = ("left_k", "right_k", "rotation", "translation")
_NAMES = {spelling: name for name, spellings in OPENCV_KEYS.items() for spelling in spellings.split()}
_WORD = re.compile(r"[\w.-]+")
_QUOTED_OR_COMMENT = re.compile(r'"[^"\n]*"|#.*')
_OPENED = {end: re.compile(r":\s*(?:!!?[\w-]{1,40}\s*)?" + re.escape(begin)) for begin, end in ("[]", "{}")}
"""Patterns of the start of a list or map value, by its closing bracket. All patterns here run in linear time."""


def name_of(key: str) -> str | None:
    """The name in OPENCV_KEYS for a file's spelling of a key; None if it is unknown."""
    return _NAMES.get(key.lower().translate(str.maketrans("", "", "_.-")))


def check_opencv_names(names: Collection[str | None]) -> None:
    """InputError if both eyes' matrices, R and T are not among names of OPENCV_KEYS."""
    missing = [name for name in _REQUIRED if name not in names]
    if missing:
        spellings = ", ".join(OPENCV_KEYS[name].split()[0].upper() for name in missing)
        raise InputError(FIELD, f"found no {spellings} in the OpenCV file.", FORMATS_REMEDY)


def look_at_calibration(text: str) -> StereoCalibration | None:
    """The calibration in a text of any format; None for OpenCV's formats, which the decoding process reads.

    Raises:
        InputError: no camera can be read from it, or it is implausible for a stereo endoscope.
    """
    calibration = read_calibration(text)
    if calibration is None:
        _check_opencv_text(text)
    return calibration


def _check_opencv_text(text: str) -> None:
    check_opencv_names({name_of(word) for word in _WORD.findall(text)})
    is_xml = text.lstrip().startswith("<?xml")
    if "</opencv_storage>" not in text if is_xml else _is_unclosed(_QUOTED_OR_COMMENT.sub('""', text)):
        raise InputError(FIELD, "the OpenCV file was cut short: its end is missing.", "Copy or export it again.")


def _is_unclosed(text: str) -> bool:
    """Whether a list or map starts after the last one that ends."""
    return any(opened.search(text, text.rfind(end) + 1) for end, opened in _OPENED.items())
