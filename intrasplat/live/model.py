"""The model of a feed while it is followed: a thread gives the newest pairs of a source to a follower.

It chooses the size of the model's pictures, and begins another follower after a fault.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median

from intrasplat.errors import InputError
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.live.follow import MIN_STEPS, Added, Follower, FollowSettings
from intrasplat.live.looking import WINDOW
from intrasplat.live.pair import FeedPair
from intrasplat.live.past import Past
from intrasplat.live.past_segment import PastSegment
from intrasplat.live.source import Source
from intrasplat.live.state import FeedReason, FeedState, ModelNumbers
from intrasplat.live.tissue import TissueWatch, has_colours_of_tissue, is_near
from intrasplat.machine.hooks import always
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device

logger = logging.getLogger(__name__)

POLL_S = 0.5
COMING_S = 0.02
"""Longest wait for the pair that is read while the one before it is learnt."""
IDLE_S = 0.1
"""Between looks at a source that is paused or has ended."""
WINDOW_S = 5.0
"""Over which the rate of used pairs is measured."""
WIDTHS = (240, 320, 480, 640, 960)
"""Widths of the model's pictures, px, from which one is chosen; the first pairs have FIRST_WIDTH."""
FIRST_WIDTH = 320
JUDGED_PAIRS = 12
"""Pairs over which the steps are counted before a width is chosen."""
WANTED_STEPS = 10.0
"""Steps a pair that a larger width must leave."""
PERIOD_S, LARGE_PERIOD_S, GPU_PERIOD_S = 0.175, 0.28, 0.035
"""Of the work on a pair, with pictures up to LARGE_FROM px wide, with wider ones, and on a GPU."""
LARGE_FROM = 400
LEAST_BUDGET_SHARE = 0.4
"""Of the period, for reading and training, however long the rest takes."""
NO_SCENE_S = 3.0
"""While pairs come in, and none can be used for longer, the feed is stalled."""
FIRST_BACK_OFF_S, MOST_BACK_OFF_S = 0.5, 8.0
"""After a fault, and after several in turn."""


@dataclass(frozen=True)
class Trouble:
    """Why the model does not go on. error: what is wrong with the input, if that is why."""

    reason: FeedReason
    text: str
    error: InputError | None = None


def chosen_width(steps: float, width: int, recorded_width: int) -> int:
    """The largest width that leaves WANTED_STEPS a pair, where `width` leaves `steps`."""
    sizes = [each for each in WIDTHS if each < recorded_width] + [recorded_width]
    fitting = [each for each in sizes if steps * (width / each) ** 2 >= WANTED_STEPS]
    return max(fitting, default=sizes[0])


