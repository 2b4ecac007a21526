"""Calibration files: what intrasplat/intake/calibration reads, and OpenCV's XML.

The content determines the format, not the file's name, because a service stores uploads under names of its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.encoding import decoded_text, named_errors
from intrasplat.intake.calibration.fisheye import check_no_fisheye
from intrasplat.intake.calibration.fit import check_centred, fitted
from intrasplat.intake.calibration.keyed import Entry
from intrasplat.intake.calibration.named import raw_value
from intrasplat.intake.calibration.names import FORMATS_REMEDY, name_of
from intrasplat.intake.calibration.text import checked_calibration, parse_text, with_size
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.intake.limits import MAX_CALIBRATION_BYTES
from intrasplat.intake.sniff import check_calibration_text


def load_calibration(
    path: Path | str, *, eye_width: int, eye_height: int, pixel_aspect: float = 1.0
) -> StereoCalibration:
    """The calibration in a file, for eyes of eye_width x eye_height pixels.

    A file for another size of the same view is scaled, which `scaled_from` records, also to pixels that are
    pixel_aspect times as wide as high, or to eyes that are squeezed to half (see fitted). A file without size is used
    unchanged, which `assumptions` record.

    Raises:
        InputError: unreadable, of no known format, not finite, not rigid, of another aspect, of a size far from
            the clip's, with an implausible baseline, or with a principal point that does not fit the image.
    """
    path = Path(path)
    text = _read_text(path)
    with named_errors(path.name):
        value = parse_text(text)
        if value is None:
            check_no_fisheye(text)
            value = raw_value(_xml_entries(text))
        size_known = "width" in value or value.get("model") != "raw"
        calibration = checked_calibration(with_size(value, eye_width, eye_height) if not size_known else value)
        if size_known:
            return fitted(calibration, eye_width, eye_height, pixel_aspect)
        check_centred(calibration)
    assumption = f"calibration names no image size: taken as {eye_width}x{eye_height}"
    return calibration.model_copy(update={"assumptions": (assumption,)})


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_CALIBRATION_BYTES:
            raise InputError(FIELD, f"{path.name} has {path.stat().st_size} bytes.", FORMATS_REMEDY)
        text = decoded_text(path.read_bytes())
    except OSError as error:
        problem = f"{path.name} cannot be read: {error.strerror or error}."
        raise InputError(FIELD, problem, "Name a file that exists and may be read.") from None
    if text is None:
        raise InputError(FIELD, f"{path.name} is not a text file.", FORMATS_REMEDY)
    check_calibration_text(text, FIELD, path.name)
    return text


def _xml_entries(text: str) -> dict[str, Entry]:
    """The known keys of OpenCV's XML with their numbers."""
    entries: dict[str, Entry] = {}
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        for key in list(storage.root().keys()):
            name = name_of(key)
            if name is not None:
                entries[name] = Entry(key, numbers=_numbers(storage.getNode(key)))
        storage.release()
    except (cv2.error, SystemError, UnicodeError):
        raise InputError(FIELD, "it is no XML file of OpenCV, or was cut short.", FORMATS_REMEDY) from None
    return entries


def _numbers(node: Any) -> list[float]:
    if node.isMap():
        matrix = node.mat()
        return [] if matrix is None else np.asarray(matrix, dtype=np.float64).ravel().tolist()
    if node.isSeq():
        return [node.at(i).real() for i in range(node.size())]
    return [node.real()]
