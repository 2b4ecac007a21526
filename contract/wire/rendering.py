"""What the service asks of the worker that holds a scene, and what comes back, over ZeroMQ.

Wire, service (DEALER) to worker (ROUTER):  [request id, WorkerRequest as JSON]
                                            A PushRequest has a third part: the pushed bytes.
Wire, worker to service:                    [request id, WorkerReply as JSON, body]
The body is the encoded image or file; requests on one connection may be answered in any order. A CancelRequest has the
id of the request that it gives up, and gets no answer.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from contract.wire.cameras import CamerasRequest, ClipCamera
from contract.wire.feeds import CutRange, FeedShown
from intrasplat.codes import known_code
from intrasplat.errors import ErrorCode
from intrasplat.formats import ExportOptions
from intrasplat.live.times import FeedTime
from intrasplat.measuring import MAX_POINTS, Point, ShapeKind
from intrasplat.names import JOB_ID_PATTERN, Detail, Eye, Light, Smoke
from intrasplat.notices import Notice
from intrasplat.picture import (
    MAX_JUDGED_PIXELS,
    Highlights,
    ImageFormat,
    IntrinsicsOverride,
    Layer,
    RecordedMasks,
    Unseen,
)
from intrasplat.pose import MatrixPose, OrbitPose

MAX_PUSH_BYTES = 48 * 1024
PUSH_REPLACED = "push"
"""The field of the error to a PushRequest whose push has ended, or in whose place another one came."""
GAUSSIAN_PIXELS = 100_000
"""So many pixels take as long as moving and projecting the Gaussians (estimated from bm_raster)."""


class PictureCamera(ClipCamera):
    """Where a picture was taken from and through which lens, in pixels of that picture (docs/conventions.md)."""

    world_from_camera: tuple[float, ...] = Field(min_length=12, max_length=12)
    """The upper three rows, row-major, translation in mm."""


class RenderRequest(BaseModel):
    """One view of one scene. t in [0, 1], later times clamp with a warning; pose None is the endoscope's own at t.

    attempt is the one whose scene was published; None asks for the newest snapshot of the job while it trains, or for a
    moment of a live feed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["render"] = "render"
    scene_id: str = Field(pattern=JOB_ID_PATTERN)
    attempt: int | None = None
    t: float = Field(ge=0, le=1e6)
    moment: FeedTime | None = Field(default=None, exclude_if=lambda moment: moment is None)
    """Of a live feed, in place of t."""
    newer_than_s: float | None = Field(default=None, exclude_if=lambda seconds: seconds is None)
    """The answer is empty if the feed's newest moment is not later than this second of its source."""
    pose: MatrixPose | OrbitPose | None = Field(default=None, discriminator="kind")
    eye: Eye = "left"
    """Whose pose and lens are taken where the caller gives none; with a pose it must be left."""
    camera: IntrinsicsOverride = IntrinsicsOverride()
    layer: Layer = Layer.RGB
    format: ImageFormat = ImageFormat.PNG
    quality: int = Field(default=90, ge=1, le=100)
    """The quality of a jpeg or webp image."""
    unseen: Unseen = Unseen.MARK
    highlights: Highlights = Highlights.ON
    light: Light = Field(default="steady", exclude_if=lambda light: light == "steady")
    smoke: Smoke = Field(default="remove", exclude_if=lambda smoke: smoke == "remove")
    detail: Detail = Field(default="on", exclude_if=lambda detail: detail == "on")
    near_mm: int | None = Field(default=None, exclude_if=lambda mm: mm is None)
    far_mm: int | None = Field(default=None, exclude_if=lambda mm: mm is None)
    """The depths of the brightest and the darkest false colour; None: the scene's own. These, light, smoke and detail
    are left out of JSON if they are the default: older workers do not know them."""
    max_pixels: int = Field(default=4096 * 2160, gt=0)
    """The most that may be drawn for it."""

    @property
    def is_from_endoscope(self) -> bool:
        """Whether it looks from the pose of the endoscope's left eye."""
        return self.pose is None and self.eye == "left"

    def most_drawn(self, clip_size: tuple[int, int]) -> list[int]:
        """Pixels of each picture that is drawn for it, at most: a wide lens shows more of the recording's pixels than
        the clip has; confidence takes a view as fine as the recording, and the endoscope's own to compare with."""
        size, clip_pixels, lens = self.camera.size(*clip_size), math.prod(clip_size), self.camera
        asked, is_own_lens = math.prod(size), lens.fx is None and lens.fy is None
        finest = clip_pixels if is_own_lens else MAX_JUDGED_PIXELS
        drawn = [max(asked, min(finest, MAX_JUDGED_PIXELS))]
        is_clips_lens = size == clip_size and is_own_lens and lens.cx is None and lens.cy is None
        if self.layer is Layer.CONFIDENCE and not (self.is_from_endoscope and is_clips_lens):
            drawn.append(clip_pixels)
            if asked > finest or not is_own_lens:
                drawn.append(min(asked, finest))
        return [min(each, self.max_pixels) for each in drawn]


