"""The service's types. Generated from contract/wire by `python -m client.generate_models`; do not edit."""
# long: generated; it holds every type of the API

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, with_config
from typing_extensions import TypedDict


class Model(BaseModel):
    """Accepts and keeps fields that it does not know, so that this client can read the answers of a newer service."""

    model_config = ConfigDict(frozen=True, extra="allow")


class DeliveryStatus(StrEnum):
    """Where the delivery of a webhook stands."""

    OWED = "owed"
    DELIVERED = "delivered"
    FAILED = "failed"


class ErrorCode(StrEnum):
    """The kind of an error, for programs; docs/codes.md explains each."""

    ATTEMPTS_EXHAUSTED = "attempts_exhausted"
    CANCELLED = "cancelled"
    FAULT = "fault"
    INPUT = "input"
    KEY_EXPIRED = "key_expired"
    LIMIT = "limit"
    MISSING_EXTRA = "missing_extra"
    NOT_LISTED = "not_listed"
    NOT_YET = "not_yet"
    OUT_OF_MEMORY = "out_of_memory"
    FEEDS_FULL = "feeds_full"
    QUEUE_FULL = "queue_full"
    RECORD_UNREADABLE = "record_unreadable"
    RESUME_MISMATCH = "resume_mismatch"
    SCENE = "scene"
    STORE_FULL = "store_full"
    DECODER_KILLED = "decoder_killed"
    TRAINING_DIVERGED = "training_diverged"
    UNAVAILABLE = "unavailable"
    UNCLASSIFIED = "unclassified"


class FeedReason(StrEnum):
    """Why a feed is in its state, why its last segment ended, or why nothing is recorded."""

    UNREACHABLE = "unreachable"
    HOST_REFUSED = "host_refused"
    REDIRECTED = "redirected"
    REFUSED = "refused"
    CLOSED = "closed"
    SILENT = "silent"
    UNDECODABLE = "undecodable"
    NO_VIDEO = "no_video"
    TIMES_JUMPED = "times_jumped"
    SIZE_CHANGED = "size_changed"
    PACKING_CHANGED = "packing_changed"
    PACKING_UNKNOWN = "packing_unknown"
    PICTURE_LIMIT = "picture_limit"
    DECODER_ENDED = "decoder_ended"
    DECODER_MEMORY = "decoder_memory"
    TOO_SLOW = "too_slow"
    FAULT = "fault"
    NO_WORKER = "no_worker"
    UNCLASSIFIED = "unclassified"
    BY_HAND = "by_hand"
    END_OF_FILE = "end_of_file"
    NO_SCENE = "no_scene"
    CALIBRATION = "calibration"
    DISK_FULL = "disk_full"
    DISK_FAILS = "disk_fails"
    DISK_SLOW = "disk_slow"
    NOT_RECORDABLE = "not_recordable"


class FeedState(StrEnum):
    """What a feed does now."""

    CONNECTING = "connecting"
    LIVE = "live"
    BEHIND = "behind"
    STALLED = "stalled"
    PAUSED = "paused"
    NO_TISSUE = "no_tissue"
    ENDED = "ended"


class FeedWish(StrEnum):
    """What the caller wants of a feed."""

    RUN = "run"
    PAUSE = "pause"
    END = "end"


