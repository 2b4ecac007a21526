"""The connection to the queue's server, and its errors with their remedies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import redis
from redis.backoff import ExponentialBackoff
from redis.retry import Retry
from redis.sentinel import MasterNotFoundError

from contract.queue.sentinels import SentinelsRefuseError, primary_of
from contract.runtime.queue_url import VARIABLE, parse_queue_url
from intrasplat.errors import InputError, UnavailableError

PATIENCE_S = 12.0
"""How long to retry, in total, before the server counts as unreachable."""
QUEUE_REMEDY = "See whether its server runs, reachable at REDIS_URL; without REDIS_URL, `intrasplat up` starts it."
SENTINELS_REMEDY = "See whether one runs, and monitors a server that is up by the name that stands last in REDIS_URL."
REFUSED_REMEDY = (
    "Correct sentinel_username= and sentinel_password= behind the ? of REDIS_URL; the user needs +sentinel|masters."
)
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
    "MOVED",
    "ASK",
)
"""Codes (the first word of an error) with which a server says that it cannot, or may not, serve now."""


def connect(url: str, patience_s: float = PATIENCE_S) -> Any:
    """A client of the server at `url`. With Sentinels, each new connection goes to the primary that they name.

    It states every default that has changed between releases of redis-py.

    Raises:
        InputError: the queue does not support this kind of URL.
    """
    where = parse_queue_url(url)
    timeout_s = patience_s / (RETRIES + 1)
    options = {
        "decode_responses": True,
        "protocol": 2,
        "retry": Retry(ExponentialBackoff(cap=0.5, base=0.05), RETRIES),
        "socket_timeout": timeout_s,
        "socket_connect_timeout": min(timeout_s, MAX_CONNECT_TIMEOUT_S),
    }
    try:
        client: Any = primary_of(where, options) if where.sentinels else redis.Redis.from_url(where.url, **options)
        pool = client.connection_pool
        pool.connection_class(**pool.connection_kwargs)  # raises for unknown options; opens no connection
    except (ValueError, TypeError) as error:  # its text may quote a part of the password
        remedy = "Write / : @ # % in a password as %2F %3A %40 %23 %25, and check the options after the `?`."
        raise InputError(VARIABLE, "it cannot be read.", remedy) from error
    return client


@contextmanager
def reachable() -> Iterator[None]:
    """Raise errors of the connection or of the server as UnavailableError with a remedy."""
    try:
        yield
    except redis.exceptions.AuthenticationError as error:
        remedy = "Correct the user and the password before the @ of REDIS_URL."
        raise UnavailableError("The queue refuses this user or password.", remedy) from error
    except SentinelsRefuseError as error:
        raise UnavailableError("The queue's Sentinels refuse this user or password.", REFUSED_REMEDY) from error
    except MasterNotFoundError as error:
        raise UnavailableError("No Sentinel names the queue's server.", SENTINELS_REMEDY, may_return=True) from error
    except (redis.ConnectionError, redis.TimeoutError) as error:
        problem = f"The queue does not answer ({type(error).__name__})."
        raise UnavailableError(problem, QUEUE_REMEDY, may_return=True) from error
    except redis.exceptions.OutOfMemoryError as error:
        raise UnavailableError("The queue's memory is full.", "Raise its maxmemory or delete old jobs.") from error
    except redis.ResponseError as error:
        code = _code_of(error)
        if code not in REFUSALS:
            raise
        remedy = "Look at the server's log. REDIS_URL must name a primary server, no cluster's, whose disk has room."
        raise UnavailableError(f"The queue's server refuses ({code}).", remedy) from error


def _code_of(error: redis.ResponseError) -> str:
    """The server's error code; redis-py removes it from the text of the errors that have a class of their own."""
    if isinstance(error, redis.exceptions.ReadOnlyError):
        return "READONLY"
    if isinstance(error, redis.exceptions.NoPermissionError):
        return "NOPERM"
    if isinstance(error, redis.exceptions.AskError):  # of MOVED, too
        return "MOVED"
    return str(error).partition(" ")[0]