class FeedModel:
    """Follows a source since it was made. Any thread may call it."""

    def __init__(
        self,
        source: Source,
        calibration: StereoCalibration | Path,
        settings: FollowSettings,
        past: Past,
        device: Device = CPU,
        budget_s: float | None = None,
        watch: TissueWatch | None = None,
    ) -> None:
        """settings.eyes.width: None: it is chosen. budget_s: seconds for each pair; None: what size and device
        want, less what its look at the trained model takes.

        watch: is given what each pair shows; pairs without tissue are not learnt. None: all are.
        """
        self._watch = watch
        self._source, self._calibration, self._settings, self._past = source, calibration, settings, past
        self._device, self._budget_s = device, budget_s
        self.changed = threading.Condition()
        self._learning = threading.Lock()
        self._follower: Follower | None = None
        self._trouble: Trouble | None = None
        self._closed = False
        self._used = self._given = 0
        self._coming: FeedPair | None = None
        self._used_at: deque[float] = deque()
        self._steps: deque[int] = deque(maxlen=JUDGED_PAIRS)
        self._over_s: deque[float] = deque(maxlen=JUDGED_PAIRS)
        self._width = settings.eyes.width
        self._has_chosen = settings.eyes.width is not None
        self._began_s = self._tried_at = time.monotonic()
        self._unused_s = 0.0
        self._thread = threading.Thread(target=self._run, name="live-model", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> Trouble | None:
        """Why pairs that come in are not learnt; None: they are."""
        trouble = self._trouble
        if trouble is None and self._unused_s > NO_SCENE_S:
            return Trouble(FeedReason.NO_SCENE, "the pairs show no scene with depth")
        return trouble

    def scene(self) -> TrainedScene | None:
        """The scene of the newest frames; None: no model has begun since this one was made."""
        follower = self._follower
        found = None if follower is None else follower.scene_at()
        return None if found is None else found[0]

    def span(self) -> PastSegment | None:
        """What the scene of the newest frames covers."""
        follower = self._follower
        found = None if follower is None else follower.span
        if found is None:
            return None
        first, newest = found
        return PastSegment(WINDOW, (first.source_s, newest.source_s), (first.arrived_at, newest.arrived_at))

    def used_fps(self) -> float:
        """Pairs that were learnt a second, over the last seconds."""
        with self.changed:
            while self._used_at and time.monotonic() - self._used_at[0] > WINDOW_S:
                self._used_at.popleft()
            age_s = time.monotonic() - self._began_s
            return len(self._used_at) / min(WINDOW_S, max(age_s, 1.0))

    @property
    def has_begun(self) -> bool:
        """Whether it has learnt a pair."""
        return self._used > 0

    @property
    def left_out(self) -> int:
        """Pairs that the source handed over and no model has learnt."""
        return self._given - self._used

    def numbers(self) -> ModelNumbers | None:
        """Iteration, size and steps; None: there is no model yet."""
        follower = self._follower
        found = None if follower is None else follower.span
        if follower is None or found is None:
            return None
        camera, steps = found[1].clip.intrinsics, float(median([*self._steps] or [0]))
        return ModelNumbers(follower.iteration, follower.gaussians, camera.width, camera.height, steps)

    def settle(self) -> None:
        """Wait until the pair that is being learnt is known. Of a source that is paused, none follows."""
        with self._learning:
            pass

    def close(self) -> None:
        """End. What the model knows becomes a segment."""
        self._closed = True
        with self.changed:
            self.changed.notify_all()
        self._thread.join(MOST_BACK_OFF_S)

    def _run(self) -> None:
        failures, after = 0, 0
        while not self._closed:
            try:
                pair, self._coming = self._coming or self._source.newest(after, POLL_S), None
                self._past.prune()
                if pair is None:
                    if self._watch is not None and self._source.state is FeedState.ENDED:
                        self._watch.end()
                    self._rest(IDLE_S)
                    continue
                after = pair.sequence
                with self._learning:
                    if self._source.state is not FeedState.PAUSED and self._is_tissue(pair):
                        self._take(pair)
                failures = 0
            except Exception as error:
                failures += 1
                self._fail(error)
                self._rest(min(MOST_BACK_OFF_S, FIRST_BACK_OFF_S * 2.0 ** min(failures - 1, 10)))
        self._end_follower()

    def _take(self, pair: FeedPair) -> None:
        """Learn a pair."""
        now_s = time.monotonic()
        self._unused_s += min(now_s - self._tried_at, POLL_S)  # while none comes in, there is nothing to be used
        self._tried_at = now_s
        follower = self._follower or self._begun()
        before, budget_s, start_s = follower.iteration, self._budget(), time.perf_counter()
        became = follower.add(pair, budget_s, partial(self._next, pair.sequence))
        if became is not Added.NO_SCENE or self._used:  # without a scene so far, the calibration may be wrong
            self._saw(pair, is_tissue=became not in (Added.NO_TISSUE, Added.NO_SCENE))
        if became not in (Added.FIRST, Added.FOLLOWED, Added.RESTARTED):
            return
        with self.changed:
            self._used += 1
            self._unused_s = 0.0
            self._used_at.append(time.monotonic())
            if became is Added.FOLLOWED:
                self._steps.append(follower.iteration - before)
                self._over_s.append(time.perf_counter() - start_s - budget_s)
            self._trouble = None
            self.changed.notify_all()
        self._choose_width(pair.left.shape[1])

    def _next(self, after: int) -> FeedPair | None:
        """The newest pair, to be read while the one before it is learnt."""
        self._coming = self._source.newest(after, COMING_S)
        return self._coming

    def _is_tissue(self, pair: FeedPair) -> bool:
        """Whether a pair is to be learnt, by its colours."""
        self._given += 1
        if self._watch is None:
            return True
        if has_colours_of_tissue(pair.left):
            return self._watch.may_be_back()
        self._saw(pair, is_tissue=False)
        self._rest(IDLE_S)
        return False

    def _saw(self, pair: FeedPair, *, is_tissue: bool) -> None:
        """Note what a pair shows. When the endoscope goes out, the model ends, and what it recorded is deleted."""
        if self._watch is not None and self._watch.see(pair.source_s, is_tissue=is_tissue):
            if self._follower is not None:
                self._follower.write_off()
            if self._source.parts is not None:
                self._source.parts.forget(self._watch.tissue_until_s)

    def _begun(self) -> Follower:
        """Another follower."""
        width = self._width or FIRST_WIDTH
        settings = replace(self._settings, eyes=replace(self._settings.eyes, width=width), keep_s=0.0)
        judge = always if self._watch is None else is_near
        self._follower = Follower(self._calibration, settings, self._device, self._past.add, judge)
        return self._follower

    def _budget(self) -> float:
        """Seconds for the next pair."""
        if self._budget_s is not None:
            return self._budget_s
        if self._device.kind != CPU.kind:
            period_s = GPU_PERIOD_S
        else:
            period_s = PERIOD_S if (self._width or FIRST_WIDTH) <= LARGE_FROM else LARGE_PERIOD_S
        return max(LEAST_BUDGET_SHARE * period_s, period_s - median([*self._over_s] or [0.0]))

    def _choose_width(self, recorded_width: int) -> None:
        """Once, after some pairs, the width that the machine keeps up with; later a smaller one if it does not."""
        if self._settings.eyes.width is not None or len(self._steps) < JUDGED_PAIRS:
            return
        width, steps = self._width or min(FIRST_WIDTH, recorded_width), float(median(self._steps))
        if self._has_chosen and steps > MIN_STEPS:
            return
        self._has_chosen, chosen = True, chosen_width(steps, width, recorded_width)
        if chosen != width:
            self._width = chosen
            self._steps.clear()
            self._over_s.clear()
            self._end_follower()

    def _end_follower(self) -> None:
        """End the follower; what it knows becomes a segment."""
        follower = self._follower
        if follower is not None:
            try:
                follower.write_off()
            except Exception:  # what it knows is what failed
                logger.exception("a model of a feed is lost")
            self._follower = None  # not before: until then what it knows is no segment
            follower.close()

    def _fail(self, error: Exception) -> None:
        self._coming = None  # it will be old
        if isinstance(error, InputError):
            self._trouble = Trouble(FeedReason.CALIBRATION, str(error), error)
        else:
            logger.error("the model of a feed failed", exc_info=error)
            self._trouble = Trouble(FeedReason.FAULT, "a fault of the program; another model begins")
        self._end_follower()

    def _rest(self, seconds: float) -> None:
        """Wait, but not beyond the end."""
        with self.changed:
            if not self._closed:
                self.changed.wait(seconds)