class JobState(StrEnum):
    """Where a job stands."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class NoticeCode(StrEnum):
    """The kind of a notice. Two notices of one code differ in their numbers and names only."""

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
    BASES = "bases"
    EARLY_STOPPING = "early_stopping"
    EXPOSURE = "exposure"
    SMOKE = "smoke"
    SPACING = "spacing"
    STORED_PRECISION = "stored_precision"
    VIGNETTING = "vignetting"
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
    UNCLASSIFIED = "unclassified"


class RefusalCode(StrEnum):
    """Why nothing is measured at a point; docs/codes.md explains each."""

    LOW_CONFIDENCE = "low_confidence"
    UNSEEN = "unseen"


class Severity(StrEnum):
    """info: good to know; warning: a reason to distrust the result."""

    INFO = "info"
    WARNING = "warning"


class ShapeKind(StrEnum):
    """What points make together: a line of straight pieces in space, a polygon of flat triangles, or the angle at
    the second of three points.
    """

    LINE = "line"
    AREA = "area"
    ANGLE = "angle"


class TryFailure(StrEnum):
    """Why one try to deliver a webhook failed; docs/codes.md explains each."""

    ADDRESS_REFUSED = "address_refused"
    CERTIFICATE = "certificate"
    FAULT = "fault"
    HOST_REFUSED = "host_refused"
    STATUS = "status"
    TIMEOUT = "timeout"
    UNREACHABLE = "unreachable"
    UNCLASSIFIED = "unclassified"


class CameraPoses(Model):
    """Where the endoscope was. Tissue that moves as a whole looks like a camera that moves the other way; what of
    the common motion follows the course of the tissue's own deformation was taken to be the tissue's.
    """

    source: str
    """given with the clip; fixed: asked for or recognised; estimated from the pictures"""
    path_mm: float | None = None
    """length of the path; None: it was not estimated, or the camera is fixed"""
    extent_mm: float | None = None
    """largest distance between two frames' cameras"""
    extent_deg: float | None = None
    """largest rotation between two frames' cameras"""
    steadied_mm: float | None = None
    """how far given poses jumped at the tissue before they were steadied; None: they were not"""
    sigma_mm: float | None = None
    """standard deviation that is expected of the path, laid on the true one"""
    sigma_deg: float | None = None
    """the same of the rotation"""
    rigid_fit_mm: float | None = None
    """median distance at the tissue by which matches miss what the path predicts"""
    tissue_mm: float | None = None
    """root mean square of the common motion that was taken to be the tissue's"""
    tissue_period_s: float | None = None
    """period of that motion, if it has one"""
    unsure_frames: tuple[int, ...] = ()
    """frames whose pose is not to be relied on"""


class ClipCamera(Model):
    """The clip's pinhole camera in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


class CutRange(Model):
    """What a cut holds. All times are of the arrival of pairs, UNIX s."""

    from_s: float
    """of its first frame"""
    to_s: float
    """of its last frame"""
    frames: int
    is_whole: bool = True
    """whether it holds all frames of the range that are recorded so far: after a change of size or coding it holds
    only what came later. The newest seconds are recorded a little later: to_s says where it ends
    """


class Delivery(Model):
    """A webhook about one end of a job, and all tries to deliver it so far."""

    event_id: str
    """the header webhook-id, the same at every try"""
    state: JobState
    """the state in which the job ended"""
    error_code: str | None = None
    """the code of a failed job's error"""
    ended_at_s: float
    """when the job ended, UNIX s"""
    status: Annotated[DeliveryStatus | str, Field(union_mode="left_to_right")] = DeliveryStatus.OWED
    tries: tuple[DeliveryTry, ...] = ()
    forgiven_tries: int = 0
    """how many of them no longer count, because a caller had the webhook sent again since"""
    next_try_at_s: float | None = None
    """time of the next try, UNIX s; None: a try is in progress, or there is none to come"""


class DeliveryTry(Model):
    """One try to deliver a webhook."""

    at_s: float
    """when it began, UNIX s"""
    status_code: int | None = None
    """the receiver's answer; None if there was none"""
    failure: Annotated[TryFailure | str, Field(union_mode="left_to_right")] | None = None
    """why it failed; None: the webhook was delivered"""
    retry_after_s: float | None = None
    """for how long a receiver that answered 429 or 503 asked to be left alone (Retry-After)"""


class DetailScores(Model):
    """Scores of a scene's views with detail from the recorded training frames, of the same held-out frames."""

    psnr_tissue_db: float | None
    psnr_right_db: float | None
    ssim: float | None


