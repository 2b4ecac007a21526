"""Asks Sentinels which server is the primary, and distinguishes a refusal from Sentinels that cannot be reached."""

from __future__ import annotations

from typing import Any

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry
from redis.sentinel import MasterNotFoundError, Sentinel

from contract.runtime.queue_url import QueueUrl


class SentinelsRefuseError(redis.RedisError):
    """No Sentinel names the primary, and at least one refuses this user or password."""


class Sentinels(Sentinel):
    """redis-py's Sentinel, which treats a refusal as an unreachable Sentinel; this class does not."""

    def discover_master(self, service_name: str) -> tuple[str, int]:
        """Host and port of the primary, from the first Sentinel that knows a live one.

        Raises:
            SentinelsRefuseError: none answers, and at least one refuses this user or password.
            MasterNotFoundError: none knows one.
        """
        untyped: Any = self
        asked = untyped.sentinels
        refusal: redis.RedisError | None = None
        is_answered = False
        for place, sentinel in enumerate(asked):
            try:
                known = sentinel.sentinel_masters().get(service_name)
            except (redis.AuthenticationError, redis.exceptions.NoPermissionError) as error:
                refusal = error
                continue
            except (redis.ConnectionError, redis.TimeoutError):
                continue
            is_answered = True
            if known and untyped.check_master_state(known, service_name):
                asked[0], asked[place] = sentinel, asked[0]  # asked first from now on
                return known["ip"], known["port"]
        if refusal is not None and not is_answered:
            raise SentinelsRefuseError from refusal
        raise MasterNotFoundError


def primary_of(where: QueueUrl, options: dict[str, Any]) -> Any:
    """A client of the primary. Sentinels use the URL's TLS settings, `sentinel_username` and `sentinel_password`."""
    untyped: Any = redis
    url_options = untyped.connection.parse_url(where.url)
    for name in ("host", "port"):
        url_options.pop(name, None)
    if url_options.pop("connection_class", None) is redis.SSLConnection:
        url_options["ssl"] = True
    given = options | url_options
    asking = {name: value for name, value in given.items() if name.startswith(("ssl", "socket_"))}
    asking |= {"retry": Retry(NoBackoff(), 0), "protocol": options["protocol"]}  # the next Sentinel is asked instead
    for name in ("username", "password"):
        if (value := given.pop(f"sentinel_{name}", None)) is not None:
            asking[name] = value
    made: Any = Sentinels
    return made(where.sentinels, sentinel_kwargs=asking, **given).master_for(where.primary)
