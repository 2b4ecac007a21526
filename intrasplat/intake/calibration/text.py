"""Parses calibrations: our JSON, files that name M1 D1 M2 D2 R T, the ini of StereoMIS and SCARED.

The content determines the format. XML alone needs OpenCV's parser, which runs in the decoding process.
"""

from __future__ import annotations

import configparser
import json
import re
from typing import Any

from pydantic import ValidationError

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD, check_calibration
from intrasplat.intake.calibration.fisheye import check_no_fisheye
from intrasplat.intake.calibration.keyed import keyed_json, keyed_yaml
from intrasplat.intake.calibration.named import raw_value
from intrasplat.intake.calibration.names import FORMATS_REMEDY, MATRICES
from intrasplat.intake.calibration.types import StereoCalibration, parse_calibration

_LAST_COMMA = re.compile(r",(?=\s*[}\]])")
_BLANKS = re.compile(r"[^\S\n]+")
_JSON_COMMENT = re.compile(r'("(?:[^"\\\n]|\\.)*"?)|(?:#|//)[^\n]*')


def read_calibration(text: str) -> StereoCalibration | None:
    """The calibration in a text; None if its format is XML, or if it is good but names no image size.

    Raises:
        InputError: it lacks a number, or is implausible for a stereo endoscope.
    """
    value = parse_text(text)
    if value is None:
        return None
    sized = "width" in value or value.get("model") != "raw"
    calibration = checked_calibration(value if sized else with_size(value, 1, 1))
    return calibration if sized else None


def with_size(value: dict[str, Any], width: int, height: int) -> dict[str, Any]:
    """A value of parse_text(), with this size if it has none."""
    return {"width": width, "height": height} | value


def checked_calibration(value: dict[str, Any]) -> StereoCalibration:
    """The calibration in a JSON-like value; raises as read_calibration()."""
    try:
        calibration = parse_calibration(value)
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] in ("union_tag_not_found", "union_tag_invalid"):
            said = f"is {str(value['model'])[:80]}, not" if "model" in value else "is not said:"
            problem = f"model {said} rectified or raw."
            raise InputError(FIELD, problem, FORMATS_REMEDY) from None
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise InputError(
            FIELD, f"{where}: {first['msg']} (given {str(first['input'])[:80]}).", FORMATS_REMEDY
        ) from None
    check_calibration(calibration)
    return calibration


def parse_text(text: str) -> dict[str, Any] | None:
    """The text as a value of our JSON, without width and height if the file names none; None if it is XML.

    Raises:
        InputError: its format is unknown, or it lacks a number.
    """
    start = text.lstrip()
    if start.startswith("{"):
        return _parse_json(text)
    if start.lower().startswith("[stereo") or "\n[stereo" in text.lower():
        check_no_fisheye(text)
        return _parse_ini(text)
    if start.startswith("<"):
        return None
    found = keyed_yaml(text)
    check_no_fisheye(text, found.keys)
    if not found.entries.keys() & MATRICES and "%YAML" not in text:
        raise InputError(FIELD, "it is neither JSON, nor a stereo ini, nor an OpenCV YAML or XML file.", FORMATS_REMEDY)
    return raw_value(found.entries)


def _parse_json(text: str) -> dict[str, Any]:
    plain = _LAST_COMMA.sub("", _JSON_COMMENT.sub(lambda found: found.group(1) or "", text))
    try:
        value = json.loads(plain)
        found = keyed_json(value)
    except (ValueError, RecursionError) as error:
        raise InputError(FIELD, f"it is not valid JSON: {error}.", FORMATS_REMEDY) from None
    assert isinstance(value, dict)  # it starts with a brace
    if value.get("model") in ("rectified", "raw") or not found.entries.keys() & MATRICES:
        return value
    check_no_fisheye(plain, found.keys)
    return raw_value(found.entries)


def _parse_ini(text: str) -> dict[str, Any]:
    """StereoMIS and SCARED: [StereoLeft], [StereoRight] with res, fc, cc, kc; the right one's R and T (mm) count."""
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(_BLANKS.sub(" ", text))  # the parser's patterns are slow on long runs of blanks
        left, right = parser["StereoLeft"], parser["StereoRight"]
        value = {
            "model": "raw",
            "width": round(float(left["res_x"])),
            "height": round(float(left["res_y"])),
            "left": _ini_eye(left),
            "right": _ini_eye(right),
            "right_from_left_rotation": [[float(right[f"R_{3 * i + j}"]) for j in range(3)] for i in range(3)],
            "right_from_left_translation_mm": [float(right[f"T_{i}"]) for i in range(3)],
        }
    except (configparser.Error, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(FIELD, f"the ini lacks a number or a section: {error}.", FORMATS_REMEDY) from None
    if any(left[key] != right[key] for key in ("res_x", "res_y") if key in right):
        raise InputError(FIELD, "left and right eye differ in res_x or res_y.", "Give eyes of one size.")
    return value


def _ini_eye(section: configparser.SectionProxy) -> dict[str, Any]:
    names = {"fx_px": "fc_x", "fy_px": "fc_y", "cx_px": "cc_x", "cy_px": "cc_y"}
    eye: dict[str, Any] = {ours: float(section[theirs]) for ours, theirs in names.items()}
    coefficients = [float(section.get(f"kc_{i}", "0")) for i in range(8)]
    return eye | {"distortion": coefficients if any(coefficients[5:]) else coefficients[:5]}