class ExportOffer(Model):
    """A format of GET /scenes/{id}/export for one scene, and whether this installation can make it."""

    format: str
    about: str
    file_name: str
    """after the scene's label; what the export's Content-Disposition says, too"""
    media_type: str
    options: tuple[str, ...]
    """the options that fit"""
    views: tuple[str, ...] = ()
    """of a video: the views that this scene has"""
    needs: str | None = None
    """what must be installed where the worker runs before it can be made; null: nothing"""


class FeedOptions(Model):
    """The options of POST /feeds."""

    source: str | None = None
    """where the video is: rtsp(s)://, tcp:// or udp:// (MPEG-TS), http(s)://; left out, you push it: PUT
    /feeds/{id}/video, or the WebSocket /feeds/{id}/pictures
    """
    layout: str = "auto"
    """two eyes in one picture, side by side or top-bottom, or in two streams of one source"""
    label: str | None = None
    """a short text to find the job by. Not for names of persons: whoever may view the job reads it."""
    keep_s: float = 300.0
    """seconds of the past that can be viewed and cut out"""
    width: int | None = None
    """width in pixels of the pictures that the model learns; left out, what the machine keeps up with"""
    camera: str = "fixed"
    """fixed: the endoscope's motion counts as the tissue's"""


class FeedReceipt(Model):
    """What is left of a feed that was ended."""

    feed_id: str
    ended_at: str
    """ISO 8601, UTC: when it was asked for"""
    bytes: int
    """bytes that the feed had on disk, as its worker last reported them"""
    record: bool
    """the queue has no record of it any more, so its worker has deleted all files"""
    verified: bool
    """the data directory was searched for files of the feed, and has none"""


class FeedView(Model):
    """A feed as the API shows it: what was asked for, and what its worker said of it last."""

    state: Annotated[FeedState | str, Field(union_mode="left_to_right")]
    reason: Annotated[FeedReason | str, Field(union_mode="left_to_right")] | None = None
    """why it is in this state; null while all is well"""
    text: str = ""
    """the same for people; its words may change"""
    since_s: float
    """when the state began"""
    recording: Annotated[FeedReason | str, Field(union_mode="left_to_right")] | None = None
    """why nothing is recorded at the moment; null, the good case: it is being recorded"""
    received_fps: float = 0.0
    """pairs that came in a second, over the last seconds"""
    used_fps: float = 0.0
    """pairs that the model learnt a second, over the last seconds"""
    dropped: int = 0
    """whole pairs that came in and that the model did not learn, in all; no loss of the recording"""
    model_age_s: float | None = None
    """from the arrival of the newest pair that the model knows until now"""
    decode_lag_s: float | None = None
    """from the arrival of a pair to its picture"""
    reconnects: int = 0
    """connections after the first"""
    last_frame_at_s: float | None = None
    """when the newest pair arrived"""
    stored_bytes: int = 0
    """bytes of the recording and of the model's past on disk"""
    begins_s: float | None = None
    """the oldest moment that can be viewed; null: none yet"""
    ends_s: float | None = None
    """the newest moment that can be viewed"""
    source_begins_s: float | None = None
    """begins_s in seconds of the source"""
    source_ends_s: float | None = None
    """ends_s in seconds of the source"""
    width: int | None = None
    """of the pictures that the model learns, in pixels"""
    height: int | None = None
    gaussians: int = 0
    id: str
    label: str | None = None
    wish: Annotated[FeedWish | str, Field(union_mode="left_to_right")]
    """what its caller wants; the state follows within a second"""
    options: FeedOptions
    """as they were given, the source without user and password"""
    created_at_s: float
    links: dict[str, str]


class FieldOfView(Model):
    """The part of the pictures that shows the scene. Outside it the model has nothing (docs/conventions.md)."""

    source: str
    """found in the pictures; given: the left eye's by the caller; all: the whole picture, as asked"""
    share: float
    """share of the left eye's picture"""
    shape: str
    """of its border; whole: the picture has none"""
    right_share: float | None = None
    """share of the right eye's; None: one eye"""
    label_share: float = 0.0
    """share of the picture under labels and menus"""


