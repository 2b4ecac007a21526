"""Who is let in before any route is asked: hosts, origins, and how often."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import HTTPConnection

from contract.access.keys import KeyFile
from contract.runtime.settings import LOOPBACK_NAMES, Settings
from service.access import WRONG_KEYS_AT_ONCE, Access
from service.deps import address_of
from service.guard import Guard
from service.limits import MAX_BUCKETS, Limiter
from service.problems import Problem

WEBSOCKET: dict[str, Any] = {"type": "websocket", "path": "/stream", "extensions": {"websocket.http.response": {}}}
HTTP: dict[str, Any] = {"type": "http", "path": "/jobs", "method": "GET"}


async def inner(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
    else:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})


def answer(scope: Mapping[str, Any], headers: Mapping[str, str], **options: Any) -> tuple[str, int | None, Any]:
    """Kind, status and headers of what comes back first."""
    sent: list[Any] = []
    raw = [(name.encode(), value.encode()) for name, value in headers.items()]

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        return {"type": "http.request", "body": b"", "more_body": False}

    asyncio.run(Guard(inner, **options)({**scope, "headers": raw}, receive, send))
    given = {name.decode(): value.decode() for name, value in sent[0].get("headers", [])}
    return sent[0]["type"], sent[0].get("status"), given


@pytest.mark.parametrize("scope", [HTTP, WEBSOCKET], ids=["http", "websocket"])
@pytest.mark.parametrize(
    "headers",
    [
        {"host": "evil.example"},
        {"host": ""},
        {},
        {"host": "127.0.0.1:8765", "origin": "https://evil.example"},
        {"host": "127.0.0.1:8765", "origin": "http://127.0.0.1:3000"},
        {"host": "127.0.0.1:8765", "origin": "null"},
    ],
)
def test_a_foreign_name_or_page_reaches_neither_a_route_nor_a_websocket(
    scope: dict[str, Any], headers: dict[str, str]
) -> None:
    kind, status, _ = answer(scope, headers)
    assert (kind.endswith("http.response.start"), status) == (True, 403)


def test_a_body_whose_length_is_told_in_two_ways_is_refused_with_its_connection() -> None:
    """A proxy may believe one, we the other: what follows the shorter body would be a request of somebody else's."""
    _, status, headers = answer(HTTP, {"host": "127.0.0.1", "transfer-encoding": "chunked", "content-length": "5"})
    assert (status, headers["connection"]) == (400, "close")


@pytest.mark.parametrize(
    ("told", "address"),
    [
        (("10.0.0.7", 0), "10.0.0.7"),
        (("2001:db8::7", 0), "2001:db8::7"),
        (("fe80::7%Smith", 0), "fe80::7"),
        (("Smith, ward 3", 0), "unknown"),
        (None, "unix"),
    ],
)
def test_what_a_proxy_tells_as_an_address_is_one_or_is_forgotten(told: tuple[str, int] | None, address: str) -> None:
    assert address_of(HTTPConnection({**HTTP, "client": told})) == address


def test_the_page_itself_may_open_a_websocket() -> None:
    headers = {"host": "127.0.0.1:8765", "origin": "http://127.0.0.1:8765"}
    assert answer(WEBSOCKET, headers)[0] == "websocket.accept"


def test_names_and_pages_that_were_admitted_come_in_and_others_do_not() -> None:
    admitted = {"hosts": LOOPBACK_NAMES | {"Splat.Hospital"}, "origins": ("https://viewer.hospital",)}
    there = {"host": "splat.hospital"}
    assert answer(HTTP, there, **admitted)[1] == 200
    _, status, headers = answer(HTTP, {**there, "origin": "https://viewer.hospital"}, **admitted)
    assert (status, headers["access-control-allow-origin"]) == (200, "https://viewer.hospital")
    assert "access-control-allow-credentials" not in headers
    assert answer(HTTP, {**there, "origin": "https://evil.example"}, **admitted)[1] == 403
    preflight = {**there, "origin": "https://viewer.hospital", "access-control-request-method": "DELETE"}
    assert answer({**HTTP, "method": "OPTIONS"}, preflight, **admitted)[1] == 200


