"""The quality report of a finished scene (report.json): measurements, assumptions and warnings."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from intrasplat.names import JOB_ID_PATTERN, Eye, Eyes
from intrasplat.notices import Notice, NoticeCode, Severity

REPORT_VERSION = 2
"""It rises when a field changes its meaning, not when a field is added."""
VersionText = Annotated[str, Field(pattern=r"^[0-9A-Za-z.+-]{1,40}$")]
"""A version of intrasplat."""
RESEARCH_USE = "Research use only. Not a medical device; it must not guide treatment."


class FrameScore(BaseModel):
    """One held-out frame: the model's scores and those of copying its neighbours. None: no tissue to judge."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    frame: int = Field(ge=0, description="counted from 0; the page counts from 1")
    scored: bool = Field(
        default=True, description="False: the scores, and what they warn of, are still being measured; ask again"
    )
    psnr_tissue_db: float | None
    psnr_paper_db: float | None
    ssim: float | None
    coverage: float | None
    baseline_blend_db: float | None
    baseline_flow_db: float | None
    psnr_right_db: float | None = Field(default=None, description="None for a clip of one eye, too")


class RightEye(BaseModel):
    """What the right eye differs by from its calibration and from the left eye, measured on training frames.

    Its camera was corrected by the turn, its pictures by the colours. What an error of the calibration does along the
    rows looks like depth, and is not known.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    moved_px: float = Field(ge=0, description="largest shift of any pixel by the turn and the zoom")
    lower_px: float = Field(description="rows by which the right picture lies lower at its principal point")
    pitch_deg: float = Field(description="rotation of the right eye about its x axis, as the left eye sees it")
    yaw_deg: float = Field(description="about its y axis; the principal point keeps its column")
    roll_deg: float = Field(description="about its z axis")
    zoom: float = Field(gt=-1, description="focal length over the calibrated one, minus 1")
    left_from_right: tuple[float, ...] = Field(
        min_length=16, max_length=16, description="4x4, row-major, mm: its pose seen from the left eye"
    )
    fx_px: float = Field(description="focal length of the corrected camera, in columns")
    fy_px: float = Field(description="and in rows")
    cx_px: float = Field(description="column of its principal point")
    cy_px: float = Field(description="and its row")
    matches: int | None = Field(
        default=None,
        ge=0,
        description="features by which the turn was measured. 0: nothing was measured, and turn and zoom are 0; fewer "
        "than 150: lower_px alone. None: a report of before they were counted",
    )
    residual_px: float = Field(ge=0, description="median distance of the rows of matching features after that")
    gain: tuple[float, ...] = Field(
        min_length=3,
        max_length=3,
        description="right = gain * left + offset, by channel; 1 and 0: nothing was corrected",
    )
    offset: tuple[float, ...] = Field(min_length=3, max_length=3, description="in levels of 255")
    colour_correlation: float | None = Field(
        ge=-1.001,
        le=1.001,
        description="correlation of the eyes' colours at matches, in the worst channel; None: too few matches",
    )


class Masks(BaseModel):
    """How instruments were distinguished from tissue."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    source: Literal["given", "found", "segmenter", "none"] = Field(
        description="given with the clip; found by colour and depth; by this installation's segmenter; none: every "
        "pixel counts as tissue"
    )
    share: float = Field(default=0.0, ge=0, le=1, description="share of the left eye's field of view that is no tissue")
    sure: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="how clearly found instruments were distinguished from tissue; None: no masks were found",
    )

    @property
    def are_found(self) -> bool:
        """Whether this program, or a segmenter, found them in the pictures."""
        return self.source in ("found", "segmenter")


FieldShape = Literal["whole", "round", "rectangular", "other"]


class FieldOfView(BaseModel):
    """The part of the pictures that shows the scene. Outside it the model has nothing (docs/conventions.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    source: Literal["found", "given", "all"] = Field(
        description="found in the pictures; given: the left eye's by the caller; all: the whole picture, as asked"
    )
    share: float = Field(ge=0, le=1, description="share of the left eye's picture")
    shape: FieldShape = Field(description="of its border; whole: the picture has none")
    right_share: float | None = Field(default=None, ge=0, le=1, description="share of the right eye's; None: one eye")
    label_share: float = Field(default=0.0, ge=0, le=1, description="share of the picture under labels and menus")


class LightChanges(BaseModel):
    """Changes of the light in the left eye's pictures, by frame, that the model is without (docs/conventions.md).

    A frame that was not trained on has values interpolated in time.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    reference: int | None = Field(
        default=None, ge=0, description="frame whose exposure and white balance the model has; None: they hardly change"
    )
    stops: tuple[float, ...] | None = Field(
        default=None, description="exposure of every frame against that of reference, in stops; None as there"
    )
    red: tuple[float, ...] | None = Field(
        default=None,
        description="white balance: the gain of recorded red over that of green in every frame, against reference; "
        "None as there",
    )
    blue: tuple[float, ...] | None = Field(default=None, description="the same of blue")
    smoke_share: tuple[float, ...] | None = Field(
        default=None,
        description="mean share of the light that smoke takes over the picture, in every frame; None: none was found",
    )
    vignetting: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="brightness of tissue at the border over that in the middle, where it differs most; None: the "
        "border is hardly darker, or the camera does not move",
    )


