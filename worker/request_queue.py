"""The queue of requests at a worker: small ones come first, and none waits for ever."""

from __future__ import annotations

import math
from dataclasses import dataclass

from contract.wire.rendering import SceneRequest

PATIENCE = 4.0
"""A request may wait PATIENCE times the seconds that it takes; then it comes before later requests."""

FIRST_SPEEDS = (3e11, 1e12, 2e12)
"""First guesses of the speed at each level of detail (intrasplat/view/coarse.py), in pixels x Gaussians of the whole
picture per CPU second, until a render has been timed (bm_service, on two cores)."""
COARSEST = len(FIRST_SPEEDS) - 1
"""The coarsest level of detail."""
LEARNING = 0.2
"""Weight of the newest render in the moving average of the speed."""


@dataclass(eq=False)
class WaitingRequest:
    """A request that waits or is being answered.

    cost       pixels x Gaussians
    seconds    predicted CPU seconds of the whole answer
    spent_s    CPU seconds that it has taken so far
    least_s    predicted CPU seconds at the coarsest level of detail that the caller accepts
    level      level of detail at which it is answered
    trace      traceparent of the caller; None: it has none
    arrived_s  arrival on the monotonic clock
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
        """The key by which requests are ordered."""
        return self.arrived_s + PATIENCE * self.seconds


class RequestQueue:
    """All waiting requests, and how fast they are answered; for use in one thread."""

    def __init__(self) -> None:
        self._waiting: list[WaitingRequest] = []
        self._speeds = list(FIRST_SPEEDS)

    def __len__(self) -> int:
        return len(self._waiting)

    def seconds(self, cost: float, level: int = 0) -> float:
        """Predicted CPU seconds of a request of this cost at a level of detail."""
        return cost / self._speeds[level]

    def learn(self, waiting: WaitingRequest) -> None:
        """Update the speed with the time that the answer took."""
        if waiting.cost > 0 and waiting.spent_s > 0:
            self._speeds[waiting.level] += LEARNING * (waiting.cost / waiting.spent_s - self._speeds[waiting.level])

    def add(self, waiting: WaitingRequest) -> None:
        """Add a request."""
        self._waiting.append(waiting)

    def give_up(self, caller: bytes, request_id: bytes) -> None:
        """Remove a request that its caller gave up."""
        self._waiting = [each for each in self._waiting if (each.caller, each.request_id) != (caller, request_id)]

    def take(self, below_s: float = math.inf) -> WaitingRequest | None:
        """Remove and return the next request to answer, of those that take less than below_s."""
        waiting = min(
            (each for each in self._waiting if each.seconds < below_s), key=lambda each: each.due_s, default=None
        )
        if waiting is not None:
            self._waiting.remove(waiting)
        return waiting

    def take_same(self, request: SceneRequest) -> list[WaitingRequest]:
        """Remove and return all requests that wait for the same answer."""
        same = [each for each in self._waiting if each.request == request]
        self._waiting = [each for each in self._waiting if each.request != request]
        return same

    def others(self, request: SceneRequest) -> int:
        """The number of other answers that are waited for."""
        return len({each.request for each in self._waiting} - {request})

    def seconds_before(self, waiting: WaitingRequest) -> float:
        """Least CPU seconds of all requests answered before this one; 0 if one of them has the same answer."""
        before = [each for each in self._waiting if each.due_s <= waiting.due_s]
        return 0.0 if any(each.request == waiting.request for each in before) else sum(each.least_s for each in before)
