"""Parses Retry-After (RFC 9110) of webhook receivers, in seconds or as a date."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

import httpx

ASKS_TO_WAIT = frozenset({httpx.codes.TOO_MANY_REQUESTS, httpx.codes.SERVICE_UNAVAILABLE})


def asked_wait_s(answer: httpx.Response, most_s: float) -> float | None:
    """The wait that an answer requests, at most most_s; None without a readable Retry-After."""
    text = answer.headers.get("retry-after", "")
    if answer.status_code not in ASKS_TO_WAIT:
        return None
    if re.fullmatch(r"\d+", text, re.ASCII):
        return min(float(text), most_s)
    try:
        at = parsedate_to_datetime(text)
    except (ValueError, OverflowError):
        return None
    at = at if at.tzinfo else at.replace(tzinfo=UTC)  # HTTP dates are UTC, even without a zone
    return max(0.0, min((at - datetime.now(UTC)).total_seconds(), most_s))
