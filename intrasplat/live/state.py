"""What a feed says of itself: its state with a reason, and its numbers."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from enum import StrEnum


class FeedState(StrEnum):
    """What a feed does now."""

    CONNECTING = "connecting"
    LIVE = "live"
    BEHIND = "behind"
    """Pairs come in, but decoding or training cannot keep up: frames are skipped."""
    STALLED = "stalled"
    """No pair comes in, or the model cannot use those that do; it is tried again."""
    PAUSED = "paused"
    """Nothing is read, decoded or stored."""
    NO_TISSUE = "no_tissue"
    """Pairs come in, but show no tissue: nothing of them is learnt, shown or stored."""
    ENDED = "ended"


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
    """No worker has a free place for the feed."""
    UNCLASSIFIED = "unclassified"
    """A reason that a later version names."""
    BY_HAND = "by_hand"
    END_OF_FILE = "end_of_file"
    # of the model alone
    NO_SCENE = "no_scene"
    CALIBRATION = "calibration"
    # of the recording alone
    DISK_FULL = "disk_full"
    DISK_FAILS = "disk_fails"
    DISK_SLOW = "disk_slow"
    NOT_RECORDABLE = "not_recordable"


class StateClock:
    """When a state began. Any thread may call it."""

    def __init__(self, state: FeedState) -> None:
        self._lock = threading.Lock()
        self._found: tuple[FeedState, FeedReason | None, float] = (state, None, time.time())

    def since(self, state: FeedState, reason: FeedReason | None) -> float:
        """The UNIX time, s, at which this state, which is that of now, was found first."""
        with self._lock:
            if self._found[:2] != (state, reason):
                self._found = (state, reason, time.time())
            return self._found[2]


@dataclass(frozen=True)
class FeedStatus:
    """The state of a source.

    reason      why it is in this state; None while all is well
    text        the same for people; its words may change
    since       UNIX time, s, at which the state began
    recording   why nothing is recorded at the moment; None: it is recorded, or nobody asked for it
    """

    state: FeedState
    reason: FeedReason | None
    text: str
    since: float
    recording: FeedReason | None = None


@dataclass(frozen=True)
class Segment:
    """A stretch of a feed without a jump of its clock, from one connection.

    number        counts from 0
    reason        why the segment before it ended; None for the first
    height, width, pixel_aspect   of one eye; width / height of a pixel
    packing       sbs, tb, or two: a stream for each eye
    codec         FFmpeg's name
    """

    number: int
    reason: FeedReason | None
    height: int
    width: int
    pixel_aspect: float
    packing: str
    codec: str


@dataclass(frozen=True)
class FeedNumbers:
    """Numbers of a feed.

    received_fps   pairs that came in a second, over the last seconds
    used_fps       pairs that were handed over a second, over the last seconds
    dropped        whole pairs that came in and were not handed over, in all
    decode_lag_s   from the arrival of a packet to its decoded picture; None before the first
    reconnects     connections after the first
    last_frame_at  UNIX time, s, at which the newest packet came in; None before the first
    stored_bytes     bytes of the recording on disk
    model_age_s    from the arrival of the newest pair that the model knows until now; None without a model
    """

    received_fps: float
    used_fps: float
    dropped: int
    decode_lag_s: float | None
    reconnects: int
    last_frame_at: float | None
    stored_bytes: int
    model_age_s: float | None = None


@dataclass(frozen=True)
class ModelNumbers:
    """The model of a feed now.

    iteration      steps of its training so far; another model begins at 0
    gaussians      their number
    width, height  of its pictures, px
    pair_steps     steps for each of the last pairs, their median
    """

    iteration: int
    gaussians: int
    width: int
    height: int
    pair_steps: float


@dataclass(frozen=True)
class PastRange:
    """What can be looked at: seconds of the source's clock, and the UNIX times, s, at which these moments came in."""

    begins_s: float
    ends_s: float
    begins_at: float
    ends_at: float


@dataclass(frozen=True)
class LiveReport:
    """A feed and its model.

    state, reason, text, since, recording  as in FeedStatus, but of both; recording covers segments of the model, too
    numbers   used_fps, dropped and model_age_s are those of the model
    model     None: there is none yet
    past      None: nothing is known yet
    segment   of the source; None before the first pair
    """

    state: FeedState
    reason: FeedReason | None
    text: str
    since: float
    recording: FeedReason | None
    numbers: FeedNumbers
    model: ModelNumbers | None
    past: PastRange | None
    segment: Segment | None
