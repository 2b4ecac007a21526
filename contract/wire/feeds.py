"""A live feed: what its caller asked for, who follows it, what that worker last said of it, and the moments of it that
a view may show."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from contract.wire.job import LOCAL_TENANT, TENANT_PATTERN, Forecast, JobRecord, JobView
from contract.wire.labels import LABEL_ABOUT, Label
from intrasplat.codes import known_code
from intrasplat.live.spec import MAX_KEEP_S, MAX_URL_CHARACTERS, without_user
from intrasplat.live.state import FeedReason, FeedState
from intrasplat.names import JOB_ID_PATTERN


class FeedWish(StrEnum):
    """What the caller wants of a feed."""

    RUN = "run"
    PAUSE = "pause"
    END = "end"
    """Its worker stops, deletes all that belongs to it, and removes the record."""


class FeedOptions(BaseModel):
    """The options of POST /feeds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str | None = Field(
        default=None,
        max_length=MAX_URL_CHARACTERS,
        repr=False,
        description="where the video is: rtsp(s)://, tcp:// or udp:// (MPEG-TS), http(s)://; left out, you push it: "
        "PUT /feeds/{id}/video, or the WebSocket /feeds/{id}/pictures",
    )
    layout: Literal["auto", "sbs", "tb", "two"] = Field(
        default="auto",
        description="two eyes in one picture, side by side or top-bottom, or in two streams of one source",
    )
    label: Label = Field(default=None, description=LABEL_ABOUT)
    keep_s: float = Field(
        default=300.0, gt=0, le=MAX_KEEP_S, description="seconds of the past that can be viewed and cut out"
    )
    width: int | None = Field(
        default=None,
        ge=64,
        le=4096,
        description="width in pixels of the pictures that the model learns; left out, what the machine keeps up with",
    )
    camera: Literal["fixed", "moving"] = Field(
        default="fixed", description="fixed: the endoscope's motion counts as the tissue's"
    )


class FeedReport(BaseModel):
    """What the worker that follows a feed says of it. Moments are UNIX times, s, of the arrival of pairs.

    Fields that only a later version knows are ignored.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    state: FeedState
    reason: Annotated[FeedReason, known_code(FeedReason)] | None = Field(
        default=None, description="why it is in this state; null while all is well"
    )
    text: str = Field(default="", description="the same for people; its words may change")
    since_s: float = Field(description="when the state began")
    recording: Annotated[FeedReason, known_code(FeedReason)] | None = Field(
        default=None, description="why nothing is recorded at the moment; null, the good case: it is being recorded"
    )
    received_fps: float = Field(default=0.0, description="pairs that came in a second, over the last seconds")
    used_fps: float = Field(default=0.0, description="pairs that the model learnt a second, over the last seconds")
    dropped: int = Field(
        default=0,
        description="whole pairs that came in and that the model did not learn, in all; no loss of the recording",
    )
    model_age_s: float | None = Field(
        default=None, description="from the arrival of the newest pair that the model knows until this report"
    )
    decode_lag_s: float | None = Field(default=None, description="from the arrival of a pair to its picture")
    reconnects: int = Field(default=0, description="connections after the first")
    last_frame_at_s: float | None = Field(default=None, description="when the newest pair arrived")
    stored_bytes: int = Field(default=0, description="bytes of the recording and of the model's past on disk")
    begins_s: float | None = Field(default=None, description="the oldest moment that can be viewed; null: none yet")
    ends_s: float | None = Field(default=None, description="the newest moment that can be viewed")
    source_begins_s: float | None = Field(default=None, description="begins_s in seconds of the source")
    source_ends_s: float | None = Field(default=None, description="ends_s in seconds of the source")
    width: int | None = Field(default=None, description="of the pictures that the model learns, in pixels")
    height: int | None = None
    gaussians: int = 0


class FeedRecord(BaseModel):
    """A feed as the queue has it. owner follows it in its epoch-th turn, as long as it beats."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    feed_id: str = Field(pattern=JOB_ID_PATTERN)
    tenant: str = Field(default=LOCAL_TENANT, pattern=TENANT_PATTERN)
    options: FeedOptions
    calibration: str = Field(repr=False)
    """The text of the caller's file."""
    calibration_name: str
    """`calibration`, and the ending that names its format, such as calibration.json."""
    created_at_s: float
    wish: FeedWish = FeedWish.RUN
    owner: str | None = None
    epoch: int = 0
    report: FeedReport | None = None
    reported_at_s: float | None = None

    @property
    def state(self) -> FeedState:
        """As its worker reported it last. Without a worker it is connecting."""
        return FeedState.CONNECTING if self.owner is None or self.report is None else self.report.state


