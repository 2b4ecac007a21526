"""The choices for a picture of a scene: its layer, its file format, its camera, and how it shows unseen pixels."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field

from intrasplat.errors import InputError

MAX_RENDER_PIXELS = 8192 * 8192
"""Largest picture that the library and the command line draw; a service has a limit of its own."""
MAX_JUDGED_PIXELS = 1 << 21
"""A picture smaller than the recording is drawn in the recording's pixels, but at most so many (1920 x 1080)."""


BRIGHTEST_ERROR = 32
"""Levels of 255 of the brightest false colours of layer error, darker or brighter; more looks the same."""


class Layer(StrEnum):
    """rgb; depth along the camera's z; confidence in [0, 1]; smoke, the share of light that it takes, in [0, 1]; error,
    by how many levels of 255 the model's colours differ from the recorded frame's, in the mean of R G B.
    """

    RGB = "rgb"
    DEPTH = "depth"
    CONFIDENCE = "confidence"
    SMOKE = "smoke"
    ERROR = "error"


class ImageFormat(StrEnum):
    """png and npy are exact (depth: 16-bit PNG in 0.01 mm, npy float32 mm); jpeg and webp are for eyes."""

    PNG = "png"
    JPEG = "jpeg"
    WEBP = "webp"
    NPY = "npy"


class Unseen(StrEnum):
    """What a render shows where no training frame saw anything: a hatch, or the model's guess."""

    MARK = "mark"
    GUESS = "guess"


class Highlights(StrEnum):
    """Whether a render's colours show the highlights that were separated by comparing both eyes of a stereo clip."""

    ON = "on"
    OFF = "off"

    def shown_in(self, layer: Layer) -> bool:
        """Whether the render of a layer includes them; only colours can be rendered without."""
        return self is Highlights.ON or layer is not Layer.RGB


MEDIA_TYPES = {
    ImageFormat.PNG: "image/png",
    ImageFormat.JPEG: "image/jpeg",
    ImageFormat.WEBP: "image/webp",
    ImageFormat.NPY: "application/x-npy",
}


class IntrinsicsOverride(BaseModel):
    """Parts of the camera the caller wants otherwise than the clip's left eye; what is None follows the scene.

    With only a width or a height the other keeps the aspect; focal lengths and centre scale along unless given.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: int | None = Field(default=None, ge=8, le=8192)
    height: int | None = Field(default=None, ge=8, le=8192)
    fx: float | None = Field(default=None, gt=0, le=1e5)
    fy: float | None = Field(default=None, gt=0, le=1e5)
    cx: float | None = Field(default=None, ge=-1e5, le=1e5)
    cy: float | None = Field(default=None, ge=-1e5, le=1e5)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height in pixels of the picture, for a clip of width x height."""
        if self.width is not None and self.height is not None:
            return self.width, self.height
        if self.width is not None:
            return self.width, max(1, round(self.width * height / width))
        if self.height is not None:
            return max(1, round(self.height * width / height)), self.height
        return width, height


def check_depth_ends(near_mm: float | None, far_mm: float | None) -> None:
    """Return if the false colours of depth can end there; None: not known. Raises InputError, also for other layers."""
    if near_mm is not None and far_mm is not None and far_mm <= near_mm:
        problem = f"{far_mm:g} mm is not beyond {near_mm:g} mm, the near end."
        raise InputError("far_mm", problem, "Give a far end beyond the near one.")


class RecordedMasks(StrEnum):
    """What a recorded frame shows of its mask: the masked parts marked, nothing, or the mask alone."""

    MARKED = "marked"
    OFF = "off"
    ONLY = "only"