class FrameScore(Model):
    """One held-out frame: the model's scores and those of copying its neighbours. None: no tissue to judge."""

    frame: int
    """counted from 0; the page counts from 1"""
    scored: bool = True
    """False: the scores, and what they warn of, are still being measured; ask again"""
    psnr_tissue_db: float | None
    psnr_paper_db: float | None
    ssim: float | None
    coverage: float | None
    baseline_blend_db: float | None
    baseline_flow_db: float | None
    psnr_right_db: float | None = None
    """None for a clip of one eye, too"""


class Imported(Model):
    """Where a scene came from that was made by another installation."""

    scene_id: str | None = None
    """its id there; None: it was exported from a folder"""
    version: str
    """version of intrasplat that exported it"""
    exported_at_s: float
    """when it was exported, UNIX s, by the clock there"""
    imported_at_s: float
    """when it was imported, UNIX s"""


class JobError(Model):
    """Why a job failed: its kind, one sentence, the field at fault if it was the input, and what to do about it."""

    code: Annotated[ErrorCode | str, Field(union_mode="left_to_right")] = ErrorCode.UNCLASSIFIED
    problem: str
    field: str | None = None
    remedy: str | None = None


class JobOptions(Model):
    """How a service reconstructs a clip; the `options` field of POST /reconstruct."""

    layout: str = "auto"
    """how the clip's eyes, depths and masks are laid out"""
    mask_polarity: str = "auto"
    """what is bright in the masks"""
    mask_source: str = "auto"
    """masks of instruments. auto: the clip's, else the segmenter's if there is one, else found by colour and
    depth; given: the clip's or the segmenter's; none: every pixel is tissue
    """
    pose_convention: str = "opengl"
    """axes of poses_bounds.npy"""
    holdout: str = "every8"
    """frames to measure quality on, never to train on: every8, blocks8, none, or frame numbers such as 1,9,17"""
    preset: str = "fast"
    """instant, fast, quality and small are ours; paper is the method as published"""
    eyes: str = "both"
    """the eyes of a stereo clip that our presets train on; with left, the right eye only judges"""
    use_frames: str = "new"
    """new leaves out frames of a long clip that show nothing new, such as repeats and pauses"""
    poses: str = "auto"
    """the camera's poses: given with the clip or in a file, fixed, or to estimate; auto decides"""
    fov: str = "auto"
    """the part of the pictures that shows the scene: auto leaves out borders, bars and labels; all: everything"""
    min_depth_mm: float = 10.0
    """nearest depth that stereo may find, in mm"""
    max_depth_mm: float = 300.0
    """farthest depth that stereo may find, in mm"""
    iterations: int | None = None
    """exactly how many steps to train; not with budget_s"""
    budget_s: float | None = None
    """about how many seconds to train, often less; not with iterations"""
    seed: int = 0
    """seed of all random numbers"""
    keep_recorded: str = "on"
    """whether recorded frames and their masks are kept with the scene, to compare the model with"""
    priority: str = "standard"
    """high: before standard jobs, and in place of a running one"""
    retention_hours: float | None = None
    """hours after its end until the job is purged: clip, scene and record"""


class JobView(Model):
    """A job as the API shows it."""

    id: str
    label: str | None = None
    """what its caller calls it; PATCH /jobs/{id} changes it"""
    metadata: dict[str, str] = Field(default={})
    """what its caller noted on it"""
    state: JobState
    stage: str | None = None
    fraction: float | None = None
    iteration: int | None = None
    iterations: int | None = None
    psnr_db: float | None = None
    """last score on held-out frames of the left eye"""
    psnr_right_db: float | None = None
    """the same of the right eye; None without one"""
    seconds_left: float | None = None
    """of training, as it reports them; only while it runs"""
    position: int | None = None
    """jobs that will be claimed before this one; while queued; null in the list of jobs"""
    eta_s: float | None = None
    """estimated seconds until it is done; null if unknown, and in the list of jobs"""
    error: JobError | None = None
    cancel_requested: bool = False
    attempt: int = 0
    options: JobOptions
    input_bytes: int
    clip_of: str | None = None
    """the job that the clip came with first, if not with this one"""
    imported: bool = False
    """it takes in a scene that another installation made"""
    created_at_s: float
    started_at_s: float | None = None
    finished_at_s: float | None = None
    links: dict[str, str]


