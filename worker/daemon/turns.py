"""The requests that wait at a worker, and whose turn it is: small ones come first, and none waits for ever."""

from __future__ import annotations

import math
from dataclasses import dataclass

from contract.wire.rendering import SceneRequest

PATIENCE = 4.0
"""A request may wait so many times the seconds that it takes, before those that came later are answered first."""

FIRST_SPEEDS = (3e11, 1e12, 2e12)
"""Pixels x Gaussians of the whole picture, rendered in a CPU second at each level of detail (worker/render/detail.py),
until the first render has been timed (bm_service, on two cores)."""
COARSEST = len(FIRST_SPEEDS) - 1
"""Level of detail."""
LEARNING = 0.2
"""Share of the newest render in what is known of the speed."""


@dataclass(eq=False)
class Turn:
    """A request that waits or is being answered.

    cost       pixels x Gaussians
    seconds    CPU seconds that all of it will take, as far as known; spent_s: that it has taken
    least_s    the same at the coarsest level of detail that the caller accepts
    level      of detail at which it is answered
    trace      traceparent of the asker; None: it has none
    arrived_s  monotonic
    """

    caller: bytes
    request_id: bytes
    request: SceneRequest
    cost: float
    seconds: float
    least_s: float
    arrived_s: float
    spent_s: float = 0.0
    level: int = 0
    trace: str | None = None

    @property
    def due_s(self) -> float:
        """The order of the answers."""
        return self.arrived_s + PATIENCE * self.seconds


class Turns:
    """All that wait, and how fast they are answered; for one thread."""

    def __init__(self) -> None:
        self._waiting: list[Turn] = []
        self._speeds = list(FIRST_SPEEDS)

    def __len__(self) -> int:
        return len(self._waiting)

    def seconds(self, cost: float, level: int = 0) -> float:
        """CPU seconds that a request of this cost takes at a level of detail."""
        return cost / self._speeds[level]

    def learn(self, turn: Turn) -> None:
        """Remember how long the answer took."""
        if turn.cost > 0 and turn.spent_s > 0:
            self._speeds[turn.level] += LEARNING * (turn.cost / turn.spent_s - self._speeds[turn.level])

    def add(self, turn: Turn) -> None:
        """Let it wait."""
        self._waiting.append(turn)

    def give_up(self, caller: bytes, request_id: bytes) -> None:
        """Forget a request that nobody waits for any more."""
        self._waiting = [each for each in self._waiting if (each.caller, each.request_id) != (caller, request_id)]

    def take(self, below_s: float = math.inf) -> Turn | None:
        """The next one to answer, of those that take less than below_s."""
        turn = min(
            (each for each in self._waiting if each.seconds < below_s), key=lambda each: each.due_s, default=None
        )
        if turn is not None:
            self._waiting.remove(turn)
        return turn

    def take_same(self, request: SceneRequest) -> list[Turn]:
        """All who wait for the same answer."""
        same = [each for each in self._waiting if each.request == request]
        self._waiting = [each for each in self._waiting if each.request != request]
        return same

    def others(self, request: SceneRequest) -> int:
        """How many other answers somebody waits for."""
        return len({each.request for each in self._waiting} - {request})

    def seconds_before(self, turn: Turn) -> float:
        """CPU seconds, at least, of all that are answered before this one; 0 if one of them has the same answer."""
        before = [each for each in self._waiting if each.due_s <= turn.due_s]
        return 0.0 if any(each.request == turn.request for each in before) else sum(each.least_s for each in before)