def test_a_bucket_lets_the_burst_through_and_then_the_rate() -> None:
    limiter = Limiter(rate_per_s=2.0, burst=3.0)
    assert [limiter.take("a", 0.0) for _ in range(4)] == [0.0, 0.0, 0.0, 0.5]
    assert limiter.take("b", 0.0) == 0.0
    assert (limiter.take("a", 0.5), limiter.take("a", 0.5)) == (0.0, 0.5)
    assert [limiter.take("a", 100.0) for _ in range(4)] == [0.0, 0.0, 0.0, 0.5]


def test_buckets_of_many_addresses_take_bounded_memory() -> None:
    limiter = Limiter(rate_per_s=1.0)
    for number in range(MAX_BUCKETS + 100):
        limiter.take(str(number), 0.0)
    assert len(limiter._buckets) == MAX_BUCKETS
    assert limiter.take(str(MAX_BUCKETS + 99), 0.0) > 0.0


def test_too_many_requests_are_told_when_to_come_back() -> None:
    limiter = Limiter(rate_per_s=0.25)
    limiter.admit("a")
    with pytest.raises(Problem) as caught:
        limiter.admit("a")
    assert caught.value.status == 429
    assert caught.value.headers["Retry-After"] == "4"
    assert caught.value.headers["RateLimit"] == '"requests";r=0;t=4'


@pytest.mark.parametrize(
    ("changes", "headers", "let_in"),
    [
        ({}, {}, True),
        ({"host": "localhost"}, {}, True),
        ({"host": "0.0.0.0"}, {}, False),
        ({"host": "192.168.1.5"}, {}, False),
        ({"hosts": ("splat.hospital",)}, {}, False),
        ({}, {"x-forwarded-for": "10.0.0.7"}, False),
        ({}, {"forwarded": "for=10.0.0.7"}, False),
        ({}, {"x-forwarded-proto": "https"}, False),
        ({}, {"cf-connecting-ip": "10.0.0.7"}, False),
    ],
)
def test_only_this_machines_user_needs_no_key(
    tmp_path: Path, changes: dict[str, Any], headers: dict[str, str], let_in: bool
) -> None:
    access = Access(Settings(data_dir=tmp_path, **changes))
    assert (access.caller(headers, "127.0.0.1") is not None) is let_in


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize(
    "headers",
    [
        {"authorization": "Bearer isp_000000000000_00"},
        {"authorization": "Bearer "},
        {"authorization": "Basic dXNlcjpwYXNz"},
        {"authorization": ""},
        {"x-api-key": "x"},
        {"x-api-key": ""},
    ],
)
def test_a_wrong_key_is_refused_even_where_none_is_needed(tmp_path: Path, host: str, headers: dict[str, str]) -> None:
    with pytest.raises(Problem) as caught:
        Access(Settings(data_dir=tmp_path, host=host)).caller(headers, "127.0.0.1")
    assert caught.value.status == 401
    assert caught.value.headers["WWW-Authenticate"].startswith("Bearer")


def test_whoever_tries_keys_is_slowed_and_a_right_key_passes_all_the_same(tmp_path: Path) -> None:
    _, text = KeyFile(tmp_path).create("ward-3")
    access = Access(Settings(data_dir=tmp_path, host="0.0.0.0"))
    statuses = []
    for _ in range(int(WRONG_KEYS_AT_ONCE) + 1):
        with pytest.raises(Problem) as caught:
            access.caller_of_key("isp_000000000000_00", "10.0.0.7")
        statuses.append(caught.value.status)
    assert statuses == [401] * int(WRONG_KEYS_AT_ONCE) + [429]
    assert access.caller_of_key(text, "10.0.0.7").tenant == "ward-3"
    with pytest.raises(Problem) as caught:
        access.caller_of_key("isp_000000000000_00", "10.0.0.8")
    assert caught.value.status == 401