class LightChanges(Model):
    """Changes of the light in the left eye's pictures, by frame, that the model is without (docs/conventions.md).

    A frame that was not trained on has values interpolated in time.
    """

    reference: int | None = None
    """frame whose exposure and white balance the model has; None: they hardly change"""
    stops: tuple[float, ...] | None = None
    """exposure of every frame against that of reference, in stops; None as there"""
    red: tuple[float, ...] | None = None
    """white balance: the gain of recorded red over that of green in every frame, against reference; None as there"""
    blue: tuple[float, ...] | None = None
    """the same of blue"""
    smoke_share: tuple[float, ...] | None = None
    """mean share of the light that smoke takes over the picture, in every frame; None: none was found"""
    vignetting: float | None = None
    """brightness of tissue at the border over that in the middle, where it differs most; None: the border is
    hardly darker, or the camera does not move
    """


class Masks(Model):
    """How instruments were distinguished from tissue."""

    source: str
    """given with the clip; found by colour and depth; by this installation's segmenter; none: every pixel counts
    as tissue
    """
    share: float = 0.0
    """share of the left eye's field of view that is no tissue"""
    sure: float | None = None
    """how clearly found instruments were distinguished from tissue; None: no masks were found"""


class MeasuredDistance(Model):
    """How far the two points are apart in space, at every frame; the tissue carries them along.

    Null where a place is out of the endoscope's view for too long to be trusted. Lists have T entries.
    """

    distance_mm: float
    """at the time asked for"""
    uncertainty_mm: float
    """about 95 % of the true distances lie within it"""
    t: tuple[float, ...]
    """times of the frames"""
    time_s: tuple[float, ...]
    """seconds of the frames, from the first one"""
    distances_mm: tuple[float | None, ...]
    """at every frame"""
    uncertainties_mm: tuple[float | None, ...]
    """those of distances_mm"""
    first_mm: tuple[tuple[float, ...], ...]
    """where the first point is in the world at every frame"""
    second_mm: tuple[tuple[float, ...], ...]
    """where the second point is in the world at every frame"""


class MeasuredPoint(Model):
    """What is seen at a point of the picture. A point that is refused has no numbers but its confidence."""

    x: float
    """as asked for, in pixels of the picture"""
    y: float
    """as asked for, in pixels of the picture"""
    confidence: float
    """in [0, 1], as the layer confidence has it"""
    depth_mm: float | None = None
    """along the camera's z, as the layer depth has it"""
    uncertainty_mm: float | None = None
    """about 95 % of the true depths lie within it"""
    point_mm: tuple[float, ...] | None = None
    """the place in the world"""
    mm_per_px: float | None = None
    """width of a pixel at this depth, across the view"""
    refusal: Refusal | None = None


class MeasuredShape(Model):
    """A length in mm, an area in mm2 or an angle in degrees, at every frame; the tissue carries its points along.

    Null where a point is out of the endoscope's view for too long to be trusted. Lists have T entries.
    """

    kind: Annotated[ShapeKind | str, Field(union_mode="left_to_right")]
    unit: str
    value: float
    """at the time asked for"""
    uncertainty: float
    """about 95 % of the true values lie within it"""
    pieces_mm: tuple[float, ...]
    """of a line: the length of each piece at the time asked for"""
    piece_uncertainties_mm: tuple[float, ...]
    """those of pieces_mm"""
    t: tuple[float, ...]
    """times of the frames"""
    time_s: tuple[float, ...]
    """seconds of the frames, from the first one"""
    values: tuple[float | None, ...]
    """at every frame"""
    uncertainties: tuple[float | None, ...]
    """those of values"""
    trust: tuple[float, ...]
    """at every frame: the least confidence of a point, times the share of its trust that is left"""
    places_mm: tuple[tuple[tuple[float, ...], ...], ...]
    """where each point is in the world: a list for each point, with a place for every frame"""


