"""Checks where webhooks may go: to hosts that the operator has listed, at addresses that the operator allows.

A caller chooses the URL, and the service connects to it from inside the hospital's network. So the URL is checked when
it is submitted and again at every attempt. The service connects to the address that it has checked, so a DNS name that
resolves to another machine a moment later has no effect.
"""

from __future__ import annotations

import asyncio
import re
import socket
import threading
from concurrent.futures import Future
from contextlib import suppress

import httpx

from contract.runtime.settings import Settings
from contract.wire.webhooks import CALLBACK_PART, MAX_CALLBACK_CHARACTERS
from intrasplat.errors import InputError
from intrasplat.intake.addresses import is_permitted

DEFAULT_PORTS = {"https": 443, "http": 80}
URL_TEXT = re.compile(r"[!-~]+", re.ASCII)
"""The characters of a URL: visible ASCII."""
URL_REMEDY = "Give a URL such as https://his.example.org/intrasplat, without a user, a password or a fragment."
HOSTS_REMEDY = "Whoever runs the service names hosts in INTRASPLAT_WEBHOOK_HOSTS."


class LookUps:
    """Resolves names in a limited number of threads, for which the end of the process does not wait."""

    def __init__(self, most: int) -> None:
        self._places = asyncio.Semaphore(most)

    async def addresses(self, host: str) -> list[str]:
        """The addresses of a host. A cancelled look-up counts against the limit until the resolver answers.

        Raises:
            OSError, UnicodeError: the name cannot be resolved.
        """
        await self._places.acquire()
        loop, answer = asyncio.get_running_loop(), Future[list[str]]()
        answer.set_running_or_notify_cancel()

        def ask() -> None:
            try:
                found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
                answer.set_result(list(dict.fromkeys(str(each[4][0]) for each in found)))
            except Exception as error:
                answer.set_exception(error)
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._places.release)

        try:
            threading.Thread(target=ask, name="look-up", daemon=True).start()
        except RuntimeError:  # the system has no more threads
            self._places.release()
            raise
        return await asyncio.wrap_future(answer)


def check_callback(url: str | None, settings: Settings) -> None:
    """Return if webhooks may go to this URL, as far as that is known without a DNS look-up.

    Raises:
        InputError: it is not a URL, or its host is not allowed.
    """
    if url is None:
        return
    if len(url) > MAX_CALLBACK_CHARACTERS:
        problem = f"it has {len(url)} characters, more than {MAX_CALLBACK_CHARACTERS}."
        raise InputError(CALLBACK_PART, problem, URL_REMEDY)
    origin = _origin(url)
    if origin is None:
        raise InputError(CALLBACK_PART, f"{url[:80]!r} is not a URL that a webhook can be sent to.", URL_REMEDY)
    if not settings.webhook_hosts:
        raise InputError(CALLBACK_PART, "this service sends no webhooks.", HOSTS_REMEDY)
    if not is_allowed(url, settings):
        raise InputError(CALLBACK_PART, f"webhooks may not go to {origin[:80]}.", HOSTS_REMEDY)


def is_allowed(url: str, settings: Settings) -> bool:
    """Whether the operator has listed the URL's scheme, host and port."""
    named = (host if "://" in host else f"https://{host}" for host in settings.webhook_hosts)
    return _origin(url) in {_origin(each) for each in named}


async def permitted_addresses(host: str, settings: Settings, look_ups: LookUps) -> list[str]:
    """The allowed addresses of a host, in the resolver's order.

    Raises:
        OSError, UnicodeError: the name cannot be resolved.
    """
    addresses = await look_ups.addresses(host)
    return [address for address in addresses if is_permitted(address, settings.webhook_private == "yes")]


def _origin(url: str) -> str | None:
    """Scheme, host and port, normalised; None if it is not a URL, or has a user or a fragment."""
    if not URL_TEXT.fullmatch(url):
        return None
    try:
        parts = httpx.URL(url)
    except httpx.InvalidURL:
        return None
    host = parts.raw_host.decode()
    if parts.scheme not in DEFAULT_PORTS or not host or parts.userinfo or parts.fragment:
        return None
    return f"{parts.scheme}://{host}:{parts.port or DEFAULT_PORTS[parts.scheme]}"