class ExportRequest(BaseModel):
    """One part of a scene as a file of one of EXPORT_FORMATS, asked for one after the other while `more` follow.

    A worker forgets an export whose next part nobody asks for. An empty part says that the worker is at work.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["export"] = "export"
    scene_id: str = Field(pattern=JOB_ID_PATTERN)
    attempt: int
    """0 of a live feed."""
    moment: FeedTime | None = Field(default=None, exclude_if=lambda moment: moment is None)
    """Of a live feed: its segment of the past is exported."""
    format: str = Field(default="ply", max_length=32)
    options: ExportOptions = ExportOptions()
    export_id: str = Field(pattern=r"^[0-9a-f]{32}$")
    """Chosen by the asker, the same for all parts."""
    part: int = Field(default=0, ge=0)


class RecordedRequest(BaseModel):
    """The recorded frame nearest to time t, as JPEG, or its mask as PNG; attempt as in RenderRequest."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["recorded"] = "recorded"
    scene_id: str = Field(pattern=JOB_ID_PATTERN)
    attempt: int | None = None
    t: float = Field(ge=0, le=1e6)
    moment: FeedTime | None = Field(default=None, exclude_if=lambda moment: moment is None)
    eye: Eye = "left"
    masks: RecordedMasks = RecordedMasks.MARKED


class MeasureRequest(BaseModel):
    """The Measurement of some points of a view of a finished scene, as JSON. t, pose and camera as in RenderRequest."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["measure"] = "measure"
    scene_id: str = Field(pattern=JOB_ID_PATTERN)
    attempt: int
    t: float = Field(ge=0, le=1e6)
    moment: FeedTime | None = Field(default=None, exclude_if=lambda moment: moment is None)
    pose: MatrixPose | OrbitPose | None = Field(default=None, discriminator="kind")
    camera: IntrinsicsOverride = IntrinsicsOverride()
    points: tuple[Point, ...] = Field(min_length=1, max_length=MAX_POINTS)
    shape: ShapeKind | None = Field(default=None, exclude_if=lambda shape: shape is None)
    """What the points make together; left out of JSON without one: older workers do not know it."""
    max_pixels: int = Field(default=4096 * 2160, gt=0)


class CutRequest(BaseModel):
    """One part of the recording of a live feed as a video file, asked for one after the other while `more` follow.

    begins and ends are UNIX times of the arrival of pairs, or seconds of the source. The file begins and ends at key
    frames. media_type is video/mp4 or video/x-matroska. A first part without bytes says that the file is being made.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["cut"] = "cut"
    scene_id: str = Field(pattern=JOB_ID_PATTERN)
    begins: FeedTime
    ends: FeedTime
    export_id: str = Field(pattern=r"^[0-9a-f]{32}$")
    """Chosen by the asker, the same for all parts."""
    part: int = Field(default=0, ge=0)

    @property
    def attempt(self) -> None:
        """A feed has none."""
        return None


