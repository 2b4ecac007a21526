"""A feed of the queue as its process follows it: made from its record, with what is pushed, cut, and said of it."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from contract.runtime.feed_sources import allowed_hosts
from contract.runtime.settings import Settings
from contract.wire.feeds import FeedRecord, FeedReport, FeedWish
from intrasplat.errors import InputError
from intrasplat.intake.calibration.text import parse_text, read_calibration
from intrasplat.live.feed import Feed, FeedSettings
from intrasplat.live.spec import FIELD, RecordingSpec, SourceSpec
from intrasplat.live.state import FeedReason, FeedState, LiveReport
from intrasplat.splat.backend import CPU, Device
from worker.reply import NotYetError


class HostedFeed:
    """A feed that is followed from begin() to close(). Any thread may call it.

    feed_id   as in its record
    state     when report() was called last
    newest_s  source time of the newest moment that was known then; -1: none was
    """

    def __init__(self, record: FeedRecord, folder: Path, settings: Settings, device: Device = CPU) -> None:
        self.feed_id = record.feed_id
        self.state, self.newest_s = FeedState.CONNECTING, -1.0
        self._record, self._folder, self._settings, self._device = record, folder, settings, device
        self._changing = threading.Lock()
        self._feed: Feed | None = None
        self._pictures = False
        self._refused: InputError | None = None
        self._since_s = time.time()
        self._wish = FeedWish.RUN

    @property
    def feed(self) -> Feed:
        """The feed.

        Raises:
            InputError: it cannot be followed.
            NotYetError: it has not begun, or has ended.
        """
        feed = self._feed
        if feed is None and self._refused is not None:
            raise self._refused
        if feed is None:
            raise NotYetError("The feed is not followed yet.")
        return feed

    def begin(self) -> None:
        """Follow it from now on; if that cannot be, report() says why."""
        with self._changing:
            try:
                self._feed = self._made()
            except InputError as error:
                self._refused = error

    def wish(self, wish: FeedWish) -> None:
        """Pause it, or go on; this may take seconds."""
        with self._changing:
            if self._feed is not None and wish is FeedWish.PAUSE:
                self._feed.pause()
            elif self._feed is not None and self._wish is FeedWish.PAUSE:
                self._feed.resume()
            self._wish = wish

    def expect(self, *, pictures: bool) -> Feed:
        """The feed, to which a video or pictures are pushed from now on: it begins anew for the other of the two."""
        with self._changing:
            if pictures != self._pictures and self._record.options.source is None and self._feed is not None:
                before, self._pictures, self._feed = self._feed, pictures, None
                before.close()
                self._feed = self._made()
        return self.feed

    def report(self) -> FeedReport:
        """What it does now."""
        if self._feed is None:
            report = FeedReport(state=FeedState.CONNECTING, since_s=self._since_s)
            if self._refused is not None:
                changes = {"state": FeedState.ENDED, "reason": _reason_of(self._refused), "text": str(self._refused)}
                report = report.model_copy(update=changes)
        else:
            report = _report_of(self._feed.report())
        self.state = report.state
        self.newest_s = -1.0 if report.source_ends_s is None else report.source_ends_s
        return report

    def close(self) -> None:
        """End it; what is on disk stays, and is its past when it begins again."""
        with self._changing:
            if self._feed is not None:
                self._feed.close()

    def _made(self) -> Feed:
        check_calibration_of(self._record)
        calibration = self._folder / Path(self._record.calibration_name).name  # what it says depends on the pictures
        calibration.write_text(self._record.calibration, encoding="utf-8")
        options, half = self._record.options, self._settings.feed_disk_bytes // 2
        keep_s = min(options.keep_s, self._settings.feed_keep_s)
        source = SourceSpec(
            options.source,
            pictures=self._pictures,
            layout=options.layout,
            recording=RecordingSpec(self._folder / "recording", keep_s, max_bytes=half),
            hosts=allowed_hosts(options.source, self._settings),
            limits=self._settings.clip_limits,
        )
        segments = self._folder / "segments"
        feed = FeedSettings(options.width, options.camera, keep_s, segments=segments, max_bytes=half)
        made = Feed(source, calibration, feed, self._device)
        if self._wish is FeedWish.PAUSE:
            made.pause()
        return made


def check_calibration_of(record: FeedRecord) -> None:
    """Raises InputError if the calibration cannot be used, whatever the pictures are."""
    if parse_text(record.calibration) is None:  # its parser is not safe enough for a process that is not confined
        problem = f"{record.calibration_name[:80]} is XML."
        raise InputError("calibration", problem, "Send it as JSON, YAML or ini.")
    read_calibration(record.calibration)


def _reason_of(refused: InputError) -> FeedReason:
    return FeedReason.HOST_REFUSED if refused.field == FIELD else FeedReason.CALIBRATION


def _report_of(report: LiveReport) -> FeedReport:
    numbers, past, model = report.numbers, report.past, report.model
    return FeedReport(
        state=report.state,
        reason=report.reason,
        text=report.text,
        since_s=report.since,
        recording=report.recording,
        received_fps=numbers.received_fps,
        used_fps=numbers.used_fps,
        dropped=numbers.dropped,
        model_age_s=numbers.model_age_s,
        decode_lag_s=numbers.decode_lag_s,
        reconnects=numbers.reconnects,
        last_frame_at_s=numbers.last_frame_at,
        stored_bytes=numbers.stored_bytes,
        begins_s=None if past is None else past.begins_at,
        ends_s=None if past is None else past.ends_at,
        source_begins_s=None if past is None else past.begins_s,
        source_ends_s=None if past is None else past.ends_s,
        width=None if model is None else model.width,
        height=None if model is None else model.height,
        gaussians=0 if model is None else model.gaussians,
    )
