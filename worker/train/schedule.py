"""When rates fall, when they rise again, and when a run has gone on for long enough.

A run is a row of cycles, each as long as all before it together (after Loshchilov and Hutter 2017). Rates fall within a
cycle, and its last steps are averaged (Polyak and Juditsky 1992), so the model at its end is a finished one. What the
last doubling of the steps was worth can be told then, on a few training frames that are left out until it is decided.
The clock has no say, so the same seed and iterations do the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

SHORTEST_CYCLE, SHORTEST_CYCLE_EPOCHS = 250, 3
"""Iterations, and epochs: a cycle has as many as both ask for."""
RESTART = 0.6
"""How far rates have fallen already where every cycle but the first begins."""
AVERAGED_SHARE, AVERAGED = 1 / 8, 6
"""The last share of a cycle from which models are averaged, and how many of them."""
CLOSING_SHARE, CLOSING_EPOCHS = 0.25, 2
"""Iterations after a stop, in which the frames left out are learnt too, over those before it; and the fewest epochs:
wherever in one they begin, a whole one follows."""
JUDGE_EVERY = 14
FEWEST_FRAMES_TO_JUDGE = 28
"""Of fewer training frames none is left out, and a run takes the time it is given."""


@dataclass(frozen=True)
class Schedule:
    """The cycles of a run; iterations count from 1.

    planned   iterations if nothing stops the run
    cycles    whether there are several, if planned is long enough for two, and averages end them
    worth_db  a doubling of the steps that brings the frames left out less than this is the last; None: no frame is left
              out, and nothing stops the run
    epoch     iterations that show every training frame, those left out among them; a long clip needs long cycles
    scores    psnr_tissue of the frames left out, dB, at the ends of the cycles so far
    """

    planned: int
    cycles: bool = False
    worth_db: float | None = None
    epoch: int = 1
    scores: tuple[float, ...] = ()

    @property
    def _planned_ends(self) -> tuple[int, ...]:
        ends = [self.planned]
        shortest = max(SHORTEST_CYCLE, SHORTEST_CYCLE_EPOCHS * self.epoch)
        while self.cycles and ends[0] // 2 >= shortest:
            ends.insert(0, ends[0] // 2)
        return tuple(ends)

    @property
    def stopped_at(self) -> int | None:
        """The end of the cycle that was worth too little; None as long as there is none."""
        if self.worth_db is None or len(self.scores) < 2:
            return None
        too_little = self.scores[-1] - self.scores[-2] < self.worth_db  # never of scores that are no numbers
        return self._planned_ends[len(self.scores) - 1] if too_little else None

    @property
    def ends(self) -> tuple[int, ...]:
        """The last iteration of every cycle, ascending."""
        stopped_at = self.stopped_at
        if stopped_at is None:
            return self._planned_ends
        closed_at = max(round(stopped_at * (1 + CLOSING_SHARE)), stopped_at + CLOSING_EPOCHS * self.epoch)
        return (*self._planned_ends[: len(self.scores)], min(self.planned, closed_at))

    @property
    def iterations(self) -> int:
        """Of the whole run, as far as is known."""
        return self.ends[-1]

    def cycle(self, iteration: int) -> tuple[int, int]:
        """The iterations after which its cycle begins and ends."""
        end = next(end for end in self.ends if iteration <= end)
        return max((each for each in self.ends if each < end), default=0), end

    def progress(self, iteration: int) -> float:
        """How far rates have fallen, in (0, 1]: 1 at the end of every cycle."""
        begun, end = self.cycle(iteration)
        fallen = RESTART if begun else 0.0
        return fallen + (1 - fallen) * (iteration - begun) / (end - begun)

    def averages(self, iteration: int) -> bool:
        """Whether the model after an iteration is one of those whose mean ends the cycle."""
        begun, end = self.cycle(iteration)
        apart = max(1, int((end - begun) * AVERAGED_SHARE / AVERAGED))
        return self.cycles and (end - iteration) % apart == 0 and (end - iteration) // apart < AVERAGED

    def leaves_out(self, iteration: int) -> bool:
        """Whether frames are left out at an iteration: a decision that needs them is still to come."""
        decides = self.worth_db is not None and len(self._planned_ends) > 2  # two scores, and a cycle to be spared
        return decides and iteration <= self.ends[-2]

    def judges(self, iteration: int) -> bool:
        """Whether the frames left out are scored after an iteration, which with_score then takes."""
        return self.leaves_out(iteration) and iteration == self._planned_ends[len(self.scores)]

    def with_score(self, psnr_db: float) -> Schedule:
        """The schedule after a cycle's end at which the frames left out scored so much."""
        return replace(self, scores=(*self.scores, psnr_db))

    @property
    def settings(self) -> dict[str, Any]:
        """Its fields as JSON holds them; a score that is no number is null."""
        return asdict(self) | {"scores": [None if math.isnan(score) else score for score in self.scores]}

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Schedule:
        """The schedule with these settings. With all scores of a run it is that run's: the same steps, none judged."""
        scores = tuple(math.nan if score is None else float(score) for score in settings["scores"])
        return cls(**{**settings, "scores": scores})

    @property
    def words(self) -> tuple[str, ...]:
        """What was decided, for the report."""
        if self.stopped_at is None:
            return ()
        return (
            f"Training ended after {self.iterations} of {self.planned} iterations that the time allowed: doubling the "
            f"first {self.stopped_at // 2} was worth {self.scores[-1] - self.scores[-2]:.2f} dB on training frames "
            f"left out until then, less than {self.worth_db} dB.",
        )


def left_out(frames: Sequence[int]) -> tuple[int, ...]:
    """Of the training frames those that judge a run: every JUDGE_EVERY-th, never the first or the last."""
    return tuple(frames[JUDGE_EVERY // 2 : -1 : JUDGE_EVERY]) if len(frames) >= FEWEST_FRAMES_TO_JUDGE else ()