class Measurement(Model):
    """What was measured in one view of a finished scene."""

    t: float
    """the time that is shown"""
    points: tuple[MeasuredPoint, ...]
    distance: MeasuredDistance | None = None
    """the distance of two points, if no shape is asked for; null for any other number of points, and where a point
    is refused
    """
    shape: MeasuredShape | None = None
    """what the points make together, if that is asked for and no point is refused"""
    depth_range_mm: tuple[float, ...]
    """depths of the brightest and the darkest false colour of layer=depth from this pose"""
    warnings: tuple[Notice, ...]
    """reasons not to rely on the scene; every view repeats them"""
    notice: str = "Research use only. Not a medical device; it must not guide treatment."


class Notice(Model):
    """One thing to know about a scene or a picture."""

    code: Annotated[NoticeCode | str, Field(union_mode="left_to_right")]
    severity: Annotated[Severity | str, Field(union_mode="left_to_right")]
    text: str


class Recorded(Model):
    """Which recorded frames a scene keeps, as its cameras see them: rectified, with corrected colours."""

    frames: tuple[int, ...]
    """the clip's frames that are kept, rising"""
    eyes: tuple[str, ...]
    """the eyes whose frames are kept"""
    width: int
    """width of a picture in pixels"""
    height: int
    """height of a picture in pixels"""
    masks: bool
    """whether masks are kept with them; False: every pixel counts as tissue"""
    size_bytes: int
    """what they take on the disk"""
    pixels: RecordedPixels | None = None
    """which pixels of the recording they show; None: the report is of an earlier version"""


