"""The work of the process that reads a source: packets to the recording and to the decoder, the newest pair to the
parent."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from intrasplat.clip.video_stream import RgbConverter
from intrasplat.errors import InputError
from intrasplat.live.clock import Place, SourceClock, Waited
from intrasplat.live.decoding import Decoding, Newest, Shape, unpacked
from intrasplat.live.reading import Arrived, PacketSource, SourceEnd
from intrasplat.live.recorder import Recorded, Recorder
from intrasplat.live.state import FeedReason

REPORT_PERIOD_S = 0.05
FINISH_S = 2.0
MAX_FAULT_CHARACTERS = 300
MAX_LINE_BYTES = 4096  # written whole or not at all


class Answers:
    """Lines to the parent. It never waits for the parent, apart from the last line."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._lock = threading.Lock()
        self._next_s = 0.0
        os.set_blocking(descriptor, False)

    def send(self, line: dict[str, Any], *, last: bool = False, soon: bool = False) -> bool:
        """Send a line if the last one was REPORT_PERIOD_S ago; soon: now.

        False if it was left out.
        """
        with self._lock:
            if not (last or soon) and time.monotonic() < self._next_s:
                return False
            self._next_s = time.monotonic() + REPORT_PERIOD_S
            if last:
                os.set_blocking(self._descriptor, True)
            try:
                os.write(self._descriptor, json.dumps(line, allow_nan=False).encode()[: MAX_LINE_BYTES - 1] + b"\n")
            except BlockingIOError:
                return False
            except BrokenPipeError:
                os._exit(1)
            return True

    def fail(self, error: BaseException | None) -> NoReturn:
        """End this process, because one of its threads failed. Where it failed is for the parent's log alone."""
        place = "".join(traceback.format_tb(None if error is None else error.__traceback__)[-1:]).strip()
        end = {"end": FeedReason.DECODER_ENDED, "text": "the process that reads the source failed"}
        self.send(end | {"fault": f"{type(error).__name__}; {place}"[:MAX_FAULT_CHARACTERS]}, last=True)
        os._exit(1)


