"""How rates fall and rise again in the iterations of a run, and when early stopping ends it.

A run is a sequence of cycles, each as long as all before it together: warm restarts, after Loshchilov and Hutter
(2017). Rates fall within a cycle, and its last models are averaged (Polyak and Juditsky 1992), so the model at its end
is a finished one. Validation frames, a few of the training frames, show what the last doubling of the iterations
gained. Once early stopping is decided they are trained on too. Nothing here reads the clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from intrasplat.notices import Notice, NoticeCode

MIN_CYCLE_ITERATIONS, MIN_CYCLE_EPOCHS = 250, 3
"""The shortest cycle: the longer of the two."""
RESTART = 0.6
"""The progress at which every cycle but the first starts; rates fall from progress 0 to 1."""
AVERAGED_SHARE, AVERAGED = 1 / 8, 6
"""The last share of a cycle from which models are averaged, and how many of them."""
CLOSING_SHARE, MIN_CLOSING_EPOCHS = 0.25, 2
"""Iterations after early stopping, which train on the validation frames too: their share of those before, and the
fewest epochs. With two epochs a whole one is among them, wherever in an epoch they start."""
MAX_REFIT = 2
"""Largest factor by which the last cycle is longer or shorter than planned. A few timed steps are easily disturbed by
other processes: a third of a minute's iterations was lost on pulls of the phantom."""
VALIDATION_EVERY = 14
"""One training frame in 14 is a validation frame."""
MIN_FRAMES_FOR_VALIDATION = 28
"""With fewer training frames there are no validation frames, and a run uses its whole budget."""


