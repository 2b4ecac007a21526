"""Authentication: finds the caller of a request by its API key.

A key is required unless the service is bound to loopback and answers to no other name. There, a request without a key
belongs to this machine's user, tenant "local", with every scope. A request that a proxy has forwarded always needs a
key, whatever its address. A wrong key is refused everywhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from contract.access.keys import ApiKey, KeyFile, KeyScope, needs_keys
from contract.runtime.settings import Settings
from contract.wire.feeds import FeedRecord
from contract.wire.job import LOCAL_TENANT, JobRecord
from intrasplat.errors import ErrorCode
from service.limits import Limiter
from service.problems import Problem

ALL_SCOPES = frozenset(KeyScope)
CHALLENGE = {"WWW-Authenticate": 'Bearer realm="intrasplat"'}
KEY_REMEDY = "Send `Authorization: Bearer KEY`; whoever runs the service makes keys with `intrasplat keys create`."
EXPIRED_REMEDY = "Ask whoever runs the service for a new one: `intrasplat keys rotate`, or `create`."
WRONG_KEYS_PER_S = 0.2
WRONG_KEYS_AT_ONCE = 10.0
"""Wrong keys accepted from one address in a burst. Keys cannot be guessed; this limits what attempts write to logs and
audit log."""

MAX_STRANGERS = 64
"""Maximum viewers at a time that have not sent their key yet."""

FORWARDED_HEADERS = frozenset(
    {"forwarded", "via", "x-real-ip", "x-client-ip", "true-client-ip", "cf-connecting-ip", "cdn-loop"}
)
FORWARDED_PREFIX = "x-forwarded"
"""The prefix of X-Forwarded-For, -Host, -Proto and other headers of proxies."""


@dataclass(frozen=True)
class Caller:
    """The tenant of a request and what it may do. key_id is None for this machine's user."""

    tenant: str
    scopes: frozenset[KeyScope]
    key_id: str | None
    address: str
    expires_at_s: float | None = None

    def require(self, scope: KeyScope) -> None:
        """Return if the caller has the scope. Raises Problem 403, which names it, otherwise."""
        if scope not in self.scopes:
            remedy = f"Use a key that has it: `intrasplat keys create --scopes {scope}`."
            detail = f"This key lacks the scope {scope.value!r}."
            raise AccessRefusal(403, detail, remedy, address=self.address, caller=self)

    def owns(self, record: JobRecord | FeedRecord) -> bool:
        """Whether the job or feed belongs to the caller's tenant. If not, it is answered as missing."""
        return record.tenant == self.tenant


class AccessRefusal(Problem):
    """A caller requested what it may not have. The audit log records it when it leaves a route (service/audit.py)."""

    def __init__(
        self,
        status: int,
        detail: str,
        remedy: str,
        *,
        field: str = "Authorization",
        address: str,
        caller: Caller | None = None,
        job_id: str | None = None,
        code: ErrorCode | None = None,
    ) -> None:
        headers, extensions = CHALLENGE if status == 401 else None, {"code": code.value} if code else None
        super().__init__(status, detail, field=field, remedy=remedy, headers=headers, extensions=extensions)
        self.address = address
        self.caller = caller
        self.job_id = job_id


class Access:
    """The rules at the head of this file, for one service."""

    def __init__(self, settings: Settings) -> None:
        self._keys = KeyFile(settings.data_dir)
        self._wrong_keys = Limiter(WRONG_KEYS_PER_S, WRONG_KEYS_AT_ONCE)
        self._strangers = 0
        self.keys_required = needs_keys(settings)

    def caller(self, headers: Mapping[str, str], address: str) -> Caller | None:
        """The caller of a request with these headers (names in lower case); None if it needs a key and has none.

        Raises:
            Problem: 401: the key is wrong, or has expired. 429: too many wrong keys came from this address. Valid keys
                still pass, so that nobody behind a common proxy can lock out the others.
            UnavailableError: the file of keys is damaged.
        """
        text = _key_text(headers)
        if text is not None:
            return self.caller_of_key(text, address)
        if self.keys_required or _is_forwarded(headers):
            return None
        return Caller(LOCAL_TENANT, ALL_SCOPES, None, address)

    def caller_of_key(self, text: str, address: str) -> Caller:
        """The caller with this key; raises as caller()."""
        key: ApiKey | None = self._keys.find(text)
        if key is None:
            self._wrong_keys.admit(address)
            raise AccessRefusal(401, "This key is not known.", KEY_REMEDY, address=address)
        caller = Caller(key.tenant, key.scopes, key.key_id, address, key.expires_at_s)
        if key.has_expired(time.time()):
            detail, code = "This key has expired.", ErrorCode.KEY_EXPIRED
            raise AccessRefusal(401, detail, EXPIRED_REMEDY, address=address, caller=caller, code=code)
        return caller

    @contextmanager
    def stranger(self) -> Iterator[None]:
        """Count a connection without a key during the context. Raises Problem 503 if there are too many."""
        if self._strangers >= MAX_STRANGERS:
            detail = f"{MAX_STRANGERS} connections have not sent their keys yet, the most at once."
            raise Problem(503, detail, remedy="Send the key as a header, or connect again in some seconds.")
        self._strangers += 1
        try:
            yield
        finally:
            self._strangers -= 1


def key_missing(address: str) -> AccessRefusal:
    """The answer to a request that needs a key and has none."""
    return AccessRefusal(401, "A key is needed.", KEY_REMEDY, address=address)


def _is_forwarded(headers: Mapping[str, str]) -> bool:
    return any(name in FORWARDED_HEADERS or name.startswith(FORWARDED_PREFIX) for name in headers)


def _key_text(headers: Mapping[str, str]) -> str | None:
    """The text sent as a key, in either header. An Authorization header of another kind counts as a wrong key."""
    authorization = headers.get("authorization")
    if authorization is None:
        return headers.get("x-api-key")
    kind, _, text = authorization.partition(" ")
    return text.strip() if kind.lower() == "bearer" else ""
