"""Refuses calibrations of fisheye lenses: their coefficients mean other curves than those of OpenCV's pinhole model."""

from __future__ import annotations

import re
from collections.abc import Collection

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD

_WORDS = re.compile(
    r"fish_?eye\w*|equi-?distant|kannala[ _-]?brandt\w*|omni_?directional|double_?sphere", re.IGNORECASE
)
_DENIED = re.compile(r"[\"']?\s{0,9}[:=>]\s{0,9}[\"']?(?:false|no|none|off|0)\b", re.IGNORECASE)
_COMMENT = re.compile(r"(?:(?<=\s)|^)(?:#|;|//|<!--).*")
_REMEDY = (
    "Undistort the frames with the fisheye model and give the rectified calibration of these, "
    "or calibrate with the pinhole model (k1 k2 p1 p2 k3)."
)


def check_no_fisheye(text: str, keys: Collection[str] = ()) -> None:
    """InputError if a text names a fisheye model outside comments, or keys (lower case) hold its k1 to k4 alone."""
    for number, line in enumerate(text.splitlines(), start=1):
        found = _WORDS.search(line)
        if found is not None and not _DENIED.match(line, found.end()):
            found = _WORDS.search(_COMMENT.sub("", line))
            if found is not None:
                raise _refused(f'"{found.group()}" in line {number}')
    if {"k3", "k4"} <= set(keys) and not {"p1", "p2", "k5"} & set(keys):
        raise _refused("k1 to k4 without p1 and p2")


def _refused(sign: str) -> InputError:
    return InputError(FIELD, f"it is of a fisheye model ({sign}), and only pinhole models are read.", _REMEDY)