class PushRequest(BaseModel):
    """The next bytes of the video that a caller pushes, as the body of the message: at most MAX_PUSH_BYTES.

    The answer comes when the feed has taken them. The bodies of one push are one stream of bytes: a picture may go over
    several. is_last: the caller's connection has ended.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["push"] = "push"
    scene_id: str = Field(pattern=JOB_ID_PATTERN)
    push_id: str = Field(pattern=r"^[0-9a-f]{32}$")
    """Of the connection. A feed takes one at a time; a new one takes the place of the one before."""
    pictures: bool = False
    """Each picture is a PICTURE_HEADER and a JPEG or WebP of both eyes."""
    is_last: bool = False

    @property
    def attempt(self) -> None:
        """A feed has none."""
        return None


class CancelRequest(BaseModel):
    """Nobody waits any more for the answer to the request of the same id."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["cancel"] = "cancel"


SceneRequest: TypeAlias = RenderRequest | ExportRequest | RecordedRequest | CamerasRequest | MeasureRequest
"""What is asked of a scene."""
FeedRequest: TypeAlias = RenderRequest | ExportRequest | RecordedRequest | MeasureRequest | CutRequest | PushRequest
"""What is asked of a live feed."""


class WorkerRequest(BaseModel):
    """The envelope: one of the requests above."""

    request: SceneRequest | CutRequest | PushRequest | CancelRequest = Field(discriminator="kind")
    trace: str | None = None
    """The W3C traceparent of who asks. A worker that knows no traces ignores it."""


class ReplyError(BaseModel):
    """A request that could not be answered; `kind` decides the HTTP status."""

    kind: Literal["input", "scene", "not-yet", "busy", "internal"]
    """not-yet: the job runs here and has no snapshot so far. busy: ask again after retry_after_s."""
    problem: str
    field: str | None = None
    remedy: str | None = None
    code: Annotated[ErrorCode, known_code(ErrorCode)] = ErrorCode.UNCLASSIFIED
    """Of an input error that has a code of its own."""
    retry_after_s: float | None = None
    """When the request will probably be answered, in seconds from now."""


class WorkerReply(BaseModel):
    """The head of an answer; exactly one of error and a body is there."""

    error: ReplyError | None = None
    media_type: str = "application/octet-stream"
    t: float = 0.0
    warnings: tuple[Notice, ...] = ()
    iteration: int | None = None
    """The iteration of the snapshot that is shown; None: the scene is finished."""
    unseen: float = 0.0
    """Share of a render's pixels that no training frame saw, in [0, 1]."""
    detail: float = 0.0
    """Share of a render's tissue whose detail comes from recorded frames, in [0, 1]."""
    render_ms: float = 0.0
    gaussians: int = 0
    """Number of Gaussians of the scene that is shown; 0: not known."""
    clip_size: tuple[int, int] | None = None
    """Width and height of the clip in pixels: the image's where the request names none."""
    camera: PictureCamera | None = None
    """The camera of a render; None for other answers."""
    feed: FeedShown | None = None
    """The moment that is shown, of a live feed."""
    cut: CutRange | None = Field(default=None, exclude_if=lambda cut: cut is None)
    """What the file holds whose first part this is; None for other answers."""
    more: bool = False
    """More parts of the export follow."""
    depth_range_mm: tuple[float, float] | None = None
    """The depths of the brightest and the darkest colour, for depth in false colours; the same throughout the clip."""


TYPICAL_GAUSSIANS, TYPICAL_SIZE = 50_000, (640, 512)
"""Assumed number of Gaussians and picture size of a scene about which nothing is known yet."""


def render_cost(pixels: int, gaussians: int) -> float:
    """The cost of a render, in pixels x Gaussians. Work on each Gaussian counts as GAUSSIAN_PIXELS more pixels."""
    return float(pixels + GAUSSIAN_PIXELS) * gaussians


class WorkerAddress(BaseModel):
    """What a live worker announces: where it answers requests, on which device, and what it has at hand."""

    name: str
    endpoint: str
    device: str
    job_id: str | None = None
    """The job it runs."""
    scenes: tuple[str, ...] = ()
    """Scenes it holds in memory."""
    renders_only: bool = False
    """It claims no jobs."""
    feed_id: str | None = None
    """The live feed that it follows: it answers requests for that alone."""
    missing_extras: tuple[str, ...] = ()
    """The extras of EXTRA_MODULES (intrasplat/formats.py) that it lacks: it makes no exports that need them."""
