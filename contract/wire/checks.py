"""A clip as a caller describes it before sending it, and what was found against it."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field

HEAD_BYTES = 32
"""How many bytes from a file's start a check may send."""
MAX_TEXT_CHARACTERS = 250_000


class FindingCode(StrEnum):
    """What was found, for programs; docs/codes.md explains each."""

    CALIBRATION_MISSING = "calibration_missing"
    CALIBRATION_SCALED = "calibration_scaled"
    CALIBRATION_SIZE = "calibration_size"
    CALIBRATION_UNREADABLE = "calibration_unreadable"
    EMPTY = "empty"
    ENDING = "ending"
    EYES_DIFFER = "eyes_differ"
    KIND = "kind"
    NOT_ALLOWED = "not_allowed"
    NO_ROOM = "no_room"
    OPTION = "option"
    TOO_LARGE = "too_large"
    TOO_LONG = "too_long"


class Finding(BaseModel):
    """Something that speaks against a clip.

    Attributes:
        field: the file or option at fault, such as calibration or options.budget_s.
        refused: POST /reconstruct would refuse it. Otherwise the job may fail, or the caller's numbers may be wrong.
        problem: what is wrong, in words.
        remedy: what to do.
    """

    model_config = ConfigDict(frozen=True)

    field: str
    code: FindingCode
    refused: bool
    problem: str
    remedy: str


class DescribedFile(BaseModel):
    """A file that is to be sent. Width, height and duration are a video's, where the caller can tell."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    suffix: str = Field(max_length=20, description="the ending of its name, such as .mp4")
    size_bytes: int = Field(ge=0)
    head: str = Field(
        default="",
        pattern=rf"^([0-9a-f]{{2}}){{0,{HEAD_BYTES}}}$",
        description="its first bytes, in hexadecimal digits",
    )
    width: int | None = Field(default=None, gt=0, le=100_000)
    height: int | None = Field(default=None, gt=0, le=100_000)
    duration_s: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    text: str | None = Field(default=None, max_length=MAX_TEXT_CHARACTERS, description="all of a calibration")


class DescribedClip(BaseModel):
    """A clip that is to be sent: its files by part, and the options."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    clip: DescribedFile | None = None
    left: DescribedFile | None = None
    right: DescribedFile | None = None
    calibration: DescribedFile | None = None
    masks: DescribedFile | None = None
    poses_file: DescribedFile | None = None
    fov_mask: DescribedFile | None = None
    clip_of: str | None = Field(default=None, max_length=64)
    options: dict[str, object] = Field(default={})

    def files(self) -> dict[str, DescribedFile]:
        """Those that are there, by part."""
        parts = ("clip", "left", "right", "calibration", "masks", "poses_file", "fov_mask")
        return {part: getattr(self, part) for part in parts if getattr(self, part) is not None}
