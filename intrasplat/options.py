"""The single definition of a reconstruction's options: names, choices, bounds, meaning.

These derive from it: the fields of POST /reconstruct, the options of `intrasplat reconstruct`, `submit` and `evaluate`
(intrasplat/commands/arguments.py), the parameters of the decoding process and the training, and the form of the page.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import ClassVar, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic_core.core_schema import ValidationInfo

from intrasplat.errors import InputError
from intrasplat.names import (
    Eyes,
    Fov,
    Keep,
    Layout,
    MaskPolarity,
    MaskSource,
    PoseConvention,
    Poses,
    PresetName,
    UsedFrames,
)

Priority = Literal["standard", "high"]
"""high: runs before all standard jobs, and interrupts one that is running, which resumes later."""

MAX_HOLDOUT_CHARACTERS = 8000
"""Room for a thousand frame numbers of six digits with commas; a job's record must fit into a pipe's buffer."""

MIN_DEPTH_MM, MAX_DEPTH_MM = 10.0, 300.0
"""Depths that an endoscope sees: nearer it is out of focus, and farther its eyes' pictures differ by 1 or 2 pixels."""

FIELD_PREFIX = "options"
"""InputError.field of an option is `options.NAME`."""


class ClipOptions(BaseModel):
    """How to read a clip's files."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    exclusive: ClassVar[tuple[str, ...]] = ()
    """Options of which at most one may be given."""

    layout: Layout = Field(default="auto", description="how the clip's eyes, depths and masks are laid out")
    mask_polarity: MaskPolarity = Field(default="auto", description="what is bright in the masks")
    mask_source: MaskSource = Field(
        default="auto",
        description="masks of instruments. auto: the clip's, else the segmenter's if there is one, else found "
        "by colour and depth; given: the clip's or the segmenter's; none: every pixel is tissue",
    )
    pose_convention: PoseConvention = Field(default="opengl", description="axes of poses_bounds.npy")


class ReconstructionOptions(ClipOptions):
    """How to reconstruct a clip. Without budget_s and iterations the preset says how long to train."""

    exclusive: ClassVar[tuple[str, ...]] = ("iterations", "budget_s")

    holdout: str = Field(
        default="every8",
        max_length=MAX_HOLDOUT_CHARACTERS,
        pattern=r"^(every8|blocks8|none|\d{1,6}(,\d{1,6})*)$",
        description="frames to measure quality on, never to train on: "
        "every8, blocks8, none, or frame numbers such as 1,9,17",
    )
    preset: PresetName = Field(
        default="fast", description="instant, fast, quality and small are ours; paper is the method as published"
    )
    eyes: Eyes = Field(
        default="both",
        description="the eyes of a stereo clip that our presets train on; with left, the right eye only judges",
    )
    use_frames: UsedFrames = Field(
        default="new",
        description="new leaves out frames of a long clip that show nothing new, such as repeats and pauses",
    )
    poses: Poses = Field(
        default="auto",
        description="the camera's poses: given with the clip or in a file, fixed, or to estimate; auto decides",
    )
    fov: Fov = Field(
        default="auto",
        description="the part of the pictures that shows the scene: auto leaves out borders, bars and labels; all: "
        "everything",
    )
    min_depth_mm: float = Field(default=MIN_DEPTH_MM, gt=0, description="nearest depth that stereo may find, in mm")
    max_depth_mm: float = Field(
        default=MAX_DEPTH_MM, gt=0, validate_default=True, description="farthest depth that stereo may find, in mm"
    )
    iterations: int | None = Field(
        default=None, ge=1, le=1_000_000, description="exactly how many steps to train; not with budget_s"
    )
    budget_s: float | None = Field(
        default=None, gt=0, le=7200, description="about how many seconds to train, often less; not with iterations"
    )
    seed: int = Field(default=0, ge=0, lt=2**31, description="seed of all random numbers")
    keep_recorded: Keep = Field(
        default="on",
        description="whether recorded frames and their masks are kept with the scene, to compare the model with",
    )

    @field_validator("holdout", mode="before")
    @classmethod
    def _frames_as_text(cls, value: object) -> object:
        """Accept a JSON list of frame numbers in place of their comma-separated text."""
        return ",".join(str(frame) for frame in value) if isinstance(value, list) else value

    @field_validator("max_depth_mm")
    @classmethod
    def _some_depth(cls, max_depth_mm: float, given: ValidationInfo) -> float:
        if max_depth_mm <= given.data.get("min_depth_mm", 0):
            raise ValueError("max_depth_mm must be larger than min_depth_mm")
        return max_depth_mm

    @field_validator("budget_s")
    @classmethod
    def _one_length(cls, budget_s: float | None, given: ValidationInfo) -> float | None:
        if budget_s is not None and given.data.get("iterations") is not None:
            raise ValueError("budget_s and iterations exclude each other; give one of them")
        return budget_s


class JobOptions(ReconstructionOptions):
    """How a service reconstructs a clip; the `options` field of POST /reconstruct."""

    priority: Priority = Field(
        default="standard", description="high: before standard jobs, and in place of a running one"
    )
    retention_hours: float | None = Field(
        default=None, gt=0, le=87_600, description="hours after its end until the job is purged: clip, scene and record"
    )


Options = TypeVar("Options", bound=BaseModel)


def parse_options(model: type[Options], given: str | Mapping[str, object]) -> Options:
    """Options from JSON text or from values by name.

    Raises:
        InputError: an option is wrong; its field is options.NAME.
    """
    try:
        return model.model_validate_json(given) if isinstance(given, str) else model.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join([FIELD_PREFIX, *(str(part) for part in first["loc"])])
        if first["type"] == "extra_forbidden":
            near = get_close_matches(str(first["loc"][-1]), model.model_fields, 1)
            remedy = f"Did you mean {near[0]}?" if near else f"The options are {', '.join(model.model_fields)}."
            raise InputError(field, "there is no such option.", remedy) from error
        problem = f"{first['msg'].removeprefix('Value error, ')} (given: {str(first['input'])[:80]!r})."
        named = model.model_fields.get(str(first["loc"][0])) if first["loc"] else None
        allowed = named.description if named and named.description else "a value that /openapi.json allows for it"
        if first["type"] == "literal_error":
            allowed = first["ctx"]["expected"]
        raise InputError(field, problem, f"Give {allowed}.") from error
