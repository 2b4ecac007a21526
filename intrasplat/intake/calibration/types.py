"""Types of a stereo calibration: the project's JSON, to which every other file format is converted.

Two kinds share the key `model`: "rectified" (rows already match; one focal length, one baseline) and "raw" (both eyes
with their distortion and the rigid transform between them). Lengths are mm, image lengths are pixels of one eye.
docs/conventions.md shows one of each; `python -m intrasplat.intake.calibration.types` prints their JSON schema.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_validator
from pydantic.json_schema import SkipJsonSchema

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
"""Valid numbers of coefficients in OpenCV's distortion model."""

Row = tuple[float, float, float]


class _Calibration(BaseModel):
    """Fields of both kinds: the pixel grid of one eye, and the assumptions of the reader."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    width: int = Field(gt=0, description="pixels of one eye")
    height: int = Field(gt=0, description="pixels of one eye")
    assumptions: tuple[str, ...] = Field(default=(), description="what the reader assumed, for the report")
    scaled_from: SkipJsonSchema[tuple[int, int] | None] = None
    """Width and height in the file, if a reader has scaled the calibration to another size."""


class RectifiedCalibration(_Calibration):
    """Eyes whose rows already match: disparity_px = fx_px * baseline_mm / depth_mm + disparity_offset_px.

    disparity_px is x_left - x_right. cx_px and cy_px follow docs/conventions.md: pixel centres lie at +0.5, so the
    centre of a symmetric image is (width / 2, height / 2).
    """

    model: Literal["rectified"]
    fx_px: float = Field(gt=0)
    fy_px: float = Field(gt=0)
    cx_px: float
    cy_px: float
    baseline_mm: float = Field(gt=0, description="the right eye lies this far to the right of the left one")
    disparity_offset_px: float = Field(default=0.0, description="disparity of a point infinitely far away")

    def resized(self, width: int, height: int) -> RectifiedCalibration:
        """The same cameras with another pixel grid over the same field of view."""
        sx, sy = width / self.width, height / self.height
        return self.model_copy(
            update={
                "width": width,
                "height": height,
                "fx_px": self.fx_px * sx,
                "fy_px": self.fy_px * sy,
                "cx_px": self.cx_px * sx,
                "cy_px": self.cy_px * sy,
                "disparity_offset_px": self.disparity_offset_px * sx,
            }
        )


class RawEye(BaseModel):
    """One unrectified eye in OpenCV's convention: pixel centres are whole numbers (not at +0.5).

    distortion has OpenCV's coefficients in OpenCV's order, k1 k2 p1 p2 k3 and on: 0, 4, 5, 8, 12 or 14 of them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    fx_px: float = Field(gt=0)
    fy_px: float = Field(gt=0)
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()

    @field_validator("distortion")
    @classmethod
    def _known_length(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in DISTORTION_LENGTHS:
            raise ValueError(f"{len(value)} coefficients; OpenCV's model has {DISTORTION_LENGTHS} of them")
        return value

    def resized(self, sx: float, sy: float) -> RawEye:
        """The same eye on a grid sx, sy times as fine; half a pixel converts between the two conventions."""
        return self.model_copy(
            update={
                "fx_px": self.fx_px * sx,
                "fy_px": self.fy_px * sy,
                "cx_px": (self.cx_px + 0.5) * sx - 0.5,
                "cy_px": (self.cy_px + 0.5) * sy - 0.5,
            }
        )


class RawCalibration(_Calibration):
    """Two unrectified eyes: x_right = right_from_left_rotation @ x_left + right_from_left_translation_mm.

    Axes are OpenCV's (x right, y down, z forward), so a right eye that lies to the right has a negative x translation.
    """

    model: Literal["raw"]
    left: RawEye
    right: RawEye
    right_from_left_rotation: tuple[Row, Row, Row]
    right_from_left_translation_mm: Row

    def resized(self, width: int, height: int) -> RawCalibration:
        """The same cameras with another pixel grid over the same field of view."""
        sx, sy = width / self.width, height / self.height
        eyes = {"left": self.left.resized(sx, sy), "right": self.right.resized(sx, sy)}
        return self.model_copy(update={"width": width, "height": height, **eyes})


StereoCalibration = Annotated[RectifiedCalibration | RawCalibration, Field(discriminator="model")]


def parse_calibration(value: Any) -> RectifiedCalibration | RawCalibration:
    """The calibration in a decoded JSON value.

    Raises:
        pydantic.ValidationError: it is of neither kind, or a number is missing, not finite or out of range.
    """
    adapter: TypeAdapter[RectifiedCalibration | RawCalibration] = TypeAdapter(StereoCalibration)
    return adapter.validate_python(value)


def calibration_schema() -> dict[str, Any]:
    """JSON schema of a calibration file."""
    return TypeAdapter(StereoCalibration).json_schema()


if __name__ == "__main__":
    print(json.dumps(calibration_schema(), indent=2))