class RecordedPixels(Model):
    """The left eye's pixels as they were recorded, and which of them a pixel (x, y) of a stored frame shows.

    x, y count in pixels of the full size, from the middle of the first one. With (X, Y, Z) = rays (x, y, 1),
    the recorded pixel is camera (D(X / Z, Y / Z), 1), where D is OpenCV's distortion. The defaults move
    nothing.
    """

    width: int
    """width of the recorded eye in pixels"""
    height: int
    """height of the recorded eye in pixels"""
    rays: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    """3x3, row-major"""
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients k1 k2 p1 p2 k3 and on"""
    camera: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    """3x3, row-major"""


class Refusal(Model):
    """Why nothing is measured at a point, and what to do."""

    code: Annotated[RefusalCode | str, Field(union_mode="left_to_right")]
    field: str
    """the point, such as points[0]"""
    problem: str
    remedy: str


class Report(Model):
    """Every finished scene has one. A figure is None only if it could not be measured, and then warnings say why;
    or while `scored` is False: a scene is finished before its scores are.

    Scores are means over the held-out frames, which took no part in training (docs/conventions.md, "Scores").
    psnr_tissue_db is the one to go by; psnr_paper_db is what papers print, and higher. When psnr_tissue_db does
    not exceed the two baselines, copying the neighbouring frames would have served as well.
    """

    report_version: int = 2
    notice: str = "Research use only. Not a medical device; it must not guide treatment."
    imported: Imported | None = None
    """where the scene came from; None: it was made here"""
    versions: dict[str, str] = Field(default={})
    """versions of intrasplat and of what it computes with"""
    scored: bool = True
    """False: the scores, and what they warn of, are still being measured; ask again"""
    psnr_tissue_db: float | None
    psnr_paper_db: float | None
    psnr_clear_db: float | None = None
    """psnr_tissue_db without highlights"""
    psnr_right_db: float | None = None
    """psnr_tissue_db of the right eye's frames, over what the left eye sees, too; None for one eye"""
    psnr_right_clear_db: float | None = None
    """the same without highlights"""
    baseline_warp_db: float | None = None
    """psnr_right_db of the left eye's picture warped by stereo depth"""
    baseline_warp_clear_db: float | None = None
    """the same without highlights"""
    ssim: float | None
    detail: DetailScores | None = None
    """scores of views with detail from recorded frames, which callers see by default; the others are of the model
    alone. None: recorded frames are not kept, or version 0.3
    """
    baseline_blend_db: float | None
    """psnr_tissue_db of blending the nearest training frames"""
    baseline_flow_db: float | None
    """the same, each warped half-way by optical flow first"""
    depth_agreement_mm: float | None
    """median |rendered - stereo depth| on held-out tissue"""
    coverage: float | None
    """share of tissue pixels the model covers"""
    train_psnr_tissue_db: float | None
    """psnr_tissue_db over some training frames, to compare"""
    frames: tuple[FrameScore, ...] = ()
    warnings: tuple[Notice, ...]
    """what to distrust; empty if nothing was found"""
    assumptions: tuple[Notice, ...]
    """what was taken for granted about the input"""
    right_eye: RightEye | None = None
    """how it was registered; None for a clip of one eye, or whose depth was given"""
    masks: Masks | None = None
    """how instruments were masked; None: a report of version 0.2"""
    field_of_view: FieldOfView | None = None
    """what of the pictures shows the scene; None: a report of version 0.3"""
    light: LightChanges | None = None
    """its changes, which the model is without; None: it hardly changes, or an older report"""
    poses: CameraPoses | None = None
    """the endoscope's path; None: a report of version 0.2"""
    recorded: Recorded | None = None
    """recorded frames kept with the scene; None: keep_recorded was off, or version 0.2"""
    measurements: dict[str, float] = Field(default={})
    """measured on the input, such as misalignment in px"""
    preset: str
    eyes: str | None = None
    """that taught the model; None: a report of version 0.2"""
    seed: int
    device: str
    iterations: int
    frames_seen: int | None = None
    """training frames in all steps, repeats counted"""
    seconds: dict[str, float]
    """by stage; docs/conventions.md defines t_train_s and t_post_s"""
    gaussians: int
    bases: int
    """bases per channel of motion; 0 if the model has none"""
    scene_bytes: int
    units_per_mm: float
    width: int
    height: int
    frame_count: int
    train_count: int
    held_out: tuple[int, ...]
    """frames, counted from 0; the page counts from 1"""
    repeated: tuple[int, ...]
    """frames in neither set: blurred held-out ones, repeats of one, nothing new, or no time for them"""
    frame_times_s: tuple[float, ...]


class RightEye(Model):
    """What the right eye differs by from its calibration and from the left eye, measured on training frames.

    Its camera was corrected by the turn, its pictures by the colours. What an error of the calibration does
    along the rows looks like depth, and is not known.
    """

    moved_px: float
    """largest shift of any pixel by the turn and the zoom"""
    lower_px: float
    """rows by which the right picture lies lower at its principal point"""
    pitch_deg: float
    """rotation of the right eye about its x axis, as the left eye sees it"""
    yaw_deg: float
    """about its y axis; the principal point keeps its column"""
    roll_deg: float
    """about its z axis"""
    zoom: float
    """focal length over the calibrated one, minus 1"""
    left_from_right: tuple[float, ...]
    """4x4, row-major, mm: its pose seen from the left eye"""
    fx_px: float
    """focal length of the corrected camera, in columns"""
    fy_px: float
    """and in rows"""
    cx_px: float
    """column of its principal point"""
    cy_px: float
    """and its row"""
    matches: int | None = None
    """features by which the turn was measured. 0: nothing was measured, and turn and zoom are 0; fewer than 150:
    lower_px alone. None: a report of before they were counted
    """
    residual_px: float
    """median distance of the rows of matching features after that"""
    gain: tuple[float, ...]
    """right = gain * left + offset, by channel; 1 and 0: nothing was corrected"""
    offset: tuple[float, ...]
    """in levels of 255"""
    colour_correlation: float | None
    """correlation of the eyes' colours at matches, in the worst channel; None: too few matches"""