class FeedView(FeedReport):
    """A feed as the API shows it: what was asked for, and what its worker said of it last."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    id: str
    label: str | None = None
    wish: FeedWish = Field(description="what its caller wants; the state follows within a second")
    options: FeedOptions = Field(description="as they were given, the source without user and password")
    created_at_s: float
    model_age_s: float | None = Field(
        default=None, description="from the arrival of the newest pair that the model knows until now"
    )
    links: dict[str, str]

    @classmethod
    def of(cls, record: FeedRecord, now_s: float) -> FeedView:
        """The view of one record at a UNIX time. A feed that no worker follows is connecting for that reason."""
        known = record.report or FeedReport(state=FeedState.CONNECTING, since_s=record.created_at_s)
        about = known.model_dump()
        if known.model_age_s is not None and record.reported_at_s is not None:
            about["model_age_s"] = known.model_age_s + max(0.0, now_s - record.reported_at_s)
        if record.owner is None:
            text = "No worker follows this feed; the next one with a free place does."
            about |= {"state": record.state, "reason": FeedReason.NO_WORKER, "text": text}
            about |= {"since_s": record.reported_at_s or record.created_at_s, "received_fps": 0.0, "used_fps": 0.0}
        source, path = record.options.source, f"/feeds/{record.feed_id}"
        links = {"self": path, "events": f"{path}/events", "cut": f"{path}/cut"}
        links |= {"pause": f"{path}/pause", "resume": f"{path}/resume", "render": f"/render?scene={record.feed_id}"}
        if source is None:
            links |= {"video": f"{path}/video", "pictures": f"{path}/pictures"}
        return cls(
            id=record.feed_id,
            label=record.options.label,
            wish=record.wish,
            options=record.options.model_copy(update={"source": None if source is None else without_user(source)}),
            created_at_s=record.created_at_s,
            links=links,
            **about,
        )


class FeedReceipt(BaseModel):
    """What is left of a feed that was ended."""

    feed_id: str
    ended_at: str = Field(description="ISO 8601, UTC: when it was asked for")
    bytes: int = Field(description="bytes that the feed had on disk, as its worker last reported them")
    record: bool = Field(description="the queue has no record of it any more, so its worker has deleted all files")
    verified: bool = Field(description="the data directory was searched for files of the feed, and has none")


class CutRange(BaseModel):
    """What a cut holds. All times are of the arrival of pairs, UNIX s."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    from_s: float = Field(description="of its first frame")
    to_s: float = Field(description="of its last frame")
    frames: int
    is_whole: bool = Field(
        default=True,
        description="whether it holds all frames of the range that are recorded so far: after a change of size or "
        "coding it holds only what came later. The newest seconds are recorded a little later: to_s says where it ends",
    )


class GivenCut(BaseModel):
    """The body of POST /feeds/{id}/cut."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    from_: float | str = Field(
        alias="from",
        union_mode="left_to_right",
        description="a moment as t has it: -30, seconds of the source, or a time of RFC 3339",
    )
    to: float | str = Field(default="live", union_mode="left_to_right", description="the same; live: until now")
    options: dict[str, object] = Field(default={}, description="as POST /reconstruct has them")
    label: str | None = Field(default=None, description=LABEL_ABOUT)
    metadata: dict[str, object] | None = Field(default=None, description="as POST /reconstruct has it")
    callback_url: str | None = None


class CutJob(JobView):
    """The job of a part of a feed's recording."""

    cut: CutRange

    @classmethod
    def of_cut(cls, record: JobRecord, cut: CutRange, forecast: Forecast | None = None) -> CutJob:
        """The view of its record."""
        return cls(**JobView.of(record, forecast).model_dump(), cut=cut)


class FeedShown(BaseModel):
    """The moment of a feed that an answer shows, and how fresh it is."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    state: FeedState
    source_s: float = Field(description="seconds of the source")
    captured_at_s: float = Field(description="UNIX time at which its pair arrived")
    age_s: float = Field(description="seconds from then until the answer")
    is_newest: bool = Field(description="whether it is the newest moment that the model knew")
