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
    **{each: each for each in ("fx", "fy", "cx", "cy")},
}
_OF_A_NAMED_EYE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of distortion: by their own, k1 and k2 are the eyes' matrices."""
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
    **{
        spelling: f"{side}_{each}"
        for each in _OF_A_NAMED_EYE
        for side in _SIDES
        for spelling in (each + side, side + each)
    },
}
"""Our names by the spellings found in files; these are compared without case, underscores, dots and dashes."""

_NUMBERED = {word + sign: side for word in ("cam", "camera", "eye") for side, sign in (("left", "1"), ("right", "2"))}
MATRICES = {"left_k": "M1", "right_k": "M2", "rotation": "R", "translation": "T"}
"""What every file must have, by our names, as OpenCV calls it."""


def name_of(key: str) -> str | None:
    """The name in NAMES for a file's spelling of a key; None if it is unknown."""
    return NAMES.get(_plain(key))


def name_below(parent: str, key: str) -> str | None:
    """The name of a key below another one, such as "K" below "left" or "camera_1"; None if it is unknown.

    Below an eye's key, names of the other eye or of none mean nothing.
    """
    side = next((side for side in _SIDES if side in _plain(parent)), None) or _NUMBERED.get(_plain(parent))
    joined = name_of(parent + key) or name_of(key + parent)
    if joined is not None or side is None:
        return joined or name_of(key)
    name = name_of(side + key) or name_of(key)
    return name if name in _OF_BOTH or (name or "").startswith(side) else None


def _plain(key: str) -> str:
    return key.lower().translate(str.maketrans("", "", "_.- "))


def check_names(names: Collection[str | None]) -> None:
    """InputError if both eyes' matrices, R and T are not among the names."""
    missing = [usual for name, usual in MATRICES.items() if name not in names]
    if missing:
        raise InputError(FIELD, f"found no {', '.join(missing)} in the OpenCV file.", FORMATS_REMEDY)
