"""Notices of a report or a picture: warnings, assumptions and remarks, each with a code.

Programs decide by code and severity. The text is for people, and its words may change. docs/codes.md explains every
code.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict

from intrasplat.codes import known_code

MAX_NAMED = 8


class Severity(StrEnum):
    """info: good to know; warning: a reason to distrust the result."""

    INFO = "info"
    WARNING = "warning"


class NoticeCode(StrEnum):
    """The kind of a notice. Two notices of one code differ in their numbers and names only."""

    # assumptions about the input
    BASELINE = "baseline"
    BIT_DEPTH = "bit_depth"
    CALIBRATION = "calibration"
    DECODING = "decoding"
    DEPTH_UNIT = "depth_unit"
    FIELD_OF_VIEW = "field_of_view"
    FRAME_TIMES = "frame_times"
    IMPORTED = "imported"
    INTERLACED = "interlaced"
    INTRINSICS = "intrinsics"
    LAYOUT = "layout"
    MASKS = "masks"
    MIDDLE_LINE_UNUSED = "middle_line_unused"
    PIXEL_ASPECT = "pixel_aspect"
    POSES = "poses"
    RECTIFICATION = "rectification"
    ROTATION = "rotation"
    SPLASHES = "splashes"
    SYNTHETIC = "synthetic"
    # choices of the training
    BASES = "bases"
    EARLY_STOPPING = "early_stopping"
    EXPOSURE = "exposure"
    SMOKE = "smoke"
    SPACING = "spacing"
    STORED_PRECISION = "stored_precision"
    VIGNETTING = "vignetting"
    # warnings about the clip
    ALIGNMENT_UNKNOWN = "alignment_unknown"
    BLOOD = "blood"
    BLURRED_FRAMES = "blurred_frames"
    BRIGHTNESS_CHANGES = "brightness_changes"
    CAMERA_OR_TISSUE = "camera_or_tissue"
    CALIBRATION_SCALED = "calibration_scaled"
    COLOURS_UNKNOWN = "colours_unknown"
    COLOUR_CHANGES = "colour_changes"
    DAMAGED_FRAMES = "damaged_frames"
    DEPTH_INVERTED = "depth_inverted"
    DEPTH_JUMPS = "depth_jumps"
    DEPTH_OUT_OF_RANGE = "depth_out_of_range"
    DEPTH_UNUSUAL = "depth_unusual"
    DETAIL_LOST = "detail_lost"
    EYES_COLOURED_APART = "eyes_coloured_apart"
    EYES_DISAGREE = "eyes_disagree"
    EYES_OUT_OF_STEP = "eyes_out_of_step"
    EYES_UNLIKE = "eyes_unlike"
    FEW_FRAMES = "few_frames"
    FIELD_OF_VIEW_UNUSUAL = "field_of_view_unusual"
    FRAMES_SHOW_NOTHING = "frames_show_nothing"
    FRAMES_WITHOUT_TISSUE = "frames_without_tissue"
    FRAME_COUNT_UNKNOWN = "frame_count_unknown"
    HIDDEN_AT_FIRST = "hidden_at_first"
    LIGHT_FLICKERS = "light_flickers"
    LITTLE_DEPTH = "little_depth"
    LITTLE_STEREO_DEPTH = "little_stereo_depth"
    LITTLE_TISSUE = "little_tissue"
    MAGNIFIED = "magnified"
    MASKS_MARK_NOTHING = "masks_mark_nothing"
    MASKS_UNSURE = "masks_unsure"
    MASK_GAPS = "mask_gaps"
    MASK_LEVELS = "mask_levels"
    NO_INSTRUMENT_MASKED = "no_instrument_masked"
    NO_TEXTURE = "no_texture"
    NO_TIME = "no_time"
    NOTHING_NEW = "nothing_new"
    OUT_OF_FOCUS = "out_of_focus"
    POSES_CONTRADICT = "poses_contradict"
    POSES_UNSURE = "poses_unsure"
    POSE_JITTER = "pose_jitter"
    REPEATED_FRAMES = "repeated_frames"
    ROWS_MISALIGNED = "rows_misaligned"
    SHARPNESS_CHANGES = "sharpness_changes"
    STEREO_UNSURE = "stereo_unsure"
    VEILED = "veiled"
    # warnings about the training and its scores
    SCORES_FAILED = "scores_failed"
    SCORES_PENDING = "scores_pending"
    COPYING_SCORES_MORE = "copying_scores_more"
    DEPTH_DISAGREES = "depth_disagrees"
    DEPTH_NOT_COMPARED = "depth_not_compared"
    GENERALISATION_GAP = "generalisation_gap"
    RIGHT_EYE_LOW = "right_eye_low"
    GPU_IDLE = "gpu_idle"
    HELD_OUT_REPEATED = "held_out_repeated"
    HELD_OUT_SCORE_LOW = "held_out_score_low"
    HELD_OUT_WITHOUT_TISSUE = "held_out_without_tissue"
    HOLES = "holes"
    MOTION_GUESSED = "motion_guessed"
    NOTHING_HELD_OUT = "nothing_held_out"
    OUTLIER_FRAMES = "outlier_frames"
    TIME_TOO_SHORT = "time_too_short"
    TRAINING_SCORE_LOW = "training_score_low"
    # notices about one render
    COARSE = "coarse"
    DETAIL_MISSING = "detail_missing"
    ENLARGED = "enlarged"
    HARDLY_SEEN = "hardly_seen"
    HIGHLIGHTS_UNKNOWN = "highlights_unknown"
    POSE_FAR = "pose_far"
    TIME_IN_GAP = "time_in_gap"
    TIME_OUTSIDE_CLIP = "time_outside_clip"
    FIRST_PICTURE = "first_picture"
    TRAINING_GOES_ON = "training_goes_on"
    UNSEEN = "unseen"
    # a report written before notices had codes
    UNCLASSIFIED = "unclassified"


class Notice(BaseModel):
    """One thing to know about a scene or a picture."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    code: Annotated[NoticeCode, known_code(NoticeCode)]
    severity: Severity
    text: str

    @classmethod
    def info(cls, code: NoticeCode, text: str) -> Notice:
        """A notice that is good to know."""
        return cls(code=code, severity=Severity.INFO, text=text)

    @classmethod
    def warning(cls, code: NoticeCode, text: str) -> Notice:
        """A notice that gives a reason to distrust the result."""
        return cls(code=code, severity=Severity.WARNING, text=text)


def named_frames(frames: Sequence[int]) -> str:
    """The numbers of frames for a text, the first MAX_NAMED of them."""
    return ", ".join(map(str, frames[:MAX_NAMED])) + ", ..." * (len(frames) > MAX_NAMED)
