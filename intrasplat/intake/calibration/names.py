"""The names that files give to the cameras of two eyes, and the calibration that these make."""

from __future__ import annotations

from collections.abc import Collection

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD

FORMATS_REMEDY = (
    "Give our JSON (model rectified or raw), an OpenCV YAML, XML or JSON with M1 D1 M2 D2 R T, "
    "or an ini with [StereoLeft] and [StereoRight]."
)

_OF_AN_EYE = {
    "k": "m k mtx cameramatrix intrinsicmatrix intrinsics intrinsic",
    "d": "d dist distcoeffs distcoeff distortion distortioncoefficients distortioncoeffs",
}
_SIDES = {"left": ("1", "l", "left"), "right": ("2", "r", "right")}
_OF_BOTH = {
    "rotation": "r rotation rotationmatrix rmat stereorotation",
    "translation": "t translation translationvector tvec stereotranslation",
    "size": "imagesize size",
    "width": "imagewidth width camerawidth",
    "height": "imageheight height cameraheight",
}
NAMES = {
    **{spelling: name for name, spellings in _OF_BOTH.items() for spelling in spellings.split()},
    **{
        spelling: f"{side}_{kind}"
        for kind, words in _OF_AN_EYE.items()
        for side, signs in _SIDES.items()
        for word in words.split()
        for sign in signs
        for spelling in (word + sign, sign + word)
    },
}
"""Our names by the spellings found in files; these are compared without case, underscores, dots and dashes."""

MATRICES = {"left_k": "M1", "right_k": "M2", "rotation": "R", "translation": "T"}
"""What every file must have, by our names, as OpenCV calls it."""


def name_of(key: str) -> str | None:
    """The name in NAMES for a file's spelling of a key; None if it is unknown."""
    return NAMES.get(key.lower().translate(str.maketrans("", "", "_.- ")))


def check_names(names: Collection[str | None]) -> None:
    """InputError if both eyes' matrices, R and T are not among the names."""
    missing = [usual for name, usual in MATRICES.items() if name not in names]
    if missing:
        raise InputError(FIELD, f"found no {', '.join(missing)} in the OpenCV file.", FORMATS_REMEDY)
