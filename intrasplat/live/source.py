"""The newest stereo pair of a live source. A confined process reads it; a thread here watches that process, and starts
another when it ends, hangs or is killed."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from intrasplat.errors import InputError
from intrasplat.live.connecting import Connection, ConnectionFailed, connect
from intrasplat.live.cut import Cut, cut_parts
from intrasplat.live.pair import FeedPair
from intrasplat.live.parts import Keeps, Part, Parts
from intrasplat.live.process import HandedOver, Numbers, ReadingProcess
from intrasplat.live.push import PushPipe
from intrasplat.live.spec import FIELD, PICTURE_HEADER, SourceKind, SourceSpec
from intrasplat.live.state import FeedNumbers, FeedReason, FeedState, FeedStatus, Segment

logger = logging.getLogger(__name__)

BEHIND_S = 0.5
"""With a longer lag of decoding the feed is behind."""
WINDOW_S = 3.0
"""Over which rates are measured."""
STOP_S = 3.0
"""For the reading process to complete the part that it writes."""
PRUNE_PERIOD_S = 1.0
LAST_S = 0.2
"""Longest wait for the last pair before a pause."""
PUSHED = (SourceKind.PUSH, SourceKind.PICTURES)
PATIENT = (*PUSHED, SourceKind.UDP)
"""A new connection would not bring back a sender that is silent."""


class Source:
    """A source that is read since it was made. Any thread may call it.

    Attributes:
        parts: what is recorded; None if nothing is.
    """

    def __init__(self, spec: SourceSpec, place: tuple[float, float] | None = None, keeps: Keeps | None = None) -> None:
        """place: source time, s, and arrival (UNIX time, s) of the last frame of an earlier run, after which this one
        goes on; the recording may know a later one. keeps: as for Parts.

        Raises InputError as SourceSpec.target; OSError: the folder of the recording cannot be used.
        """
        self._spec, self._target = spec, spec.target()
        self.parts = None if spec.recording is None else Parts(spec.recording, keeps)
        self._changed = threading.Condition()
        self._status = FeedStatus(FeedState.CONNECTING, None, "", time.time())
        self._process: ReadingProcess | None = None
        self._closed = self._paused = False
        # of connections that have ended
        self._received = self._reconnects = self._connections = 0
        self._segments = 0
        self._ended_for: FeedReason | None = None
        self._expected: tuple[int, int, str] | None = None
        self._sequence = 0
        self._place = place
        index = self.parts.index() if self.parts else ()
        if index:  # goes on after an earlier run
            self._place = max((index[-1].to_s, index[-1].last_arrived_at), place or (0.0, 0.0))
            self._segments = index[-1].segment + 1
        self._numbers = Numbers()
        self._used = 0
        self._last_given: tuple[int, float] = (0, 0.0)
        self._last: FeedPair | None = None
        self._segment: Segment | None = None
        self._window: deque[tuple[float, int, int]] = deque()
        is_pushed = self._target.kind in PUSHED
        self._push = PushPipe(self._changed, lambda: self._is_deaf) if is_pushed else None
        self._thread = threading.Thread(target=self._run, name="live-source", daemon=True)
        self._thread.start()

    @property
    def status(self) -> FeedStatus:
        """The state, with its reason."""
        with self._changed:
            return self._status

    @property
    def state(self) -> FeedState:
        """The state alone."""
        return self.status.state

    @property
    def segment(self) -> Segment | None:
        """The segment of the pair that was handed over last; None before the first."""
        with self._changed:
            return self._segment

    def numbers(self) -> FeedNumbers:
        """Rates, lags and counts up to now."""
        with self._changed:
            received, newest = self._received + self._numbers.received, self._numbers
            waiting = int(max(self._sequence, newest.sequence) > self._last_given[0])
            self._note_rates()
            first, last = self._window[0], self._window[-1]
            seconds = max(last[0] - first[0], 1e-9)
            return FeedNumbers(
                received_fps=(last[1] - first[1]) / seconds,
                used_fps=(last[2] - first[2]) / seconds,
                dropped=max(0, received - self._used - waiting),
                decode_lag_s=newest.lag_s if newest.place else None,
                reconnects=self._reconnects,
                last_frame_at=newest.last_at,
                stored_bytes=self.parts.stored_bytes if self.parts else 0,
            )

    def newest(self, after_sequence: int = 0, timeout_s: float = 1.0) -> FeedPair | None:
        """The newest pair, if its sequence is after this one; it is waited for. None if there is none in time, or none
        will come because the feed is paused or has ended."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            with self._changed:
                process = self._process
                left_s = deadline_s - time.monotonic()
                if left_s <= 0 or self._closed or self._status.state in (FeedState.PAUSED, FeedState.ENDED):
                    return None
                if process is None or process.end_reason is not None:
                    self._changed.wait(min(left_s, 0.1))
                    continue
                segments, ended_for = self._segments, self._ended_for
            pair = process.newest(after_sequence, left_s)
            if pair is not None and pair.sequence > after_sequence:
                return self._given(pair, process.numbers, segments, ended_for)

    def peek(self, after_sequence: int, timeout_s: float) -> FeedPair | None:
        """As newest, for somebody who only looks: it counts as no pair that was handed over. If none comes in time, or
        the source is not read, it is the last one that was handed over."""
        with self._changed:
            process, last = self._process, self._last
        pair = None if process is None else process.newest(after_sequence, timeout_s)
        if pair is not None and pair.sequence > after_sequence:
            return FeedPair(pair.left, pair.right, pair.source_s, pair.arrived_at, pair.sequence)
        return last if last is not None and last.sequence > after_sequence else None

    def pause(self) -> None:
        """Read, decode and store nothing from now on. It returns when the reading process has ended, or at resume()."""
        last = self.peek(0, LAST_S)  # it goes with the process
        with self._changed:
            self._paused = True
            if last is not None and (self._last is None or last.sequence > self._last.sequence):
                self._last = last
            self._changed.notify_all()
            while self._paused and self._status.state not in (FeedState.PAUSED, FeedState.ENDED) and not self._closed:
                self._changed.wait(0.1)

    def resume(self) -> None:
        """Go on at the source's present."""
        with self._changed:
            self._paused = False
            if self._status.state is FeedState.PAUSED:
                self._set(FeedState.CONNECTING, None, "")
            self._changed.notify_all()

    def close(self) -> None:
        """End it. What was recorded stays."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self.end_push()
        self._thread.join(2 * STOP_S)

    def cut(self, from_s: float, to_s: float, path: Path) -> Cut:
        """One playable file of the recorded packets of [from_s, to_s] in source time; see cut_parts."""
        if self.parts is None:
            raise InputError(FIELD, "nothing is recorded.", "Record the feed.")
        self.parts.adopt()
        return cut_parts(self.parts, from_s, to_s, path)

    def index(self) -> tuple[Part, ...]:
        """What is recorded, oldest first."""
        return () if self.parts is None else self.parts.index()

    def write(self, data: bytes, timeout_s: float = 10.0) -> None:
        """Push bytes of a stream (fragmented mp4, MPEG-TS, Matroska). They are discarded while the feed is paused.

        Raises:
            InputError: this source is not pushed.
            UnavailableError: the push was cut off, as when its process ended, and must begin anew; or the bytes were
                not taken in time.
        """
        if self._push is None:
            raise InputError(FIELD, "this source is not pushed.", "Leave out its URL.")
        self._push.write(data, timeout_s)

    def write_picture(self, data: bytes, captured_s: float | None = None, timeout_s: float = 10.0) -> None:
        """Push a JPEG or WebP picture of both eyes. captured_s: the sender's clock; None: it is shown as it comes in.

        Raises as write.
        """
        stamp_s = math.nan if captured_s is None else captured_s
        self.write(PICTURE_HEADER.pack(stamp_s, len(data)) + data, timeout_s)

    def end_push(self) -> None:
        """The pushed stream has ended; another may begin."""
        if self._push is not None:
            self._push.end()

    def _given(self, pair: HandedOver, numbers: Numbers, segments: int, ended_for: FeedReason | None) -> FeedPair:
        with self._changed:
            self._used += 1
            source_s = max(pair.source_s, self._last_given[1])
            self._last_given = (pair.sequence, source_s)
            if numbers.shape is not None:
                height, width, packing, aspect = numbers.shape
                self._expected = self._expected or (height, width, packing)
                reason = FeedReason.TIMES_JUMPED if pair.epoch else ended_for
                number = segments + pair.epoch
                self._segment = Segment(number, reason, height, width, aspect, packing, numbers.codec)
            aspect = self._segment.pixel_aspect if self._segment else 1.0
            self._last = FeedPair(pair.left, pair.right, source_s, pair.arrived_at, pair.sequence, aspect)
            return self._last

    def _run(self) -> None:
        try:
            self._read()
        except Exception:
            logger.exception("a live source failed")
            self._set(FeedState.ENDED, FeedReason.FAULT, "a fault of the program")
        self._wait(lambda: False, None)  # what is recorded still grows old

    def _read(self) -> None:
        failures = 0
        while not self._closed:
            if self._paused:
                self._set(FeedState.PAUSED, FeedReason.BY_HAND, "paused by hand")
                self._wait(lambda: not self._paused, None)
                failures = 0
                continue
            if not self._wait(self._is_wanted, None) or self._is_interrupted():
                continue
            before = self._sequence
            reason, text = self._connected()
            if self._is_interrupted():
                continue
            self._ended_for = reason
            is_over = reason is FeedReason.END_OF_FILE
            if is_over or (self._target.kind is SourceKind.FILE and reason is not FeedReason.DECODER_ENDED):
                self._set(FeedState.ENDED, reason, text)
                return
            self._set(FeedState.STALLED, reason, text)
            failures = 0 if self._sequence > before else failures + 1
            if self._push is None:
                self._wait(lambda: self._paused, self._spec.back_off.pause_s(failures))
        self._set(FeedState.ENDED, FeedReason.BY_HAND, "closed by hand")

    def _is_interrupted(self) -> bool:
        """Whether the caller wants no connection any more."""
        return self._closed or self._paused

    def _is_wanted(self) -> bool:
        """Whether there is a reason to stop waiting for a push."""
        return self._push is None or self._push.is_wanted or self._paused

    @property
    def _is_deaf(self) -> bool:
        """Whether what is pushed is discarded."""
        return self._paused or self._closed or self._status.state is FeedState.ENDED

    def _wait(self, enough: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until `enough()`, the end or the time; meanwhile old parts go. Whether `enough()`."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._closed and not enough():
            left_s = PRUNE_PERIOD_S if deadline_s is None else deadline_s - time.monotonic()
            if left_s <= 0:
                return False
            with self._changed:
                if not self._closed and not enough():
                    self._changed.wait(min(left_s, PRUNE_PERIOD_S))
            if self.parts is not None:
                self.parts.adopt()
                self.parts.prune()
        return not self._closed

    def _connected(self) -> tuple[FeedReason, str]:
        """Connect and read until that ends, for the returned reason."""
        try:
            connection = connect(self._target, self._spec)
        except ConnectionFailed as error:
            return error.reason, error.text
        try:
            process = self._started(connection)
        except OSError as error:
            self._end_connection(connection, None)
            return FeedReason.DECODER_ENDED, f"the process that reads the source cannot start ({error.strerror})"
        try:
            self._watch(process)
        finally:
            if self._is_interrupted():
                process.stop(STOP_S)
            process.close(FeedReason.DECODER_ENDED, "")
            self._end_connection(connection, process)
        if connection.relay is not None and connection.relay.redirected:
            return FeedReason.REDIRECTED, "the server redirects to another place, which is not followed"
        return process.end_reason or FeedReason.DECODER_ENDED, process.end_text

    def _started(self, connection: Connection) -> ReadingProcess:
        recording = self._spec.recording
        place = self._place or (0.0, time.time() + 3600)
        request = {
            "layout": self._spec.layout,
            "expected": self._expected,
            "sequence": self._sequence,
            "start_s": place[0],
            "start_at": place[1],
            "segment": self._segments,
            "part_s": recording and recording.part_s,
        }
        folder = self.parts.incoming if self.parts else None
        process = ReadingProcess(connection, request, folder, self._spec.limits.pixels_per_frame)
        with self._changed:
            self._process = process
            if self._push is not None:
                self._push.begin(connection.push)
            self._reconnects += self._connections > 0
            self._connections += 1
            self._changed.notify_all()
        return process

    def _end_connection(self, connection: Connection, process: ReadingProcess | None) -> None:
        connection.close()
        if self._push is not None:
            self._push.cut_off(by_sender=process is not None and process.end_reason is FeedReason.CLOSED)
        if self.parts is not None:
            self.parts.adopt()
            self.parts.clear_incoming()
        with self._changed:
            numbers = self._numbers if process is None else process.numbers
            self._process = None
            self._received += numbers.received
            if numbers.sequence > self._sequence:
                self._sequence, self._place = numbers.sequence, numbers.place or self._place
                self._segments += numbers.epoch + 1
            self._numbers = Numbers(last_at=numbers.last_at, lag_s=numbers.lag_s, place=numbers.place)

    def _watch(self, process: ReadingProcess) -> None:
        """Follow the process's reports until it ends, or a deadline ends it."""
        began_s = packet_s = pair_s = time.monotonic()
        received, sequence, parts, prune_s = 0, self._sequence, 0, 0.0
        limits = self._spec.deadlines
        for _ in process.reports():
            if self._is_interrupted():
                return
            now_s, numbers = time.monotonic(), process.numbers
            with self._changed:
                self._numbers = numbers
                self._note_rates()
            if numbers.received > received:
                received, packet_s = numbers.received, now_s
            if numbers.sequence > sequence:
                sequence, pair_s = numbers.sequence, now_s
            self._judge(numbers, sequence > self._sequence, now_s - packet_s, now_s - pair_s)
            if self.parts is not None and (numbers.parts > parts or now_s > prune_s):
                parts, prune_s = numbers.parts, now_s + PRUNE_PERIOD_S
                self.parts.adopt()
                self.parts.prune()
            limit_s = limits.read_s if sequence > self._sequence else max(limits.first_s, limits.read_s)
            is_silent = now_s - packet_s > limits.silent_s
            if numbers.problem is None and now_s - max(began_s, pair_s) > limit_s:
                if not is_silent:
                    process.close(FeedReason.UNDECODABLE, "no picture can be decoded")
                elif self._target.kind not in PATIENT:
                    process.close(FeedReason.SILENT, "the source is silent")

    def _judge(self, numbers: Numbers, had_pairs: bool, packet_age_s: float, pair_age_s: float) -> None:
        silent_s = self._spec.deadlines.silent_s
        if numbers.problem is not None:
            text = "the pictures have another size, or hold the eyes otherwise, than the feed's first ones"
            self._set(FeedState.STALLED, numbers.problem, text, numbers.recording)
        elif pair_age_s > silent_s and (had_pairs or packet_age_s > silent_s):
            silent, undecodable = (FeedReason.SILENT, "the source is silent"), (FeedReason.UNDECODABLE, "no picture")
            self._set(FeedState.STALLED, *(silent if packet_age_s > silent_s else undecodable), numbers.recording)
        elif had_pairs:
            is_behind = numbers.is_slow or numbers.lag_s > BEHIND_S
            reason_behind = FeedReason.TOO_SLOW if is_behind else None
            state = FeedState.BEHIND if is_behind else FeedState.LIVE
            self._set(state, reason_behind, "decoding does not keep up" if is_behind else "", numbers.recording)

    def _set(self, state: FeedState, reason: FeedReason | None, text: str, recording: FeedReason | None = None) -> None:
        with self._changed:
            before = self._status
            since = before.since if (before.state, before.reason) == (state, reason) else time.time()
            self._status = FeedStatus(state, reason, text, since, recording)
            self._changed.notify_all()

    def _note_rates(self) -> None:
        now_s = time.monotonic()
        if self._window and now_s - self._window[-1][0] < 0.1:
            return
        self._window.append((now_s, self._received + self._numbers.received, self._used))
        while now_s - self._window[0][0] > WINDOW_S:
            self._window.popleft()
