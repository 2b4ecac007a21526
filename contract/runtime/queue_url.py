"""REDIS_URL: the queue's server, or the Sentinels that know which server it is."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

from intrasplat.errors import InputError

VARIABLE = "REDIS_URL"
SCHEMES = ("redis", "rediss", "unix")
SENTINEL = "+sentinel"
SENTINEL_PORT = 26379
SENTINEL_REMEDY = "Write redis+sentinel://USER:PASSWORD@HOST:26379,HOST:26379/NAME, NAME as in `sentinel monitor`."


@dataclass(frozen=True)
class QueueUrl:
    """Where the queue is.

    url         of the server, or of the first Sentinel; with user, password and options
    sentinels   host and port of each Sentinel; empty: the URL names the server itself
    primary     the name under which the Sentinels know the server
    """

    url: str
    sentinels: tuple[tuple[str, int], ...] = ()
    primary: str = ""


def parse_queue_url(url: str) -> QueueUrl:
    """Parse REDIS_URL. No error message repeats it, because it may contain a password.

    Raises:
        InputError: the queue does not support this kind of URL.
    """
    scheme, _, rest = url.partition("://")
    plain = scheme.removesuffix(SENTINEL)
    if plain not in SCHEMES or scheme == f"unix{SENTINEL}":
        known = ", ".join([*SCHEMES, *(f"{each}{SENTINEL}" for each in SCHEMES[:2])])
        remedy = "All keys lie in one slot of a cluster: use one server, or several behind Sentinels."
        raise InputError(VARIABLE, f"its scheme is none of {known}.", remedy)
    if scheme == plain:
        return QueueUrl(url)
    parts = _split(rest)
    user, at, hosts = parts.netloc.rpartition("@")
    primary = parts.path.strip("/")
    if not primary or "/" in primary:
        raise InputError(VARIABLE, "its path is not the name of one primary server.", SENTINEL_REMEDY)
    sentinels = tuple(_address(each) for each in hosts.split(","))
    query = f"?{parts.query}" if parts.query else ""
    return QueueUrl(f"{plain}://{user}{at}{hosts.split(',')[0]}{query}", sentinels, primary)


def _address(text: str) -> tuple[str, int]:
    parts = _split(text)
    with suppress(ValueError):
        if parts.hostname:
            return parts.hostname, parts.port or SENTINEL_PORT
    raise InputError(VARIABLE, "one of its Sentinels has no host, or no number as port.", SENTINEL_REMEDY)


def _split(rest: str) -> SplitResult:
    try:
        return urlsplit(f"//{rest}")
    except ValueError as error:
        raise InputError(VARIABLE, "it cannot be read.", SENTINEL_REMEDY) from error
