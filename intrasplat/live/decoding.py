"""Decodes packets as they come, and holds the newest pair. What cannot be decoded in time is skipped, never queued."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any, cast

import av
import av.error

from intrasplat.clip.packing import (
    CLEAR_MARGIN,
    MIN_LIKENESS,
    FrameSequence,
    Packing,
    detect_packing,
    halves,
    packing_likeness,
)
from intrasplat.clip.types import RgbFrame
from intrasplat.clip.video_stream import RgbConverter
from intrasplat.errors import InputError
from intrasplat.intake.limits import MIN_SIDE_PX
from intrasplat.live.clock import Place
from intrasplat.live.matching import Matcher
from intrasplat.live.reading import Arrived, SourceEnd
from intrasplat.live.spec import FeedLayout
from intrasplat.live.state import FeedReason

SLOW_S = 0.3
"""With a longer lag, frames that no other frame needs are not decoded."""
LATE_S = 0.8
"""With a longer lag, decoding goes on at the newest key frame."""
MAX_QUEUE_BYTES = 64 << 20
MAX_PIXEL_ASPECT = 4.0
FRAMES_COMPARED = 30
"""Frames without detail, until the shape alone decides how they hold two eyes."""
CHECK_PERIOD_S = 1.0
CHECKS = 3
"""Checks in a row that find another packing end the segment."""
THREADS = 2


class Skip(Enum):
    """What is left out of decoding."""

    NOTHING = auto()
    UNREFERENCED = auto()
    ALL = auto()


class LagPolicy:
    """Chooses what to skip, packet by packet of a stream, so that the lag does not grow."""

    def __init__(self) -> None:
        self._waits_for_key = True

    @property
    def waits_for_key(self) -> bool:
        """Whether packets are left out until a key frame comes."""
        return self._waits_for_key

    def restart(self) -> None:
        """Go on at the next key frame."""
        self._waits_for_key = True

    def choose(self, lag_s: float, is_key: bool, newer_key: bool) -> Skip:
        """What to skip. newer_key: whether another key frame waits behind this packet."""
        if lag_s > LATE_S and (newer_key or not is_key):
            self._waits_for_key = True
        elif is_key:
            self._waits_for_key = False
        if self._waits_for_key:
            return Skip.ALL
        return Skip.UNREFERENCED if lag_s > SLOW_S else Skip.NOTHING


@dataclass(frozen=True)
class Newest:
    """The newest pair, not yet converted. left and right are the same frame if it holds both eyes."""

    left: av.VideoFrame
    right: av.VideoFrame
    source_s: float
    arrived_at: float
    sequence: int
    epoch: int


@dataclass(frozen=True)
class Shape:
    """Size of an eye in pixels, and how a picture holds two."""

    height: int
    width: int
    packing: str
    pixel_aspect: float


class Decoding:
    """A thread that decodes the packets which `add` gives it.

    newest, shape   None before the first pair
    received        packets of the first stream that came in
    sequence        number of the newest pair
    lag_s           of the newest decoded frame
    is_slow         whether frames are skipped
    problem         why no pair comes out at the moment although frames are decoded
    end             why it ended
    """

    def __init__(
        self, layout: FeedLayout, expected: tuple[int, int, str] | None, sequence: int, max_pixels: int, first_s: float
    ) -> None:
        """expected: height, width and packing of the feed so far. first_s: the feed's time, which never falls."""
        self._layout, self._expected, self._max_pixels = layout, expected, max_pixels
        self.newest: Newest | None = None
        self.shape: Shape | None = None
        self.received, self.sequence, self.lag_s, self.is_slow = 0, sequence, 0.0, False
        self.problem: FeedReason | None = None
        self.end: SourceEnd | None = None
        self.changed = threading.Condition()
        self._contexts: dict[int, av.VideoCodecContext] = {}
        self._policies: dict[int, LagPolicy] = {}
        self._arrivals: dict[int, dict[int, float]] = {}
        self._epoch = 0
        self._place: Place | None = None
        self._source_s = first_s
        self._queue: deque[tuple[Arrived, Place] | None] = deque()
        self._queue_bytes = 0
        self._filled = threading.Condition()
        self._matcher: Matcher[tuple[av.VideoFrame, float]] = Matcher()
        self._convert = RgbConverter("source", "the source")
        self._without_detail, self._doubts, self._next_check_s = 0, 0, 0.0
        self._first_size: tuple[int, int] | None = None
        self._thread = threading.Thread(target=self._run, name="decoding", daemon=True)

    def start(self, contexts: list[Any]) -> None:
        """Start decoding. contexts: of the streams; none for pushed pictures."""
        for number, context in enumerate(contexts):
            context.thread_type, context.thread_count = "SLICE", THREADS  # threads by frames add a lag of frames
            context.options = {"max_pixels": str(self._max_pixels)}
            self._contexts[number] = context
        self._thread.start()

    def add(self, arrived: Arrived, place: Place) -> None:
        """Decode a packet when its turn comes."""
        with self._filled:
            if arrived.stream == 0:
                self.received += 1
            self._queue_bytes += arrived.packet.size
            if self._queue_bytes > MAX_QUEUE_BYTES:
                self._queue.clear()
                self._queue_bytes = 0
                for policy in self._policies.values():
                    policy.restart()
            self._queue.append((arrived, place))
            self._filled.notify()

    def finish(self, limit_s: float) -> None:
        """Decode what is left."""
        with self._filled:
            self._queue.append(None)
            self._filled.notify()
        if self._thread.is_alive():
            self._thread.join(limit_s)

    def _run(self) -> None:
        try:
            while (item := self._next()) is not None:
                self._take(*item)
            self._drain()
        except SourceEnd as end:
            self._stop(end)
        except MemoryError:
            self._stop(SourceEnd(FeedReason.DECODER_MEMORY, "the decoder needs more memory than it may use"))
        except InputError as error:
            self._stop(SourceEnd(FeedReason.UNDECODABLE, error.problem))

    def _stop(self, end: SourceEnd) -> None:
        with self.changed:
            self.end = end
            self.changed.notify_all()

    def _next(self) -> tuple[Arrived, Place] | None:
        with self._filled:
            while not self._queue:
                self._filled.wait()
            item = self._queue.popleft()
            if item is not None:
                self._queue_bytes -= item[0].packet.size
            return item

    def _take(self, arrived: Arrived, place: Place) -> None:
        number, packet = arrived.stream, arrived.packet
        context = self._context(arrived)
        policy = self._policies.setdefault(number, LagPolicy())
        if place.epoch != self._epoch:
            self._begin_epoch(place)
        self._place = place
        lag_s = time.time() - arrived.arrived_at
        skip = policy.choose(lag_s, packet.is_keyframe, self._has_newer_key(number))
        self.is_slow = skip is Skip.UNREFERENCED or (skip is Skip.ALL and lag_s > SLOW_S)
        if skip is Skip.ALL:
            return
        context.skip_frame = "NONREF" if skip is Skip.UNREFERENCED else "DEFAULT"
        arrivals = self._arrivals.setdefault(number, {})
        arrivals[int(packet.pts or 0)] = arrived.arrived_at
        while len(arrivals) > 64:
            arrivals.pop(next(iter(arrivals)))
        self._decode(number, packet, place)

    def _context(self, arrived: Arrived) -> av.VideoCodecContext:
        context = self._contexts.get(arrived.stream)
        if context is None or context.codec.name != arrived.codec:  # pushed pictures may change their codec
            context = cast(av.VideoCodecContext, av.CodecContext.create(arrived.codec, "r"))
            context.options = {"max_pixels": str(self._max_pixels)}
            self._contexts[arrived.stream] = context
        return context

    def _has_newer_key(self, number: int) -> bool:
        with self._filled:
            return any(each and each[0].stream == number and each[0].packet.is_keyframe for each in self._queue)

    def _begin_epoch(self, place: Place) -> None:
        self._drain()
        for number, context in self._contexts.items():
            context.flush_buffers()
            self._policies[number] = LagPolicy()
        self._arrivals.clear()
        self._matcher.clear()
        self._epoch = place.epoch

    def _drain(self) -> None:
        """Take the frames that the decoders still have."""
        if self._place is not None:
            for number in self._contexts:
                self._decode(number, None, self._place)

    def _decode(self, number: int, packet: av.Packet[Any] | None, place: Place) -> None:
        try:
            frames = self._contexts[number].decode(packet)
        except (av.error.FFmpegError, ValueError):
            return
        for frame in frames:
            if frame.is_corrupt or frame.pts is None:
                continue
            self._check_size(frame)
            arrived_at = self._arrivals.get(number, {}).pop(frame.pts, time.time())
            self.lag_s = max(0.0, time.time() - arrived_at)
            time_s = float(frame.pts * (frame.time_base or 0)) + place.offset_s
            self._pair(number, frame, time_s, arrived_at)

    def _check_size(self, frame: av.VideoFrame) -> None:
        size = (frame.height, frame.width)
        self._first_size = self._first_size or size
        if size != self._first_size:
            text = f"the pictures were {self._first_size[1]} x {self._first_size[0]} pixels, now {size[1]} x {size[0]}"
            raise SourceEnd(FeedReason.SIZE_CHANGED, text)
        if min(size) < MIN_SIDE_PX or size[0] * size[1] > self._max_pixels:
            raise SourceEnd(FeedReason.PICTURE_LIMIT, f"the pictures have {size[1]} x {size[0]} pixels")

    def _pair(self, number: int, frame: av.VideoFrame, time_s: float, arrived_at: float) -> None:
        left, right = frame, frame
        if len(self._contexts) > 1:
            matched = self._matcher.add(number, time_s, (frame, arrived_at))
            if matched is None:
                return
            time_s, (left, left_at), (right, right_at) = matched
            arrived_at = max(left_at, right_at)
        if self.shape is None:
            self.shape = self._shaped(left)
            if self.shape is None:
                return
        elif self._layout == "auto" and self.shape.packing != "two":
            self._check_packing(left)
        if self.problem is not None:
            return
        self._source_s = max(self._source_s, time_s)
        with self.changed:
            self.sequence += 1
            self.newest = Newest(left, right, self._source_s, arrived_at, self.sequence, self._epoch)
            self.changed.notify_all()

    def _shaped(self, frame: av.VideoFrame) -> Shape | None:
        """The shape of the source's pictures; None if that is not known yet. Sets problem if the feed had another."""
        packing = self._packing(frame)
        if packing is None:
            return None
        height, width = frame.height, frame.width
        eye = {"sbs": (height, width // 2), "tb": (height // 2, width), "two": (height, width)}[packing]
        aspect = float(frame.sample_aspect_ratio or 1) if hasattr(frame, "sample_aspect_ratio") else 1.0
        aspect = aspect if 1 / MAX_PIXEL_ASPECT <= aspect <= MAX_PIXEL_ASPECT else 1.0
        if self._expected is not None and self._expected != (*eye, packing):
            changed = self._expected[2] != packing
            self.problem = FeedReason.PACKING_CHANGED if changed else FeedReason.SIZE_CHANGED
        return Shape(*eye, packing, aspect)

    def _packing(self, frame: av.VideoFrame) -> str | None:
        if len(self._contexts) > 1:
            return "two"
        if self._layout == "two":
            raise SourceEnd(FeedReason.NO_VIDEO, "the source has one video stream, not two")
        if self._layout != "auto":
            return self._layout
        rgb = self._convert(frame)
        if packing_likeness(rgb) is None and self._without_detail < FRAMES_COMPARED:
            self._without_detail += 1
            return None
        try:
            return detect_packing(_One(rgb))
        except InputError as error:
            raise SourceEnd(FeedReason.PACKING_UNKNOWN, error.problem) from None

    def _check_packing(self, frame: av.VideoFrame) -> None:
        """Raise SourceEnd if the pictures of the same size hold the eyes otherwise for a while."""
        if time.monotonic() < self._next_check_s:
            return
        self._next_check_s = time.monotonic() + CHECK_PERIOD_S
        assert self.shape is not None
        own: Packing = "sbs" if self.shape.packing == "sbs" else "tb"
        other: Packing = "tb" if own == "sbs" else "sbs"
        likeness = packing_likeness(self._convert(frame))
        is_other = likeness is not None and likeness[other] >= max(MIN_LIKENESS, likeness[own] + CLEAR_MARGIN)
        self._doubts = self._doubts + 1 if is_other else 0
        if self._doubts >= CHECKS:
            raise SourceEnd(FeedReason.PACKING_CHANGED, "the pictures hold the eyes in another way than before")


def unpacked(newest: Newest, packing: str, convert: RgbConverter) -> tuple[RgbFrame, RgbFrame]:
    """Left and right eye of a pair, RGB uint8 [H, W, 3], as clips are decoded (intrasplat/clip)."""
    if packing == "two":
        return convert(newest.left), convert(newest.right)
    return halves(convert(newest.left), "sbs" if packing == "sbs" else "tb")


class _One(FrameSequence):
    """One picture as a sequence."""

    label, frame_count, frame_times_s, notices, damaged, pixel_aspect = "the source", 1, None, (), (), 1.0

    def __init__(self, frame: RgbFrame) -> None:
        self._frame = frame

    @property
    def height(self) -> int:
        return int(self._frame.shape[0])

    @property
    def width(self) -> int:
        return int(self._frame.shape[1])

    def frames(self) -> Any:
        return iter((self._frame,))