@dataclass(frozen=True)
class Schedule:
    """The cycles of a run; iterations count from 1.

    planned        iterations without early stopping, by the time that the first steps took
    warm_restarts  whether there are several cycles, if planned is long enough for two, and each ends in an average
    min_gain_db    early stopping: the run ends if doubling the iterations gains less on the validation frames; None:
                   there are no validation frames and no early stopping
    epoch          iterations that show every training frame once; a long clip needs long cycles
    scores         psnr_tissue of the validation frames, dB, at the ends of the cycles so far
    opening        first iterations, made before `planned` was known: at full rates, without validation frames
    fitted         iterations by the time that all cycles but the last took; None: not known yet
    """

    planned: int
    warm_restarts: bool = False
    min_gain_db: float | None = None
    epoch: int = 1
    scores: tuple[float, ...] = ()
    opening: int = 0
    fitted: int | None = None

    @property
    def _planned_ends(self) -> tuple[int, ...]:
        ends = [self.planned]
        shortest = max(MIN_CYCLE_ITERATIONS, MIN_CYCLE_EPOCHS * self.epoch)
        while self.warm_restarts and ends[0] // 2 >= shortest:
            ends.insert(0, ends[0] // 2)
        return tuple(ends) if self.fitted is None else (*ends[:-1], self.fitted)

    @property
    def stopped_at(self) -> int | None:
        """The last iteration of the cycle that gained too little; None if there is none so far."""
        if self.min_gain_db is None or len(self.scores) < 2:
            return None
        too_little = self.scores[-1] - self.scores[-2] < self.min_gain_db  # False if one is NaN
        return self._planned_ends[len(self.scores) - 1] if too_little else None

    @property
    def ends(self) -> tuple[int, ...]:
        """The last iteration of every cycle, ascending."""
        stopped_at = self.stopped_at
        if stopped_at is None:
            return self._planned_ends
        closed_at = max(round(stopped_at * (1 + CLOSING_SHARE)), stopped_at + MIN_CLOSING_EPOCHS * self.epoch)
        return (*self._planned_ends[: len(self.scores)], min(self._planned_ends[-1], closed_at))

    @property
    def iterations(self) -> int:
        """Iterations of the whole run; early stopping may still reduce them."""
        return self.ends[-1]

    def cycle(self, iteration: int) -> tuple[int, int]:
        """The iterations after which the cycle of this iteration starts and ends."""
        end = next(end for end in self.ends if iteration <= end)
        return max((each for each in self.ends if each < end), default=0), end

    def progress(self, iteration: int) -> float:
        """How far rates have fallen, in [0, 1]: 1 at the end of every cycle, 0 in the opening."""
        if iteration <= self.opening:
            return 0.0
        start, end = self.cycle(iteration)
        fallen = RESTART if start else 0.0
        return fallen + (1 - fallen) * (iteration - start) / (end - start)

    def averages(self, iteration: int) -> bool:
        """Whether the model after an iteration is one of those that are averaged at the end of the cycle."""
        start, end = self.cycle(iteration)
        apart = max(1, int((end - start) * AVERAGED_SHARE / AVERAGED))
        return self.warm_restarts and (end - iteration) % apart == 0 and (end - iteration) // apart < AVERAGED

    def withholds_validation(self, iteration: int) -> bool:
        """Whether an iteration trains on no validation frame, because early stopping is still undecided."""
        if iteration <= self.opening:
            return self.min_gain_db is not None
        may_stop = self.min_gain_db is not None and len(self._planned_ends) > 2  # two scores, and a cycle to be spared
        return may_stop and iteration <= self.ends[-2]

    def scores_validation(self, iteration: int) -> bool:
        """Whether the validation frames are scored after an iteration; with_score then takes the score."""
        return self.withholds_validation(iteration) and iteration == self._planned_ends[len(self.scores)]

    def with_score(self, psnr_db: float) -> Schedule:
        """The schedule after a cycle's end at which the validation frames scored psnr_db."""
        return replace(self, scores=(*self.scores, psnr_db))

    @property
    def fitted_at(self) -> int | None:
        """The iteration after which the last cycle can be fitted to the time left; None: it cannot be, any more."""
        ends = self._planned_ends
        return ends[-2] if len(ends) > 1 and self.fitted is None and self.stopped_at is None else None

    @property
    def least_end(self) -> int | None:
        """The last iteration if the last cycle is fitted to as few iterations as it can be; None: see fitted_at."""
        *_, end = self._planned_ends
        return None if self.fitted_at is None else self.fitted_at + (end - self.fitted_at) // MAX_REFIT

    def with_last_cycle(self, fitting: int) -> Schedule:
        """The schedule with a last cycle of the iterations that fit, from half to twice as many as planned."""
        *_, start, end = self._planned_ends
        planned = end - start
        return replace(self, fitted=start + min(max(fitting, planned // MAX_REFIT), planned * MAX_REFIT))

    @property
    def settings(self) -> dict[str, Any]:
        """The fields as JSON values; a score of NaN is None."""
        return asdict(self) | {"scores": [None if math.isnan(score) else score for score in self.scores]}

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Schedule:
        """The schedule with these settings. With all scores of a run, it repeats that run without scoring again."""
        scores = tuple(math.nan if score is None else float(score) for score in settings["scores"])
        return cls(**{**settings, "scores": scores})

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What was decided, for the report."""
        if self.stopped_at is None:
            return ()
        text = (
            f"Training ended after {self.iterations} of {self.planned} iterations that the time allowed: doubling the "
            f"first {self.stopped_at // 2} gained {self.scores[-1] - self.scores[-2]:.2f} dB on validation frames, "
            f"less than {self.min_gain_db} dB."
        )
        return (Notice.info(NoticeCode.EARLY_STOPPING, text),)


def validation_frames(frames: Sequence[int]) -> tuple[int, ...]:
    """The inner split of the training frames: every VALIDATION_EVERY-th, never the first or the last."""
    if len(frames) < MIN_FRAMES_FOR_VALIDATION:
        return ()
    return tuple(frames[VALIDATION_EVERY // 2 : -1 : VALIDATION_EVERY])