class CameraPoses(BaseModel):
    """Where the endoscope was. Tissue that moves as a whole looks like a camera that moves the other way; what of the
    common motion follows the course of the tissue's own deformation was taken to be the tissue's.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    source: Literal["given", "fixed", "estimated"] = Field(
        description="given with the clip; fixed: asked for or recognised; estimated from the pictures"
    )
    path_mm: float | None = Field(
        default=None, ge=0, description="length of the path; None: it was not estimated, or the camera is fixed"
    )
    extent_mm: float | None = Field(default=None, ge=0, description="largest distance between two frames' cameras")
    extent_deg: float | None = Field(default=None, ge=0, description="largest rotation between two frames' cameras")
    steadied_mm: float | None = Field(
        default=None,
        ge=0,
        description="how far given poses jumped at the tissue before they were steadied; None: they were not",
    )
    sigma_mm: float | None = Field(
        default=None, ge=0, description="standard deviation that is expected of the path, laid on the true one"
    )
    sigma_deg: float | None = Field(default=None, ge=0, description="the same of the rotation")
    rigid_fit_mm: float | None = Field(
        default=None, ge=0, description="median distance at the tissue by which matches miss what the path predicts"
    )
    tissue_mm: float | None = Field(
        default=None, ge=0, description="root mean square of the common motion that was taken to be the tissue's"
    )
    tissue_period_s: float | None = Field(default=None, ge=0, description="period of that motion, if it has one")
    unsure_frames: tuple[int, ...] = Field(default=(), description="frames whose pose is not to be relied on")


IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""The unit matrix 3x3, row-major."""


class RecordedPixels(BaseModel):
    """The left eye's pixels as they were recorded, and which of them a pixel (x, y) of a stored frame shows.

    x, y count in pixels of the full size, from the middle of the first one. With (X, Y, Z) = rays (x, y, 1), the
    recorded pixel is camera (D(X / Z, Y / Z), 1), where D is OpenCV's distortion. The defaults move nothing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    width: int = Field(gt=0, description="width of the recorded eye in pixels")
    height: int = Field(gt=0, description="height of the recorded eye in pixels")
    rays: tuple[float, ...] = Field(default=IDENTITY, min_length=9, max_length=9, description="3x3, row-major")
    distortion: tuple[float, ...] = Field(default=(), description="OpenCV's coefficients k1 k2 p1 p2 k3 and on")
    camera: tuple[float, ...] = Field(default=IDENTITY, min_length=9, max_length=9, description="3x3, row-major")


class Recorded(BaseModel):
    """Which recorded frames a scene keeps, as its cameras see them: rectified, with corrected colours."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: tuple[int, ...] = Field(min_length=1, description="the clip's frames that are kept, rising")
    eyes: tuple[Eye, ...] = Field(min_length=1, description="the eyes whose frames are kept")
    width: int = Field(gt=0, description="width of a picture in pixels")
    height: int = Field(gt=0, description="height of a picture in pixels")
    masks: bool = Field(description="whether masks are kept with them; False: every pixel counts as tissue")
    size_bytes: int = Field(ge=0, description="what they take on the disk")
    pixels: RecordedPixels | None = Field(
        default=None, description="which pixels of the recording they show; None: the report is of an earlier version"
    )


class Imported(BaseModel):
    """Where a scene came from that was made by another installation."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scene_id: str | None = Field(
        default=None, pattern=JOB_ID_PATTERN, description="its id there; None: it was exported from a folder"
    )
    version: VersionText = Field(description="version of intrasplat that exported it")
    exported_at_s: float = Field(ge=0, description="when it was exported, UNIX s, by the clock there")
    imported_at_s: float = Field(ge=0, description="when it was imported, UNIX s")


class DetailScores(BaseModel):
    """Scores of a scene's views with detail from the recorded training frames, of the same held-out frames."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    psnr_tissue_db: float | None
    psnr_right_db: float | None
    ssim: float | None


