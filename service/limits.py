"""How often somebody may ask: a token bucket for each key, or for each address where no key is asked for.

A bucket holds `burst` tokens and gains `rate_per_s` of them; a request takes one. Each process counts for itself.
Buckets are used from the event loop alone, so they need no lock.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from dataclasses import dataclass

from service.problems import Problem

BUCKETS_KEPT = 10_000
"""The least recently used go first, so that many addresses cost no more memory than this; about 2 MB."""

BURST_S = 1.0
"""So long a pause saves up as many requests as may then come at once."""


@dataclass
class _Bucket:
    tokens: float
    at_s: float


class Limiter:
    """Buckets by name."""

    def __init__(self, rate_per_s: float, burst: float | None = None) -> None:
        self._rate_per_s = rate_per_s
        self._burst = max(1.0, rate_per_s * BURST_S if burst is None else burst)
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def take(self, name: str, now_s: float | None = None) -> float:
        """Take a token: 0 if there was one, else the seconds until there is. now_s: monotonic, given by tests."""
        now_s = time.monotonic() if now_s is None else now_s
        bucket = self._buckets.get(name)
        if bucket is None:
            bucket = self._buckets[name] = _Bucket(self._burst, now_s)
            if len(self._buckets) > BUCKETS_KEPT:
                self._buckets.popitem(last=False)
        self._buckets.move_to_end(name)
        bucket.tokens = min(self._burst, bucket.tokens + (now_s - bucket.at_s) * self._rate_per_s)
        bucket.at_s = now_s
        if bucket.tokens < 1.0:
            return (1.0 - bucket.tokens) / self._rate_per_s
        bucket.tokens -= 1.0
        return 0.0

    def admit(self, name: str) -> None:
        """Take a token, or raise Problem 429 that says when there will be one."""
        wait_s = self.take(name)
        if wait_s > 0.0:
            raise self._too_often(wait_s)

    def _too_often(self, wait_s: float) -> Problem:
        seconds = max(1, math.ceil(wait_s))
        headers = {
            # draft-ietf-httpapi-ratelimit-headers: quota and window of the policy; what remains and until when
            "RateLimit-Policy": f'"requests";q={math.floor(self._burst)};w={math.ceil(self._burst / self._rate_per_s)}',
            "RateLimit": f'"requests";r=0;t={seconds}',
        }
        detail = f"More than {self._rate_per_s:g} requests a second came from here."
        return Problem(429, detail, remedy=f"Wait {seconds} s.", headers=headers, retry_after_s=wait_s)
