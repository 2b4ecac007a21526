"""Decide which answer is computed next, part by part: small ones first, and no more than the pace allows.

An answer is computed in parts (intrasplat/machine/parts.py). Between two parts the scheduler may start a request that
takes less than SMALL_SHARE of the time: the large answer waits until the small one is done. Small answers get as much
CPU time as the large one's last part took; then its next part is due. No part runs inside another.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from contextvars import Context, copy_context
from dataclasses import dataclass, field

from contract.wire.rendering import RenderRequest, SceneRequest
from intrasplat.machine.parts import Parts
from intrasplat.view.encode import FOR_EYES
from worker.pace import RenderPace
from worker.reply import Reply
from worker.request_queue import COARSEST, RequestQueue, WaitingRequest
from worker.spans import answer_span, shared_span

SMALL_SHARE = 0.25
"""An answer that takes less than this share of a larger one's time is computed between the parts of that one."""

ALL_WITHIN_S = 1.0
"""Time within which all waiting viewers should get a picture: if necessary, a coarser one."""

MIN_CHARGE_S = 0.01
"""Least CPU seconds charged for an answer while a job trains: the service and the viewer have work with it, too."""

MAX_WAIT_SHARE = 0.4
"""Share of the time after which the service gives up a render. A request that would wait longer is refused, with the
time at which to ask again."""

Answer = Callable[[SceneRequest, int], Parts[Reply]]
"""Computes the reply to a request at a level of detail (intrasplat/view/coarse.py), in parts."""


@dataclass(frozen=True)
class Answered:
    """Equal requests, and their answer.

    seconds: wall time from the first part to the last, including other work in between
    """

    requests: tuple[WaitingRequest, ...]
    outcome: Reply | Exception
    seconds: float


@dataclass(eq=False)
class _Task:
    """An answer in progress. small_s: CPU seconds that smaller answers may take before its next part."""

    waiting: WaitingRequest
    parts: Parts[Reply]
    context: Context = field(default_factory=copy_context)
    small_s: float = 0.0
    start_s: float = field(default_factory=time.perf_counter)