class SceneCameras(Model):
    """The cameras that a scene knows; while its job trains, so far as they are known."""

    intrinsics: ClipCamera
    frame_times_s: tuple[float, ...]
    """times of the T frames, from the first one"""
    world_from_camera: tuple[tuple[tuple[float, ...], ...], ...]
    """the endoscope's poses: T row-major 4x4, mm"""
    trained_t: tuple[float, ...]
    """times of the K frames that taught the scene, i / T"""
    units_per_mm: float
    """60 / the median depth in mm"""
    right_eye_mm: tuple[float, ...] | None = None
    """where the right eye is, in the left one's axes; null: one eye taught the scene"""


TERMINAL_STATES = frozenset({JobState.CANCELLED, JobState.DONE, JobState.FAILED})
"""States that a job does not leave by itself."""


EXCLUSIVE_OPTIONS = (("iterations", "budget_s"),)
"""At most one option of each group may be given."""


@with_config(ConfigDict(extra="forbid"))
class GivenOptions(TypedDict, total=False):
    """What a caller may choose about a reconstruction: the keyword arguments of Client.reconstruct."""

    layout: Literal["auto", "endonerf", "stereomis", "sbs", "tb", "frames"]
    """how the clip's eyes, depths and masks are laid out"""
    mask_polarity: Literal["auto", "tool", "tissue"]
    """what is bright in the masks"""
    mask_source: Literal["given", "auto", "none"]
    """masks of instruments. auto: the clip's, else the segmenter's if there is one, else found by colour and
    depth; given: the clip's or the segmenter's; none: every pixel is tissue
    """
    pose_convention: Literal["opengl", "llff"]
    """axes of poses_bounds.npy"""
    holdout: Annotated[str, Field(max_length=8000, pattern="^(every8|blocks8|none|\\d{1,6}(,\\d{1,6})*)$")] | list[int]
    """frames to measure quality on, never to train on: every8, blocks8, none, or frame numbers such as 1,9,17"""
    preset: Literal["instant", "fast", "quality", "small", "paper"]
    """instant, fast, quality and small are ours; paper is the method as published"""
    eyes: Literal["left", "both"]
    """the eyes of a stereo clip that our presets train on; with left, the right eye only judges"""
    use_frames: Literal["new", "all"]
    """new leaves out frames of a long clip that show nothing new, such as repeats and pauses"""
    poses: Literal["auto", "given", "fixed", "estimate"]
    """the camera's poses: given with the clip or in a file, fixed, or to estimate; auto decides"""
    fov: Literal["auto", "all"]
    """the part of the pictures that shows the scene: auto leaves out borders, bars and labels; all: everything"""
    min_depth_mm: Annotated[float, Field(gt=0)]
    """nearest depth that stereo may find, in mm"""
    max_depth_mm: Annotated[float, Field(gt=0)]
    """farthest depth that stereo may find, in mm"""
    iterations: Annotated[int, Field(le=1000000, ge=1)] | None
    """exactly how many steps to train; not with budget_s"""
    budget_s: Annotated[float, Field(gt=0, le=7200)] | None
    """about how many seconds to train, often less; not with iterations"""
    seed: Annotated[int, Field(lt=2147483648, ge=0)]
    """seed of all random numbers"""
    keep_recorded: Literal["on", "off"]
    """whether recorded frames and their masks are kept with the scene, to compare the model with"""
    priority: Literal["standard", "high"]
    """high: before standard jobs, and in place of a running one"""
    retention_hours: Annotated[float, Field(gt=0, le=87600)] | None
    """hours after its end until the job is purged: clip, scene and record"""
