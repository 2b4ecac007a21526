"""The connection to the queue's server, and its errors with what to do about them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import redis
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

from contract.wire.errors import UnavailableError

PATIENCE_S = 12.0
"""How long to try, in all, until the server counts as away."""
RETRIES = 2
MAX_CONNECT_TIMEOUT_S = 2.0

REFUSALS = (
    "MISCONF",
    "NOREPLICAS",
    "MASTERDOWN",
    "CLUSTERDOWN",
    "TRYAGAIN",
    "BUSY",
    "UNKILLABLE",
    "NOPERM",
    "READONLY",
)
"""Codes (the first word of an error) with which a server says that it cannot, or may not, serve now."""


def connect(url: str, patience_s: float = PATIENCE_S) -> Any:
    """A client of that server. It states every default that has changed between releases of redis-py."""
    timeout_s = patience_s / (RETRIES + 1)
    return redis.Redis.from_url(
        url,
        decode_responses=True,
        protocol=2,
        retry=Retry(ExponentialBackoff(cap=0.5, base=0.05), RETRIES),
        socket_timeout=timeout_s,
        socket_connect_timeout=min(timeout_s, MAX_CONNECT_TIMEOUT_S),
    )


@contextmanager
def reachable() -> Iterator[None]:
    """Raise errors of the connection or the server as UnavailableError with the remedy."""
    try:
        yield
    except redis.exceptions.AuthenticationError as error:
        raise UnavailableError("The queue refuses this user or password.", "Correct REDIS_URL.") from error
    except (redis.ConnectionError, redis.TimeoutError) as error:
        problem = f"The queue does not answer ({type(error).__name__})."
        remedy = "Start it with `intrasplat up`, or correct REDIS_URL."
        raise UnavailableError(problem, remedy, may_return=True) from error
    except redis.exceptions.OutOfMemoryError as error:
        raise UnavailableError("The queue's memory is full.", "Raise its maxmemory or delete old jobs.") from error
    except redis.ResponseError as error:
        code = _code_of(error)
        if code not in REFUSALS:
            raise
        remedy = "Look at the server's log. REDIS_URL must name a primary server whose disk has room."
        raise UnavailableError(f"The queue's server refuses ({code}).", remedy) from error


def _code_of(error: redis.ResponseError) -> str:
    """The server's error code; redis-py removes it from the text of the errors that have a class of their own."""
    if isinstance(error, redis.exceptions.ReadOnlyError):
        return "READONLY"
    if isinstance(error, redis.exceptions.NoPermissionError):
        return "NOPERM"
    return str(error).partition(" ")[0]