class Scheduler:
    """The requests of one worker, from their arrival until they are answered.

    Args:
        answer: computes a reply in parts.
        pace: limits the CPU time of answers.
        cost: cost of an answer in pixels x Gaussians.
        within: context in which each part runs.
        spent_s: CPU seconds that this thread has used.
        max_wait_s: requests that would wait longer are refused.
    """

    def __init__(
        self,
        answer: Answer,
        pace: RenderPace,
        *,
        cost: Callable[[SceneRequest], float] = lambda request: 0.0,
        within: Callable[[], AbstractContextManager[None]] = nullcontext,
        spent_s: Callable[[], float] = time.thread_time,
        max_wait_s: float = math.inf,
    ) -> None:
        self._answer = answer
        self._pace = pace
        self._cost = cost
        self._within = within
        self._spent_s = spent_s
        self._max_wait_s = max_wait_s
        self._queue = RequestQueue()
        self._tasks: list[_Task] = []  # a stack: each task waits for the next one, which is much smaller

    def take_in(
        self, caller: bytes, request_id: bytes, request: SceneRequest, trace: str | None = None
    ) -> float | None:
        """Queue a request and return None; or refuse it and return the predicted seconds that it would have to wait.

        trace: traceparent of the caller (WaitingRequest). Raises whatever `cost` raises.
        """
        cost = self._cost(request)
        seconds, least_s = self._queue.seconds(cost), self._queue.seconds(cost, self._coarsest(request))
        waiting = WaitingRequest(caller, request_id, request, cost, seconds, least_s, time.monotonic(), trace=trace)
        if (wait_s := self._wait_s(waiting)) > self._max_wait_s:
            return wait_s
        self._queue.add(waiting)
        return None

    def give_up(self, caller: bytes, request_id: bytes) -> None:
        """Remove a request that its caller gave up, or abandon its answer."""
        self._queue.give_up(caller, request_id)
        for task in [
            each for each in self._tasks if (each.waiting.caller, each.waiting.request_id) == (caller, request_id)
        ]:
            self._abandon(task)

    def close(self) -> None:
        """Abandon all answers."""
        for task in reversed(self._tasks.copy()):
            self._abandon(task)

    def rest_s(self) -> float:
        """Seconds until the next part may be computed; infinity if no request waits."""
        return self._pace.rest_s() if self._tasks or len(self._queue) else math.inf

    def advance(self) -> Answered | None:
        """Compute the next part, if the pace allows one now. Return the requests whose answer it completes."""
        if self.rest_s() > 0.0:
            return None
        if (waiting := self._next()) is not None:
            waiting.level = self._level(waiting)
            self._tasks.append(_Task(waiting, self._traced(waiting)))
        return self._make_part(self._tasks[-1])

    def _next(self) -> WaitingRequest | None:
        """The request to start now, if any; the others wait for the task on top of the stack."""
        if not self._tasks:
            return self._queue.take()
        top = self._tasks[-1]
        return self._queue.take(SMALL_SHARE * top.waiting.seconds) if top.small_s > 0.0 else None

    def _traced(self, waiting: WaitingRequest) -> Parts[Reply]:
        with answer_span(waiting):
            return (yield from self._answer(waiting.request, waiting.level))

    def _make_part(self, task: _Task) -> Answered | None:
        outcome: Reply | Exception | None = None
        start_s = self._spent_s()
        try:
            with self._within():
                task.context.run(next, task.parts)
        except StopIteration as end:
            outcome = end.value
        except Exception as error:  # one caller's request must not end the thread for all
            outcome = error
        task.small_s = self._spent_s() - start_s
        task.waiting.spent_s += task.small_s
        self._pace.charge(task.small_s)
        return None if outcome is None else self._end(task, outcome)

    def _end(self, task: _Task, outcome: Reply | Exception) -> Answered:
        self._remove(task)
        waiting = task.waiting
        if isinstance(outcome, Reply) and not outcome.is_untimed:
            self._queue.learn(waiting)
        requests = (waiting, *self._queue.take_same(waiting.request))
        self._pace.charge(max(0.0, len(requests) * MIN_CHARGE_S - waiting.spent_s))
        for each in requests[1:]:
            shared_span(each)
        return Answered(requests, outcome, time.perf_counter() - task.start_s)

    def _wait_s(self, waiting: WaitingRequest) -> float:
        """Predicted seconds until a request is answered."""
        larger = [each.waiting for each in self._tasks if waiting.seconds >= SMALL_SHARE * each.waiting.seconds]
        left_s = (max(0.0, self._queue.seconds(each.cost, each.level) - each.spent_s) for each in larger)
        before_s = self._queue.seconds_before(waiting) + sum(left_s)
        return self._pace.rest_s() + before_s / self._pace.rate

    def _abandon(self, task: _Task) -> None:
        task.context.run(task.parts.close)
        self._remove(task)

    def _remove(self, task: _Task) -> None:
        place = self._tasks.index(task)
        if place > 0:
            self._tasks[place - 1].small_s -= task.waiting.spent_s
        del self._tasks[place]

    def _coarsest(self, request: SceneRequest) -> int:
        """The coarsest level of detail that the request accepts."""
        may_be_coarse = isinstance(request, RenderRequest) and request.format in FOR_EYES
        return COARSEST if self._pace.trains and may_be_coarse else 0

    def _level(self, waiting: WaitingRequest) -> int:
        """The level of detail at which a request is answered now: as fine as time allows.

        0, the finest, if no job trains, the format is exact, or nobody else waits and the pace affords it. 1 if answers
        of this level to all waiting requests take less than ALL_WITHIN_S. 2 otherwise.
        """
        others = self._queue.others(waiting.request)
        if self._coarsest(waiting.request) == 0 or (others == 0 and self._pace.affords(waiting.seconds)):
            return 0
        all_s = (1 + others) * self._queue.seconds(waiting.cost, 1)
        return 1 if all_s <= ALL_WITHIN_S * self._pace.rate else COARSEST
