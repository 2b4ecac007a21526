"""Remaining time of a reconstruction: the usual time of its stages, scaled by the pace so far.

Usual seconds are for both eyes, on two cores of the machine in lab/rows/post.csv.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from intrasplat.machine.hooks import Progress

USUAL_S = {
    "decode": (1.0, 0.0),
    "stereo": (0.8, 0.09),
    "masks": (0.0, 0.0),
    "poses": (0.1, 0.0),
    "motion": (0.1, 0.03),
    "fusion": (0.2, 0.02),
    "start": (0.4, 0.01),
    "calibrate": (0.8, 0.0),
    "train": (0.0, 0.0),
    "finish": (1.5, 0.02),
    "publish": (0.7, 0.0),
}
"""Stages in order: fixed seconds, and seconds per megapixel of all frames of one eye."""
COMPILATION = "compile"
"""A stage that may follow any other; kernels that are compiled already take no time."""
IN_BUDGET = ("motion", "fusion", "start", "calibrate")
"""Stages whose time counts in a budget, besides training."""
USUAL_MEGAPIXELS = 30.0
"""Assumed size of a clip until it is known."""
STEP_S = 0.12
"""Assumed seconds of a step on both eyes, per megapixel of a frame, until training reports its own."""
LEAST_PACE, MOST_PACE = 0.5, 5.0
TRUSTED_S = 1.5
"""Prior of the pace, as seconds of work at the usual pace: little work says little about the pace."""


class TimeEstimate:
    """Adds seconds_left to each report of progress.

    Args:
        iterations, budget_s: length of training; one of the two is None.
        most_frames: maximum number of training frames; None: all.
        clock: returns monotonic seconds.
    """

    def __init__(
        self,
        iterations: int | None,
        budget_s: float | None,
        most_frames: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._iterations = iterations
        self._budget_s = budget_s
        self._most_frames = most_frames
        self._clock = clock
        self._started_s = clock()
        self._reached = "decode", 0.0  # stage and fraction
        self._frames = 0
        self._megapixels = USUAL_MEGAPIXELS

    def completed(self, progress: Progress) -> Progress:
        """The report with the estimated seconds until the scene is finished."""
        if progress.stage not in (*USUAL_S, COMPILATION):
            return progress
        if progress.frames:
            self.learn(progress.frames, progress.megapixels)
        if progress.stage != COMPILATION:
            self._reached = progress.stage, progress.fraction
        reached, fraction = self._reached
        usual = self._usual_s()
        stages = list(usual)
        place = stages.index(reached)
        rest_s = sum(usual[stage] for stage in stages[place + 1 :])
        pace = self._pace(sum(usual[stage] for stage in stages[:place]) + fraction * usual[reached])
        own_s = (1 - fraction) * usual[reached]
        if progress.stage == "train" and progress.seconds_left is not None:
            return replace(progress, seconds_left=progress.seconds_left + pace * rest_s)
        # A budget lasts the same time on any machine, so the pace does not scale it.
        in_budget = self._budget_s is not None and place <= stages.index("train")
        fixed_s = usual["train"] if in_budget else 0.0
        return replace(progress, seconds_left=pace * (own_s + rest_s - fixed_s) + fixed_s)

    def learn(self, frames: int, megapixels: float) -> None:
        """Set the clip's number of frames, and the megapixels of all frames of one eye."""
        used = frames if self._most_frames is None else min(frames, self._most_frames)
        self._frames, self._megapixels = used, megapixels * used / frames

    def _usual_s(self) -> dict[str, float]:
        usual = {stage: fixed + each * self._megapixels for stage, (fixed, each) in USUAL_S.items()}
        if self._iterations is not None:
            frame_megapixels = self._megapixels / self._frames if self._frames else 0.3
            usual["train"] = self._iterations * STEP_S * frame_megapixels
        elif self._budget_s is not None:
            usual["train"] = max(1.0, self._budget_s - sum(usual[stage] for stage in IN_BUDGET))
        return usual

    def _pace(self, done_s: float) -> float:
        """Actual over usual time of the work so far, limited. done_s: its usual time."""
        pace = (self._clock() - self._started_s + TRUSTED_S) / (done_s + TRUSTED_S)
        return min(max(pace, LEAST_PACE), MOST_PACE)
