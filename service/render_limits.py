"""Limits how much rendering a caller and a tenant may request at a time. The cost of a render is pixels x Gaussians.

Small renders are not counted: workers answer them between the parts of large ones, and service/limits.py counts
requests. Each process counts for itself.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

from contract.runtime.settings import Settings
from contract.wire.rendering import TYPICAL_GAUSSIANS, TYPICAL_SIZE, RenderRequest, WorkerReply, render_cost
from service.access import Caller
from service.problems import Problem

OF_CALLER, OF_TENANT = 2, 4
"""How many renders of a typical scene at the maximum size may wait or run at a time, per caller and per tenant."""

SMALL_SHARE = 1 / 8
"""A render is small if it costs less than this share of one at the maximum size."""

MAX_SCENES = 1_000

FIRST_SPEED = 1e11
"""Assumed cost per second until large renders have been timed."""
LEARNING = 0.3
"""Weight of the newest render in the moving average of the speed."""


class RenderLimits:
    """The cost of pending renders. Only the event loop uses it, so it needs no lock."""

    def __init__(self, settings: Settings) -> None:
        largest = render_cost(settings.max_render_pixels, TYPICAL_GAUSSIANS)
        self._most = {"caller": OF_CALLER * largest, "tenant": OF_TENANT * largest}
        self._small = SMALL_SHARE * largest
        self._in_hand: defaultdict[tuple[str, str], float] = defaultdict(float)
        self._scenes: OrderedDict[str, tuple[int, tuple[int, int]]] = OrderedDict()
        self._speed = FIRST_SPEED

    def cost(self, request: RenderRequest) -> float:
        """The cost of a render; an estimate while the size of its scene is unknown."""
        gaussians, size = self._scenes.get(request.scene_id, (TYPICAL_GAUSSIANS, TYPICAL_SIZE))
        return sum(render_cost(each, gaussians) for each in request.most_drawn(size))

    @contextmanager
    def admitted(self, caller: Caller, request: RenderRequest) -> Iterator[None]:
        """Count a render during the context. Raises Problem 429 if the caller or its tenant has too much pending.

        A caller with nothing pending is never refused.
        """
        cost = self.cost(request)
        if cost <= self._small:
            yield
            return
        names = [("caller", caller.key_id or caller.address), ("tenant", caller.tenant)]
        for name in names:
            in_hand = self._in_hand.get(name, 0.0)
            if in_hand and in_hand + cost > self._most[name[0]]:
                raise self._too_much(name[0], in_hand + cost - self._most[name[0]])
        for name in names:
            self._in_hand[name] += cost
        start_s = time.monotonic()
        try:
            yield
            self._speed += LEARNING * (cost / max(1e-3, time.monotonic() - start_s) - self._speed)
        finally:
            for name in names:
                self._in_hand[name] -= cost
                if self._in_hand[name] < 1:
                    del self._in_hand[name]

    def learn(self, scene_id: str, head: WorkerReply) -> None:
        """Store the size of a scene."""
        if head.gaussians and head.clip_size is not None:
            self._scenes[scene_id] = head.gaussians, head.clip_size
            self._scenes.move_to_end(scene_id)
            if len(self._scenes) > MAX_SCENES:
                self._scenes.popitem(last=False)

    def _too_much(self, whose: str, excess: float) -> Problem:
        wait_s = max(1.0, excess / self._speed)
        detail = f"This {whose} has asked for as many large renders as may be made at a time."
        remedy = f"Ask again in {math.ceil(wait_s)} s, or for fewer pixels."
        return Problem(429, detail, field="width", remedy=remedy, retry_after_s=wait_s)
