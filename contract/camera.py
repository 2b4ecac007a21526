"""The pinhole camera that every process means: OpenCV axes (x right, y down, z forward), pixels, millimetres."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Intrinsics(BaseModel):
    """Pinhole intrinsics in pixels; pixel (i, j) has its centre at (j + 0.5, i + 0.5) (docs/conventions.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same camera with another pixel grid over the same field of view."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )
