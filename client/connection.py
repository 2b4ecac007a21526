"""What the clients tell a connection: where, who asks, how long to wait; and what its failures mean."""

from __future__ import annotations

from typing import Any

import httpx

from client.errors import UNAVAILABLE_REMEDY, Unreachable
from client.steps import Call
from contract.wire.errors import InputError

DEFAULT_URL = "http://127.0.0.1:8765"

CONNECT_TIMEOUT_S = 5.0
ANSWER_TIMEOUT_S = 60.0
"""An upload may take as long as it takes; only silence is a failure."""
HEARTBEAT_TIMEOUT_S = 45.0
"""Three of the heartbeats that a stream of events brings while nothing happens."""

LISTENING = httpx.Timeout(HEARTBEAT_TIMEOUT_S, connect=CONNECT_TIMEOUT_S)

NOBODY_THERE = (httpx.ConnectError, httpx.ConnectTimeout, httpx.UnsupportedProtocol, httpx.ProxyError)


def settings_of(url: str, api_key: str | None) -> dict[str, Any]:
    """Arguments of httpx.Client and httpx.AsyncClient.

    Raises:
        InputError: the url is none.
    """
    try:
        base_url = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise InputError("url", f"{url[:80]!r} is no address ({error}).", UNAVAILABLE_REMEDY) from error
    return {
        "base_url": base_url,
        "timeout": httpx.Timeout(ANSWER_TIMEOUT_S, connect=CONNECT_TIMEOUT_S),
        "headers": authorization(api_key),
    }


def authorization(api_key: str | None) -> dict[str, str]:
    """The header that says who asks; a key out of a file may end with a line break."""
    return {} if api_key is None else {"Authorization": f"Bearer {api_key.strip()}"}


def arguments_of(call: Call) -> dict[str, Any]:
    """Arguments of their request() and stream()."""
    length = {} if call.body is None else {"Content-Length": str(call.body.length_bytes)}
    headers = {**call.headers, **length}
    return {"method": call.method, "url": call.path, "params": call.query, "headers": headers, "json": call.json}


def unreachable(url: str, error: Exception) -> Unreachable:
    """What a failure of the connection means."""
    return Unreachable(url, error, isinstance(error, NOBODY_THERE))
