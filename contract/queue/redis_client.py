"""The connection to the queue's server, and its errors with what to do about them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import redis
from redis.backoff import ExponentialBackoff, NoBackoff
from redis.retry import Retry

from contract.runtime.queue_url import VARIABLE, QueueUrl, parse_queue_url
from contract.wire.errors import InputError, UnavailableError

PATIENCE_S = 12.0
"""How long to try, in all, until the server counts as away."""
QUEUE_REMEDY = "See whether its server runs, reachable at REDIS_URL; without REDIS_URL, `intrasplat up` starts it."
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
    """A client of that server, or of the one that its Sentinels name whenever a connection is made.

    It states every default that has changed between releases of redis-py.

    Raises:
        InputError: the URL is of no kind that the queue can be on.
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
        client: Any = _by_sentinels(where, options) if where.sentinels else redis.Redis.from_url(where.url, **options)
        pool = client.connection_pool
        pool.connection_class(**pool.connection_kwargs)  # connects to nothing, and refuses unknown options
    except (ValueError, TypeError) as error:  # its text may quote a part of the password
        remedy = "Write / : @ # % in a password as %2F %3A %40 %23 %25, and check the options after the `?`."
        raise InputError(VARIABLE, "it cannot be read.", remedy) from error
    return client


def _by_sentinels(where: QueueUrl, options: dict[str, Any]) -> Any:
    """A client of the primary. Sentinels share the URL's TLS; `sentinel_username`, `sentinel_password` are for them."""
    untyped: Any = redis
    told = untyped.connection.parse_url(where.url)
    for name in ("host", "port"):
        told.pop(name, None)
    if told.pop("connection_class", None) is redis.SSLConnection:
        told["ssl"] = True
    given = options | told
    asking = {name: value for name, value in given.items() if name.startswith(("ssl", "socket_"))}
    asking |= {"retry": Retry(NoBackoff(), 0), "protocol": options["protocol"]}  # the next Sentinel is asked instead
    for name in ("username", "password"):
        if (value := given.pop(f"sentinel_{name}", None)) is not None:
            asking[name] = value
    return untyped.sentinel.Sentinel(where.sentinels, sentinel_kwargs=asking, **given).master_for(where.primary)


@contextmanager
def reachable() -> Iterator[None]:
    """Raise errors of the connection or the server as UnavailableError with the remedy."""
    try:
        yield
    except redis.exceptions.AuthenticationError as error:
        raise UnavailableError("The queue refuses this user or password.", "Correct REDIS_URL.") from error
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
