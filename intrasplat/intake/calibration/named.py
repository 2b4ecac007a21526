"""Makes the raw calibration of a file that names both eyes' matrices, R and T, as OpenCV's samples do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.keyed import Entry
from intrasplat.intake.calibration.names import FORMATS_REMEDY, check_names


def raw_value(entries: Mapping[str, Entry]) -> dict[str, Any]:
    """The calibration as our raw JSON, without width and height if the file has none; distortion may lack, too.

    Raises:
        InputError: a name is missing, or has another number of numbers than it must have.
    """
    entries = dict(entries)
    for side in ("left", "right"):
        _join(entries, side)
    check_names(entries.keys())
    rotation = _numbers(entries["rotation"], 9, 3)
    if len(rotation) == 3:
        rotation = _from_vector(rotation)
    return _size(entries) | {
        "model": "raw",
        "left": _eye(entries, "left"),
        "right": _eye(entries, "right"),
        "right_from_left_rotation": [rotation[:3], rotation[3:6], rotation[6:]],
        "right_from_left_translation_mm": _numbers(entries["translation"], 3),
    }


def _join(entries: dict[str, Entry], side: str) -> None:
    """Add an eye's matrix and distortion if the file has their numbers one by one."""
    fx, fy, cx, cy = (entries.get(f"{side}_{each}") for each in ("fx", "fy", "cx", "cy"))
    if fx and fy and cx and cy and f"{side}_k" not in entries:
        f, g, x, y = (_numbers(each, 1)[0] for each in (fx, fy, cx, cy))
        entries[f"{side}_k"] = Entry(fx.key, fx.line, [f, 0.0, x, 0.0, g, y, 0.0, 0.0, 1.0])
    single = [entries.get(f"{side}_{each}") for each in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    given = [each for each in single if each is not None]
    if given and f"{side}_d" not in entries:
        count = next(count for count in (4, 5, 8) if not any(single[count:]))
        numbers = [0.0 if each is None else _numbers(each, 1)[0] for each in single[:count]]
        entries[f"{side}_d"] = Entry(given[0].key, given[0].line, numbers)


def _eye(entries: Mapping[str, Entry], side: str) -> dict[str, Any]:
    k = _numbers(entries[f"{side}_k"], 9)
    eye: dict[str, Any] = {"fx_px": k[0], "fy_px": k[4], "cx_px": k[2], "cy_px": k[5]}
    distortion = entries.get(f"{side}_d")
    return eye | {"distortion": [] if distortion is None else _numbers(distortion)}


def _numbers(entry: Entry, *counts: int) -> list[float]:
    if entry.other is not None:
        raise InputError(FIELD, f"{entry} holds {entry.other[:40]!r}, which is not a number.", FORMATS_REMEDY)
    if counts and len(entry.numbers) not in counts:
        count = len(entry.numbers)
        commas = " Write decimals with a point." if count in [2 * each for each in counts] else ""
        problem = f"{entry} has {count} number{'' if count == 1 else 's'}, not {counts[0]}."
        raise InputError(FIELD, problem, FORMATS_REMEDY + commas)
    return entry.numbers


def _size(entries: Mapping[str, Entry]) -> dict[str, Any]:
    """width and height, if the file has them."""
    if "size" in entries and len(entries["size"].numbers) == 2:
        pair = entries["size"].numbers
    elif "width" in entries and "height" in entries:
        pair = _numbers(entries["width"], 1) + _numbers(entries["height"], 1)
    else:
        return {}
    if not all(map(math.isfinite, pair)) or min(pair) <= 0:
        raise InputError(FIELD, f"the image size {tuple(pair)} is not two positive numbers.", FORMATS_REMEDY)
    return {"width": round(pair[0]), "height": round(pair[1])}


def _from_vector(vector: Sequence[float]) -> list[float]:
    """The rotation matrix, row by row, of a rotation vector (Rodrigues' formula)."""
    angle = math.hypot(*vector)
    x, y, z = (each / angle for each in vector) if angle else (0.0, 0.0, 0.0)
    cosine, sine = math.cos(angle), math.sin(angle)
    rest = 1 - cosine
    return [
        cosine + rest * x * x,
        rest * x * y - sine * z,
        rest * x * z + sine * y,
        rest * x * y + sine * z,
        cosine + rest * y * y,
        rest * y * z - sine * x,
        rest * x * z - sine * y,
        rest * y * z + sine * x,
        cosine + rest * z * z,
    ]
