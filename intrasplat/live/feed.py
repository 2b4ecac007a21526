"""Feed: a live source, the model that follows it, and its past, as one object."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from intrasplat.errors import InputError
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.live.cut import Cut
from intrasplat.live.follow import FollowSettings
from intrasplat.live.looking import FeedMoment, find_moment, range_of
from intrasplat.live.model import FeedModel
from intrasplat.live.pair import FeedPair
from intrasplat.live.parts import Part
from intrasplat.live.past import Past, PastSpec
from intrasplat.live.past_segment import PastSegment
from intrasplat.live.source import Source
from intrasplat.live.spec import SourceSpec
from intrasplat.live.state import FeedReason, FeedState, LiveReport, StateClock
from intrasplat.live.times import LIVE, FeedTime
from intrasplat.live.tissue import TissueWatch
from intrasplat.splat.backend import CPU, Device

PEEK_S = 0.05
"""How long a newer pair is waited for where somebody only looks: the model may wait for one, too."""
MAX_MEMORY_BYTES = 512 << 20
"""Of a past that is in memory."""


@dataclass(frozen=True)
class FeedSettings:
    """How a feed is followed, and what of it is stored. The SourceSpec says what is recorded.

    width        of the model's pictures, px; None: what the machine keeps up with
    camera       as in FollowSettings
    keep_s       seconds of the past that can be viewed
    segments     folder of the past, of this feed alone; None: it is in memory, and ends with the feed
    max_bytes    of the past on disk; in memory, MAX_MEMORY_BYTES if that is less
    max_age_s    a feed whose model is older is behind, and its newest moment is stale
    budget_s     seconds for each pair; None: chosen by size and device
    finds_tissue whether nothing is learnt, shown or stored while the pictures show no tissue
    follow       the other settings of the follower; its width, camera and keep_s are not used
    """

    width: int | None = None
    camera: Literal["fixed", "moving"] = "fixed"
    keep_s: float = 600.0
    segments: Path | None = None
    max_bytes: int = 8 << 30
    max_age_s: float = 2.5
    budget_s: float | None = None
    finds_tissue: bool = True
    follow: FollowSettings = field(default_factory=FollowSettings)

    def of_follower(self) -> FollowSettings:
        """The follower's settings."""
        return replace(self.follow, eyes=replace(self.follow.eyes, width=self.width), camera=self.camera)

    def of_past(self) -> PastSpec:
        """What is stored of the model."""
        max_bytes = self.max_bytes if self.segments else min(self.max_bytes, MAX_MEMORY_BYTES)
        return PastSpec(self.segments, self.keep_s, max_bytes)


