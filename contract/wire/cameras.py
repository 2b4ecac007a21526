"""Where the endoscope was while it recorded a scene's clip, and through which lens.

Names and contents are those of the scene's manifest (docs/scene-file.md). Symbols: T frames, K training frames.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from intrasplat.names import JOB_ID_PATTERN

Offset = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Row = Annotated[tuple[float, ...], Field(min_length=4, max_length=4)]
Rows = Annotated[tuple[Row, ...], Field(min_length=4, max_length=4)]


class ClipCamera(BaseModel):
    """The clip's pinhole camera in pixels."""

    model_config = ConfigDict(frozen=True)

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


class SceneCameras(BaseModel):
    """The cameras that a scene knows; while its job trains, so far as they are known."""

    model_config = ConfigDict(frozen=True)

    intrinsics: ClipCamera
    frame_times_s: tuple[float, ...] = Field(description="times of the T frames, from the first one")
    world_from_camera: tuple[Rows, ...] = Field(description="the endoscope's poses: T row-major 4x4, mm")
    trained_t: tuple[float, ...] = Field(description="times of the K frames that taught the scene, i / T")
    units_per_mm: float = Field(gt=0, description="60 / the median depth in mm")
    right_eye_mm: Offset | None = Field(
        default=None, description="where the right eye is, in the left one's axes; null: one eye taught the scene"
    )


class CamerasRequest(BaseModel):
    """SceneCameras as JSON; attempt as in RenderRequest."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["cameras"] = "cameras"
    scene_id: str = Field(pattern=JOB_ID_PATTERN)
    attempt: int | None = None
