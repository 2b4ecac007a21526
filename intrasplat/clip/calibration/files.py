"""Calibration files: our JSON, OpenCV's FileStorage (YAML, XML, JSON), the ini of StereoMIS and SCARED.

The content determines the format, not the file's name, because a service stores uploads under names of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.fit import check_centred, fitted
from intrasplat.intake.calibration.opencv import check_opencv_names, name_of
from intrasplat.intake.calibration.text import FORMATS_REMEDY, checked_calibration, parse_text
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
    text = _read_text(Path(path))
    value, size_known = parse_text(text), True
    if value is None:
        value, size_known = _parse_opencv(text, eye_width, eye_height)
    calibration = checked_calibration(value)
    if not size_known:
        check_centred(calibration)
        return calibration.model_copy(
            update={"assumptions": (f"calibration names no image size: taken as {eye_width}x{eye_height}",)}
        )
    return fitted(calibration, eye_width, eye_height, pixel_aspect)


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_CALIBRATION_BYTES:
            raise InputError(FIELD, f"{path.name} has {path.stat().st_size} bytes.", FORMATS_REMEDY)
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(FIELD, f"{path.name} is not a text file.", FORMATS_REMEDY) from None
    except OSError as error:
        problem = f"{path.name} cannot be read: {error.strerror or error}."
        raise InputError(FIELD, problem, "Name a file that exists and may be read.") from None
    check_calibration_text(text, FIELD, path.name)
    return text


def _parse_opencv(text: str, eye_width: int, eye_height: int) -> tuple[dict[str, Any], bool]:
    """A FileStorage file; both eyes' matrices, R and T are required, distortion and image size are not."""
    values = _opencv_values(text)
    check_opencv_names(values)
    rotation = values["rotation"]
    if rotation.size == 3:  # a rotation vector
        rotation = cv2.Rodrigues(rotation.reshape(3, 1))[0]
    shapes = {"left_k": (values["left_k"], 9), "right_k": (values["right_k"], 9), "R": (rotation, 9)}
    for name, (matrix, count) in (shapes | {"T": (values["translation"], 3)}).items():
        if matrix.size != count:
            raise InputError(FIELD, f"{name} has {matrix.size} numbers, not {count}.", FORMATS_REMEDY)
    size = _opencv_size(values)
    width, height = size if size else (eye_width, eye_height)
    return {
        "model": "raw",
        "width": width,
        "height": height,
        "left": _opencv_eye(values["left_k"], values.get("left_d")),
        "right": _opencv_eye(values["right_k"], values.get("right_d")),
        "right_from_left_rotation": rotation.reshape(3, 3).tolist(),
        "right_from_left_translation_mm": values["translation"].ravel().tolist(),
    }, size is not None


def _opencv_values(text: str) -> dict[str, NDArray[np.float64]]:
    """The known keys of a FileStorage text, each as an array of float64."""
    head = text.lstrip()[:6]
    if not head.startswith(("%YAML", "<?xml", "{")):
        text = "%YAML:1.0\n---\n" + text.removeprefix("---")
    values: dict[str, NDArray[np.float64]] = {}
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        for key in list(storage.root().keys()):
            name = name_of(key)
            if name is not None:
                values[name] = _node_values(storage.getNode(key))
        storage.release()
    except (cv2.error, SystemError, UnicodeError):
        problem = "it is neither JSON, nor a stereo ini, nor an OpenCV YAML or XML file."
        raise InputError(FIELD, problem, FORMATS_REMEDY) from None
    return values


def _node_values(node: Any) -> NDArray[np.float64]:
    if node.isMap():
        matrix = node.mat()
        return np.zeros(0) if matrix is None else np.asarray(matrix, dtype=np.float64)
    if node.isSeq():
        return np.array([node.at(i).real() for i in range(node.size())], dtype=np.float64)
    return np.array([node.real()], dtype=np.float64)


def _opencv_size(values: dict[str, NDArray[np.float64]]) -> tuple[int, int] | None:
    """(width, height) if the file has them."""
    if "size" in values and values["size"].size == 2:
        pair: Sequence[float] = values["size"].ravel().tolist()
    elif "width" in values and "height" in values:
        pair = [float(values["width"].ravel()[0]), float(values["height"].ravel()[0])]
    else:
        return None
    if not all(np.isfinite(pair)) or min(pair) <= 0:
        raise InputError(FIELD, f"the image size {tuple(pair)} is not two positive numbers.", FORMATS_REMEDY)
    return round(pair[0]), round(pair[1])


def _opencv_eye(matrix: NDArray[np.float64], distortion: NDArray[np.float64] | None) -> dict[str, Any]:
    k = matrix.reshape(3, 3)
    eye: dict[str, Any] = {"fx_px": k[0, 0], "fy_px": k[1, 1], "cx_px": k[0, 2], "cy_px": k[1, 2]}
    return eye | {"distortion": [] if distortion is None else distortion.ravel().tolist()}
