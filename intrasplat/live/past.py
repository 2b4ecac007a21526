"""The past of a feed's model: its segments, in memory and on disk, until they are too old or too many.

A thread writes segments to disk, so that a slow disk holds up no model. What is on disk is loaded when it is looked at.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import shutil
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path

from intrasplat.errors import SceneError
from intrasplat.files.disk_errors import DISK_FULL_ERRNOS
from intrasplat.live.past_segment import PastSegment
from intrasplat.live.state import FeedReason
from intrasplat.scene.scene import TrainedScene

logger = logging.getLogger(__name__)

MAX_WAITING = 4
"""Segments that wait to be written. If the disk is slower, the oldest of them is in memory alone."""
CLOSE_S = 10.0
"""For the segments that wait, when the past is closed."""


@dataclass(frozen=True)
class PastSpec:
    """How the past is stored.

    folder       of this feed alone; None: in memory
    keep_s       a segment is deleted this long after its last frame came in
    max_bytes    of all segments: the oldest ones go first
    spare_bytes  segments are written only while more is free: the recording goes on for longer
    cached       segments in memory beside those on disk, or that keep their renderers: the last ones that were added or
                 looked at
    """

    folder: Path | None = None
    keep_s: float = 600.0
    max_bytes: int = 8 << 30
    spare_bytes: int = 256 << 20
    cached: int = 6


class Past:
    """The segments of a feed's model, in order of time. Any thread may call it.

    problem: why segments are not stored at the moment; None: they are, or need not be
    """

    def __init__(self, spec: PastSpec) -> None:
        """Find the segments of earlier runs. OSError: the folder cannot be made or read."""
        self._spec = spec
        self.problem: FeedReason | None = None
        self._lock = threading.Lock()
        self._segments: list[PastSegment] = []
        self._scenes: OrderedDict[int, TrainedScene] = OrderedDict()
        self._queue: queue.SimpleQueue[tuple[PastSegment, TrainedScene] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if spec.folder is not None:
            spec.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            for path in sorted(spec.folder.iterdir()):
                if (segment := PastSegment.at(path)) is not None:
                    self._segments.append(segment)
                else:
                    shutil.rmtree(path, ignore_errors=True)  # of a run that ended while it wrote
            self._thread = threading.Thread(target=self._write, name="live-past", daemon=True)
            self._thread.start()
        self._number = self._segments[-1].number + 1 if self._segments else 0
        self.prune()

    @property
    def stored_bytes(self) -> int:
        """Bytes of all segments on disk."""
        with self._lock:
            return sum(each.bytes for each in self._segments if each.path is not None)

    def segments(self) -> tuple[PastSegment, ...]:
        """All segments, oldest first."""
        with self._lock:
            return tuple(self._segments)

    def add(self, scene: TrainedScene) -> None:
        """Keep a scene of the model as the newest segment."""
        with self._lock:
            segment = PastSegment.of(self._number, scene)
            self._number += 1
            self._segments.append(segment)
            self._cache(segment, scene)
        if self._thread is None:
            return
        if self._queue.qsize() >= MAX_WAITING:
            with contextlib.suppress(queue.Empty):
                self._queue.get_nowait()
                self.problem = FeedReason.DISK_SLOW
        self._queue.put((segment, scene))

    def load(self, segment: PastSegment) -> TrainedScene | None:
        """The segment's scene; None: it is gone meanwhile, or damaged, and is deleted."""
        with self._lock:
            if segment.number in self._scenes:
                self._cache(segment, self._scenes[segment.number])
                return self._scenes[segment.number]
            found = next((each for each in self._segments if each.number == segment.number), None)
        if found is None or found.path is None:
            return None
        try:
            scene = found.load()
        except SceneError:
            if found.path.is_dir():
                logger.exception("a segment of a feed is damaged")
            self._forget([found])
            return None
        with self._lock:
            self._cache(found, scene)
        return scene

    def prune(self) -> None:
        """Delete segments that are too old or too many, oldest first."""
        oldest_at, segments, old = time.time() - self._spec.keep_s, self.segments(), []
        total = sum(each.bytes for each in segments)
        for segment in segments:
            if segment.arrived_at[1] >= oldest_at and total <= self._spec.max_bytes:
                break
            total -= segment.bytes
            old.append(segment)
        self._forget(old)

    def close(self) -> None:
        """Write what waits, and end."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join(CLOSE_S)

    def _cache(self, segment: PastSegment, scene: TrainedScene) -> None:
        """Keep a scene in memory, and drop those that are on disk and were not looked at for long."""
        self._scenes[segment.number] = scene
        self._scenes.move_to_end(segment.number)
        if self._spec.folder is None:
            if len(self._scenes) > self._spec.cached:
                number = [*self._scenes][-self._spec.cached - 1]
                self._scenes[number] = replace(self._scenes[number])  # without what was made to render it
            return
        on_disk = {each.number for each in self._segments if each.path is not None}
        for number in [each for each in self._scenes if each in on_disk][: -self._spec.cached]:
            del self._scenes[number]
        limit = self._spec.cached + 2 * MAX_WAITING  # memory is bounded, whatever the disk does
        for number in [each for each in self._scenes if each not in on_disk][:-limit]:
            self._segments = [each for each in self._segments if each.number != number]
            del self._scenes[number]

    def _forget(self, segments: list[PastSegment]) -> None:
        numbers = {each.number for each in segments}
        with self._lock:
            gone = [each for each in self._segments if each.number in numbers]
            self._segments = [each for each in self._segments if each.number not in numbers]
            for number in numbers:
                self._scenes.pop(number, None)
        for each in gone:
            if each.path is not None:
                shutil.rmtree(each.path, ignore_errors=True)

    def _write(self) -> None:
        while (waiting := self._queue.get()) is not None:
            segment, scene = waiting
            if segment.number not in {each.number for each in self.segments()}:
                continue  # it was forgotten meanwhile
            self.problem = self._written(segment, scene)

    def _written(self, segment: PastSegment, scene: TrainedScene) -> FeedReason | None:
        """Write a segment; why it is not on disk, if it is not."""
        folder = self._spec.folder
        assert folder is not None
        try:
            if shutil.disk_usage(folder).free < self._spec.spare_bytes:
                return FeedReason.DISK_FULL
            written = segment.written(folder, scene)
        except OSError as error:
            return FeedReason.DISK_FULL if error.errno in DISK_FULL_ERRNOS else FeedReason.DISK_FAILS
        except Exception:
            logger.exception("a segment of a feed cannot be stored")
            return FeedReason.FAULT
        with self._lock:
            updated = [written if each.number == segment.number else each for each in self._segments]
            if segment.number in {each.number for each in self._segments}:
                self._segments = updated
                return None
        shutil.rmtree(written.path or folder / written.name, ignore_errors=True)  # it was forgotten meanwhile
        return None