class Report(BaseModel):
    """Every finished scene has one. A figure is None only if it could not be measured, and then warnings say why; or
    while `scored` is False: a scene is finished before its scores are.

    Scores are means over the held-out frames, which took no part in training (docs/conventions.md, "Scores").
    psnr_tissue_db is the one to go by; psnr_paper_db is what papers print, and higher. When psnr_tissue_db does not
    exceed the two baselines, copying the neighbouring frames would have served as well.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    report_version: int = REPORT_VERSION
    notice: str = RESEARCH_USE
    imported: Imported | None = Field(default=None, description="where the scene came from; None: it was made here")
    versions: dict[str, str] = Field(default={}, description="versions of intrasplat and of what it computes with")

    scored: bool = Field(
        default=True, description="False: the scores, and what they warn of, are still being measured; ask again"
    )
    psnr_tissue_db: float | None
    psnr_paper_db: float | None
    psnr_clear_db: float | None = Field(default=None, description="psnr_tissue_db without highlights")
    psnr_right_db: float | None = Field(
        default=None,
        description="psnr_tissue_db of the right eye's frames, over what the left eye sees, too; None for one eye",
    )
    psnr_right_clear_db: float | None = Field(default=None, description="the same without highlights")
    baseline_warp_db: float | None = Field(
        default=None, description="psnr_right_db of the left eye's picture warped by stereo depth"
    )
    baseline_warp_clear_db: float | None = Field(default=None, description="the same without highlights")
    ssim: float | None
    detail: DetailScores | None = Field(
        default=None,
        description="scores of views with detail from recorded frames, which callers see by default; the others are of "
        "the model alone. None: recorded frames are not kept, or version 0.3",
    )
    baseline_blend_db: float | None = Field(description="psnr_tissue_db of blending the nearest training frames")
    baseline_flow_db: float | None = Field(description="the same, each warped half-way by optical flow first")
    depth_agreement_mm: float | None = Field(description="median |rendered - stereo depth| on held-out tissue")
    coverage: float | None = Field(description="share of tissue pixels the model covers")
    train_psnr_tissue_db: float | None = Field(description="psnr_tissue_db over some training frames, to compare")
    frames: tuple[FrameScore, ...] = ()

    warnings: tuple[Notice, ...] = Field(description="what to distrust; empty if nothing was found")
    assumptions: tuple[Notice, ...] = Field(description="what was taken for granted about the input")
    right_eye: RightEye | None = Field(
        default=None, description="how it was registered; None for a clip of one eye, or whose depth was given"
    )
    masks: Masks | None = Field(default=None, description="how instruments were masked; None: a report of version 0.2")
    field_of_view: FieldOfView | None = Field(
        default=None, description="what of the pictures shows the scene; None: a report of version 0.3"
    )
    light: LightChanges | None = Field(
        default=None, description="its changes, which the model is without; None: it hardly changes, or an older report"
    )
    poses: CameraPoses | None = Field(default=None, description="the endoscope's path; None: a report of version 0.2")
    recorded: Recorded | None = Field(
        default=None, description="recorded frames kept with the scene; None: keep_recorded was off, or version 0.2"
    )
    measurements: dict[str, float] = Field(default={}, description="measured on the input, such as misalignment in px")

    preset: str
    eyes: Eyes | None = Field(default=None, description="that taught the model; None: a report of version 0.2")
    seed: int
    device: str
    iterations: int = Field(ge=0)
    frames_seen: int | None = Field(default=None, ge=0, description="training frames in all steps, repeats counted")
    seconds: dict[str, float] = Field(description="by stage; docs/conventions.md defines t_train_s and t_post_s")
    gaussians: int = Field(ge=0)
    bases: int = Field(ge=0, description="bases per channel of motion; 0 if the model has none")
    scene_bytes: int = Field(ge=0)
    units_per_mm: float = Field(gt=0)

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    frame_count: int = Field(gt=0)
    train_count: int = Field(ge=0)
    held_out: tuple[int, ...] = Field(description="frames, counted from 0; the page counts from 1")
    repeated: tuple[int, ...] = Field(
        description="frames in neither set: blurred held-out ones, repeats of one, nothing new, or no time for them"
    )
    frame_times_s: tuple[float, ...]

    @field_validator("report_version")
    @classmethod
    def _as_it_is_read(cls, written: int) -> int:
        return max(written, REPORT_VERSION)

    @field_validator("warnings", "assumptions", mode="before")
    @classmethod
    def _of_plain_text(cls, notices: object, info: ValidationInfo) -> object:
        """Convert the notices of a report of version 1, which are texts without codes."""
        if not isinstance(notices, Iterable) or isinstance(notices, str):
            return notices
        severity = Severity.WARNING if info.field_name == "warnings" else Severity.INFO
        plain = {"code": NoticeCode.UNCLASSIFIED, "severity": severity}
        return tuple(plain | {"text": each} if isinstance(each, str) else each for each in notices)