class Feed:
    """A feed that is read and followed since it was made. Any thread may call it. A context manager.

    Example:
        with Feed(SourceSpec("rtsp://camera.example.org/stereo"), calibration) as feed:
            newest_s = feed.wait_for_newer(-1.0, timeout_s=10.0)
            shown = feed.moment(FeedTime.before_live(2.0))
            view = render_frame(shown.scene, shown.t)
    """

    def __init__(
        self,
        source: SourceSpec,
        calibration: StereoCalibration | Path,
        settings: FeedSettings | None = None,
        device: Device = CPU,
    ) -> None:
        """Raises InputError as SourceSpec.target; OSError: a folder cannot be used."""
        self.settings = settings or FeedSettings()
        self._past = Past(self.settings.of_past())
        earlier = self._past.segments()
        place = (earlier[-1].source_s[1], earlier[-1].arrived_at[1]) if earlier else None
        self._watch = TissueWatch() if self.settings.finds_tissue else None
        try:
            self._source = Source(source, place, None if self._watch is None else self._watch.keeps)
        except BaseException:
            self._past.close()
            raise
        of_follower, budget_s = self.settings.of_follower(), self.settings.budget_s
        self._model = FeedModel(self._source, calibration, of_follower, self._past, device, budget_s, self._watch)
        self._looking = threading.Lock()
        self._seen: FeedPair | None = None
        self._state = StateClock(FeedState.CONNECTING)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def report(self) -> LiveReport:
        """State, numbers, model and past of now."""
        status, numbers, window = self._source.status, self._source.numbers(), self._model.span()
        past = range_of(window, self._past)
        age_s = None if past is None else time.time() - past.ends_at
        state, reason, text = self._situation(age_s)
        numbers = replace(
            numbers,
            used_fps=self._model.used_fps(),
            dropped=numbers.dropped + self._model.left_out,
            stored_bytes=numbers.stored_bytes + self._past.stored_bytes,
            model_age_s=age_s,
        )
        return LiveReport(
            state=state,
            reason=reason,
            text=text,
            since=self._state.since(state, reason),
            recording=status.recording or self._past.problem,
            numbers=numbers,
            model=self._model.numbers(),
            past=past,
            segment=self._source.segment,
        )

    @property
    def error(self) -> InputError | None:
        """What is wrong with the calibration or another input, so that pairs cannot be learnt; None: nothing."""
        trouble = self._model.trouble
        return None if trouble is None else trouble.error

    def _situation(self, age_s: float | None) -> tuple[FeedState, FeedReason | None, str]:
        """State, reason and text of source and model; age_s: of the newest moment that is known, if one is."""
        status = self._source.status
        if status.state not in (FeedState.LIVE, FeedState.BEHIND):
            return status.state, status.reason, status.text
        if self._watch is not None and self._watch.is_out:
            return FeedState.NO_TISSUE, None, "the pictures show no tissue: nothing of them is stored"
        trouble = self._model.trouble
        if trouble is not None:
            return FeedState.STALLED, trouble.reason, trouble.text
        if age_s is None or not self._model.has_begun:
            return FeedState.CONNECTING, None, "the model begins"
        if age_s > self.settings.max_age_s:
            return FeedState.BEHIND, FeedReason.TOO_SLOW, "the model does not keep up"
        return status.state, status.reason, status.text

    def moment(self, when: FeedTime = LIVE) -> FeedMoment | None:
        """The moment of a time, to be rendered; None: nothing is known yet.

        While the feed goes on, a time that the model has not come to yet gives its newest moment.

        Raises:
            InputError: the time lies before the past that is stored; its field is "t".
        """
        past = range_of(self._model.span(), self._past)
        state, _, _ = self._situation(None if past is None else time.time() - past.ends_at)
        goes_on = state in (FeedState.LIVE, FeedState.BEHIND)
        return find_moment(when, self._model.scene(), self._past, self.settings.max_age_s, goes_on=goes_on)

    def picture(self) -> FeedPair | None:
        """The newest pair that came in, whether or not the model learns it. None: there is none since this feed was
        made, or it shows no tissue."""
        with self._looking:
            if self._watch is not None and self._watch.is_out:
                self._seen = None
                return None
            after = 0 if self._seen is None else self._seen.sequence
            self._seen = self._source.peek(after, PEEK_S) or self._seen
            return self._seen

    def wait_for_newer(self, source_s: float, timeout_s: float) -> float | None:
        """The source time of the newest known moment as soon as that is after source_s; None: not in time."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            known = range_of(self._model.span(), self._past)
            if known is not None and known.ends_s > source_s:
                return known.ends_s
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                return None
            with self._model.changed:
                self._model.changed.wait(min(left_s, 0.1))

    def segments(self) -> tuple[PastSegment, ...]:
        """The past's segments, oldest first."""
        return self._past.segments()

    def recorded(self) -> tuple[Part, ...]:
        """What is recorded, oldest first."""
        return self._source.index()

    def cut(self, from_s: float, to_s: float, path: Path) -> Cut:
        """One playable file of the recorded packets of [from_s, to_s] in source time; see cut_parts."""
        return self._source.cut(from_s, to_s, path)

    def pause(self) -> None:
        """Read, learn and store nothing more once this returns; what is known stays."""
        self._source.pause()
        self._model.settle()

    def resume(self) -> None:
        """Go on at the source's present."""
        self._source.resume()

    def write(self, data: bytes, timeout_s: float = 10.0) -> None:
        """Push bytes of a stream; see Source.write."""
        self._source.write(data, timeout_s)

    def write_picture(self, data: bytes, captured_s: float | None = None, timeout_s: float = 10.0) -> None:
        """Push a picture of both eyes; see Source.write_picture."""
        self._source.write_picture(data, captured_s, timeout_s)

    def end_push(self) -> None:
        """The pushed stream has ended; another may begin."""
        self._source.end_push()

    def close(self) -> None:
        """End it. What is on disk stays, and is the past of a feed that is made with the same folders."""
        self._model.close()
        if self._watch is not None:
            self._watch.end()
        self._source.close()
        self._past.close()
