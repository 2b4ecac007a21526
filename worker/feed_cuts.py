"""Cut files out of a feed's recording, and hand them out in parts."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path

from contract.wire.feeds import CutRange
from contract.wire.rendering import CutRequest
from intrasplat.errors import InputError, SceneError
from intrasplat.live.cut import FIELD, Cut
from intrasplat.live.parts import Part
from intrasplat.live.times import FeedTime, FeedTimeKind
from worker.exports import OpenExports
from worker.hosted_feed import HostedFeed
from worker.reply import Reply

PART_BYTES = 1 << 20
PATIENCE_S = 2.0
"""After so long without a file an empty part says that it is being made."""
MEDIA_TYPES = {"mp4": "video/mp4", "mkv": "video/x-matroska"}


class FeedCuts:
    """The cuts of one feed; one thread asks for parts. folder: for files until they are handed out."""

    def __init__(self, hosted: HostedFeed, folder: Path) -> None:
        self._hosted, self._folder = hosted, folder
        self._open = OpenExports()
        self._found: dict[str, tuple[CutRange, str]] = {}
        self._makers = ThreadPoolExecutor(1, thread_name_prefix="cut")
        self._at_work = threading.Lock()

    def part(self, request: CutRequest, content: bytes) -> Reply:
        """One part of a cut. The first one with bytes names its range.

        Raises:
            SceneError: another feed is meant, or this cut is not in progress.
            InputError: nothing of the range is recorded.
            UnavailableError: the disk is full, or too many cuts are in progress.
        """
        del content
        if request.scene_id != self._hosted.feed_id:
            raise SceneError("This process follows another feed.")
        with self._at_work:
            part, more = self._open.part(request, lambda: self._parts(request))
            found, media_type = self._found.get(request.export_id, (None, MEDIA_TYPES["mp4"]))
        return Reply(part, media_type, 0.0, cut=found, is_untimed=True, more=more)

    def forget_idle(self) -> None:
        """Delete the files that nobody fetched. Any thread may call it, regularly."""
        if self._at_work.acquire(blocking=False):
            try:
                self._open.forget()
            finally:
                self._at_work.release()

    def _parts(self, request: CutRequest) -> Generator[bytes]:
        feed = self._hosted.feed
        path, recorded = self._folder / request.export_id, feed.recorded()
        from_s, to_s = _source_times(recorded, request.begins, request.ends)
        making: Future[Cut] = self._makers.submit(feed.cut, from_s, to_s, path)
        try:
            while not wait([making], PATIENCE_S).done:
                yield b""
            cut = making.result()
            arrivals = _arrival(recorded, cut.from_s), _arrival(recorded, cut.to_s)
            found = CutRange(from_s=arrivals[0], to_s=arrivals[1], frames=cut.frames, is_whole=cut.is_whole)
            self._found[request.export_id] = found, MEDIA_TYPES[cut.container]
            with path.open("rb") as file:
                while part := file.read(PART_BYTES):
                    yield part
        finally:
            making.add_done_callback(lambda _: path.unlink(missing_ok=True))
            self._found.pop(request.export_id, None)


def _source_times(recorded: Sequence[Part], begins: FeedTime, ends: FeedTime) -> tuple[float, float]:
    """Source times of the recorded frames between two moments, each a UNIX time of arrival or one of the source."""
    within = [each for each in recorded if begins.seconds <= _span(each, begins)[1]]
    within = [each for each in within if ends.seconds >= _span(each, ends)[0]]
    if not within:
        arrived = (recorded[0].first_arrived_at, recorded[-1].last_arrived_at) if recorded else ()
        there = " to ".join(time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(each)) for each in arrived)
        first = f"Ask for a time from {there}, or" if there else "Ask"
        remedy = f"{first} again in some seconds: the newest ones are recorded when their part is complete."
        raise InputError(FIELD, "nothing of this range is recorded.", remedy)
    return _source_s(within[0], begins), _source_s(within[-1], ends)


def _span(part: Part, moment: FeedTime) -> tuple[float, float]:
    """What a part covers, in the time of a moment."""
    if moment.kind is FeedTimeKind.SOURCE:
        return part.from_s, part.to_s
    return part.first_arrived_at, part.last_arrived_at


def _source_s(part: Part, moment: FeedTime) -> float:
    """The source time of a moment in or beside a part."""
    return min(part.from_s + max(0.0, moment.seconds - _span(part, moment)[0]), part.to_s)


def _arrival(recorded: Sequence[Part], source_s: float) -> float:
    """When the frame of a source time arrived, UNIX s."""
    part = next((each for each in recorded if each.to_s >= source_s), recorded[-1])
    return min(part.last_arrived_at, part.first_arrived_at + max(0.0, source_s - part.from_s))
