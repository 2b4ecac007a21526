"""The pinhole camera of every process: OpenCV axes (x right, y down, z forward), pixels, millimetres.

Symbols: M points.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Pinhole intrinsics in pixels; pixel (i, j) has its centre at (j + 0.5, i + 0.5) (docs/conventions.md).

    This is a plain dataclass, so that training needs no pydantic.

    Raises:
        ValueError: a size or focal length is not above 0, a size is not an integer, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if isinstance(value, bool | str) or not math.isfinite(value):
                raise ValueError(f"{name} of a camera is {value!r}, which is not a finite number")
            if name in ("width", "height") and value != int(value):
                raise ValueError(f"{name} of a camera is {value!r} pixels, which is not a whole number")
            if name not in ("cx", "cy") and value <= 0:
                raise ValueError(f"{name} of a camera is {value!r}, not above 0")
            kind = int if name in ("width", "height") else float  # JSON cannot represent NumPy's numbers
            object.__setattr__(self, name, kind(value))

    @classmethod
    def parsed(cls, value: object) -> Intrinsics:
        """The camera from numbers() that were stored as JSON.

        Raises:
            ValueError: the value is not a camera.
        """
        names = {each.name for each in fields(cls)}
        if not isinstance(value, dict) or value.keys() != names:
            raise ValueError(f"a camera has {', '.join(sorted(names))}, and nothing else")
        if not all(isinstance(each, int | float) for each in value.values()):
            raise ValueError("a camera consists of numbers")
        return cls(**value)

    def numbers(self) -> dict[str, float]:
        """The numbers by their names, for JSON."""
        return asdict(self)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The camera with the same field of view and another size in pixels."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def cut(self, left: int, top: int, width: int, height: int) -> Intrinsics:
        """The camera of a part of the picture that starts at row `top` and column `left`."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)


def unproject(
    pixels: NDArray[np.intp],
    depth_mm: NDArray[np.float32],
    intrinsics: Intrinsics,
    world_from_camera: NDArray[np.float64],
) -> NDArray[np.float64]:
    """World points [M, 3] in mm of flat pixel indices [M] at depths [M], through the pixels' centres."""
    rows, columns = np.divmod(pixels, intrinsics.width)
    return unproject_at(columns + 0.5, rows + 0.5, depth_mm, intrinsics, world_from_camera)


def unproject_at(
    column: NDArray[np.floating],
    row: NDArray[np.floating],
    depth_mm: NDArray[np.float32],
    intrinsics: Intrinsics,
    world_from_camera: NDArray[np.float64],
) -> NDArray[np.float64]:
    """World points [M, 3] in mm of image positions [M] at depths [M]; positions may lie outside the image."""
    x = (column - intrinsics.cx) / intrinsics.fx
    y = (row - intrinsics.cy) / intrinsics.fy
    camera_mm = np.stack([x, y, np.ones_like(x)], axis=1) * depth_mm[:, None].astype(np.float64)
    return np.asarray(camera_mm @ world_from_camera[:3, :3].T + world_from_camera[:3, 3])


def to_camera(points_mm: NDArray[Any], world_from_camera: NDArray[np.float64]) -> NDArray[Any]:
    """Camera coordinates [M, 3] in mm of world points [M, 3]."""
    return np.asarray((points_mm - world_from_camera[:3, 3]) @ world_from_camera[:3, :3])
