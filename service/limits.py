"""Rate limits: a token bucket for each key, or for each address where no key is needed.

A bucket has at most `burst` tokens and gains `rate_per_s` per second; a request takes one. Each process counts for
itself. Only the event loop uses buckets, so they need no lock.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from dataclasses import dataclass

from service.problems import Problem

MAX_BUCKETS = 10_000
"""Maximum number of buckets, about 2 MB. The least recently used one is removed first."""

BURST_S = 1.0
"""The size of a bucket, as seconds at its rate."""


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
        """Take a token. Returns 0 if there was one, else the seconds until the next. now_s: monotonic, for tests."""
        now_s = time.monotonic() if now_s is None else now_s
        bucket = self._buckets.get(name)
        if bucket is None:
            bucket = self._buckets[name] = _Bucket(self._burst, now_s)
            if len(self._buckets) > MAX_BUCKETS:
                self._buckets.popitem(last=False)
        self._buckets.move_to_end(name)
        bucket.tokens = min(self._burst, bucket.tokens + (now_s - bucket.at_s) * self._rate_per_s)
        bucket.at_s = now_s
        if bucket.tokens < 1.0:
            return (1.0 - bucket.tokens) / self._rate_per_s
        bucket.tokens -= 1.0
        return 0.0

    def admit(self, name: str) -> None:
        """Take a token, or raise Problem 429 with the time of the next one."""
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