class Reader:
    """Reads, records and decodes one source, and hands pairs over."""

    def __init__(self, request: dict[str, Any], answers: Answers) -> None:
        self._request, self._answers = request, answers
        expected = request["expected"] and tuple(request["expected"])
        self._decoding = Decoding(
            request["layout"], expected, request["sequence"], request["max_pixels"], request["start_s"]
        )
        part_s = request["part_s"]
        self._recorder = None if part_s is None else Recorder(Path.cwd(), part_s, 0, request["segment"])
        self._convert = RgbConverter("source", "the source")
        self._codec = ""
        self._last_at: float | None = None
        self._want: tuple[int, int] | None = None
        self._is_ending = False

    def run(self) -> None:
        """Read to the end of the source. Ends this process."""
        threading.Thread(target=self._obey, name="orders", daemon=True).start()
        threading.Thread(target=self._hand_over, name="hand-over", daemon=True).start()
        try:
            began_at = time.time()
            source = PacketSource(self._request["open"], self._request["max_pixels"])
            self._read(source, began_at)
        except SourceEnd as end:
            self._end(end)
        except MemoryError:
            self._end(SourceEnd(FeedReason.DECODER_MEMORY, "reading needs more memory than it may use"))

    def _read(self, source: PacketSource, began_at: float) -> None:
        decoding, recorder = self._decoding, self._recorder
        contexts = [stream.codec_context for stream in source.streams]
        self._codec = contexts[0].codec.name if contexts else ""
        decoding.start(contexts)
        if recorder is not None and contexts:
            codec = self._codec if len(contexts) == 1 else "two streams"
            recorder.start(codec, lambda out: out.add_stream_from_template(source.streams[0]))
        clock: SourceClock | None = None
        waited = Waited(self._request["connected_at"] if "input" in self._request["open"] else None, began_at)
        began: tuple[float, float] | None = None
        for arrived in source.packets():
            stamp_s = arrived.decoding_s
            if source.is_paced:
                began = began or (stamp_s, time.time())
                time.sleep(max(0.0, began[1] + stamp_s - began[0] - time.time()))
                arrived = replace(arrived, arrived_at=time.time())
            else:
                arrived = waited.dated(arrived)
            self._codec = arrived.codec if arrived.stream == 0 else self._codec
            clock = clock or self._clock(arrived, max(1, len(contexts)))
            place = clock.place(stamp_s, arrived.arrived_at)
            self._last_at = arrived.arrived_at
            if recorder is not None and arrived.stream == 0:
                self._record(arrived, stamp_s, place, picture=source.container is None)
            decoding.add(arrived, place)
            self._answers.send(self._numbers())
            if decoding.end is not None:
                raise decoding.end

    def _clock(self, first: Arrived, streams: int) -> SourceClock:
        """The clock whose first frame is the feed's first, or lies as long after its last one as it came in later."""
        passed_s = max(0.0, first.arrived_at - self._request["start_at"])
        return SourceClock(self._request["start_s"] + passed_s - (first.shown_s - first.decoding_s), streams)

    def _record(self, arrived: Arrived, stamp_s: float, place: Place, *, picture: bool) -> None:
        recorder, packet = self._recorder, arrived.packet
        assert recorder is not None
        if picture and not recorder.is_started:
            size = arrived.picture_size()
            if size is None:
                return
            height, width = size
            recorder.start(arrived.codec, lambda out: out.add_mux_stream(arrived.codec, width=width, height=height))
        pts_s = arrived.shown_s
        recorder.add(
            Recorded(
                bytes(packet), packet.is_keyframe, place.offset_s + pts_s, place.offset_s + stamp_s, place.epoch,
                arrived.arrived_at,
            )
        )  # fmt: skip

    def _end(self, end: SourceEnd) -> None:
        self._is_ending = True
        self._decoding.finish(FINISH_S)
        if self._recorder is not None:
            self._recorder.finish(FINISH_S)
        end = self._decoding.end or end
        time.sleep(2 * REPORT_PERIOD_S if self._want else 0.0)  # for the hand-over of the last pair
        self._answers.send(self._numbers() | {"end": str(end.reason), "text": end.text[:300]}, last=True)
        os._exit(0)

    def _obey(self) -> None:
        """Read the parent's orders."""
        for line in sys.stdin.buffer:
            order = json.loads(line)
            if "end" in order:
                break
            with self._decoding.changed:
                self._want = (int(order["want"]), int(order["after"]))
                self._decoding.changed.notify_all()
        if self._recorder is not None:
            self._recorder.finish(FINISH_S)
        self._answers.send(self._numbers() | {"end": "by_hand", "text": ""}, last=True)
        os._exit(0)

    def _hand_over(self) -> None:
        """Answer wishes for the newest pair."""
        decoding, answered = self._decoding, -1
        while True:
            with decoding.changed:
                while not (
                    self._want and self._want[0] != answered and decoding.newest
                    and decoding.newest.sequence > self._want[1]
                ):  # fmt: skip
                    decoding.changed.wait()
                newest, shape, want = decoding.newest, decoding.shape, self._want[0]
            assert newest is not None
            assert shape is not None
            if self._give(newest, shape, want):
                answered = want
            else:
                time.sleep(REPORT_PERIOD_S)

    def _give(self, newest: Newest, shape: Shape, want: int) -> bool:
        """Hand a pair over; False if the parent does not read."""
        try:
            left, right = unpacked(newest, shape.packing, self._convert)
        except (InputError, MemoryError):
            return True
        os.pwrite(self._request["pairs"], left.data, 0)
        os.pwrite(self._request["pairs"], right.data, left.nbytes)
        pair = {
            "want": want,
            "sequence": newest.sequence,
            "source_s": newest.source_s,
            "arrived_at": newest.arrived_at,
            "epoch": newest.epoch,
            "height": int(left.shape[0]),
            "width": int(left.shape[1]),
        }
        return self._answers.send(self._numbers() | {"pair": pair}, soon=True)

    def _numbers(self) -> dict[str, Any]:
        decoding, recorder = self._decoding, self._recorder
        shape, newest = decoding.shape, decoding.newest
        return {
            "received": decoding.received,
            "sequence": decoding.sequence,
            "lag_s": decoding.lag_s,
            "slow": decoding.is_slow,
            "last_at": self._last_at,
            "problem": decoding.problem,
            "shape": shape and [shape.height, shape.width, shape.packing, shape.pixel_aspect],
            "codec": self._codec,
            "place": newest and [newest.source_s, newest.arrived_at],
            "epoch": newest.epoch if newest else 0,
            "parts": recorder.parts if recorder else 0,
            "recording": recorder.problem if recorder else None,
        }
