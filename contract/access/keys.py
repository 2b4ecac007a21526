"""API keys: who may do what, kept as hashes in one file that every service of an installation reads.

A key reads isp_<id>_<secret>. The id names it in lists, logs and the audit. The secret is 256 random bits, and the file
holds only its SHA-256 (no salt and no slow hash, because nobody can guess 256 bits). The file is replaced whole. Every
service reads it again when it has changed, and so refuses a revoked key at once. A key may expire.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import secrets
import time
from collections.abc import Collection, Iterable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from contract.runtime.locks import held
from contract.runtime.settings import LOOPBACK_NAMES, Settings
from contract.store.durable import replace_file
from contract.wire.errors import InputError, UnavailableError
from contract.wire.job import TENANT_PATTERN

KEYS_FILE = "keys.json"
KEY_PREFIX = "isp"
SECRET_BYTES = 32
MAX_LABEL_CHARACTERS = 60
DAY_S = 24 * 3600.0
WARN_BEFORE_S = 14 * DAY_S
"""A key that expires within this time is told to whoever runs the service."""


class KeyScope(StrEnum):
    """What a key may do."""

    RECONSTRUCT = "reconstruct"
    """Upload, cancel, retry."""
    VIEW = "view"
    """Jobs, scenes, renders, exports."""
    DOWNLOAD = "download"
    """The stored files of scenes, with which a scene is shown and kept elsewhere."""
    PURGE = "purge"
    """Delete scenes and all that belongs to them."""
    PRIORITY = "priority"
    """Jobs of high priority, which go before others' and in place of them."""
    LONG = "long"
    """Jobs that train longer than others may (Settings.long_training_s)."""
    OPERATE = "operate"
    """Read the metrics."""


DEFAULT_SCOPES = frozenset({KeyScope.RECONSTRUCT, KeyScope.VIEW})


class ApiKey(BaseModel):
    """A key without its secret."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key_id: str = Field(pattern=r"^[0-9a-f]{12}$")
    tenant: str = Field(pattern=TENANT_PATTERN)
    scopes: frozenset[KeyScope] = Field(min_length=1)
    secret_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    created_at_s: float
    label: str | None = Field(default=None, max_length=MAX_LABEL_CHARACTERS)
    expires_at_s: float | None = Field(default=None, gt=0, lt=1e11, allow_inf_nan=False)
    """From then on it is refused, UNIX time; None: never."""

    def has_expired(self, now_s: float) -> bool:
        """Whether it is refused at that UNIX time."""
        return self.expires_at_s is not None and self.expires_at_s <= now_s

    def ending(self, at_s: float) -> ApiKey:
        """The same key, which expires at that UNIX time at the latest."""
        return self.model_copy(update={"expires_at_s": min(at_s, self.expires_at_s or at_s)})


class _Stored(BaseModel):
    """The file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    keys: tuple[ApiKey, ...] = ()


class KeyFile:
    """The keys of one data directory. If the file cannot be read, no key is accepted."""

    def __init__(self, data_dir: Path) -> None:
        self._path = data_dir.expanduser() / KEYS_FILE
        self._seen: tuple[int, int, int] | None = None
        self._by_id: dict[str, ApiKey] = {}

    def create(
        self,
        tenant: str,
        scopes: Collection[KeyScope] = DEFAULT_SCOPES,
        label: str | None = None,
        expires_at_s: float | None = None,
    ) -> tuple[ApiKey, str]:
        """A new key and its text, which is kept nowhere.

        Raises:
            InputError: the tenant, the scopes or the label is not accepted.
            UnavailableError: the file is damaged, or another process keeps it locked.
        """
        secret = secrets.token_hex(SECRET_BYTES)
        try:
            key = ApiKey(
                key_id=secrets.token_hex(6),
                tenant=tenant,
                scopes=frozenset(scopes),
                secret_sha256=_sha256(secret),
                created_at_s=time.time(),
                label=label,
                expires_at_s=expires_at_s,
            )
        except ValidationError as error:
            first = error.errors()[0]
            problem = f"{str(first['input'])[:80]!r} is not accepted: {first['msg']}."
            raise InputError(str(first["loc"][0]), problem, "A tenant is 1 to 40 of a-z, 0-9 and -.") from error
        with self._changing() as keys:
            self._write((*keys, key))
        return key, f"{KEY_PREFIX}_{key.key_id}_{secret}"

    def create_successor(self, key_id: str, expires_at_s: float | None = None) -> tuple[ApiKey, str]:
        """A new key with the tenant, the scopes and the label of another, and its text; the other stays as it is.

        Args:
            expires_at_s: of the new key; None: it lasts as long as the other was made to last.

        Raises:
            InputError: no key has that id.
            UnavailableError: as create().
        """
        old = next((key for key in self.list() if key.key_id == key_id), None)
        if old is None:
            raise no_such_key(key_id)
        if old.expires_at_s is not None:
            expires_at_s = expires_at_s or time.time() + old.expires_at_s - old.created_at_s
        return self.create(old.tenant, old.scopes, old.label, expires_at_s)

    def end(self, key_id: str, at_s: float) -> None:
        """Let a key expire at that UNIX time, unless it does so before. Raises UnavailableError as create()."""
        with self._changing() as keys:
            self._write(tuple(key.ending(at_s) if key.key_id == key_id else key for key in keys))

    def list(self) -> tuple[ApiKey, ...]:
        """All keys, oldest first.

        Raises:
            UnavailableError: the file is damaged.
        """
        self._refresh()
        return tuple(self._by_id.values())

    def revoke(self, key_id: str) -> ApiKey | None:
        """Remove a key, so that it is refused from now on; None if no key has that id.

        Raises:
            UnavailableError: the file is damaged, or another process keeps it locked.
        """
        with self._changing() as keys:
            revoked = next((key for key in keys if key.key_id == key_id), None)
            if revoked is not None:
                self._write(tuple(key for key in keys if key is not revoked))
        return revoked

    def find(self, text: str) -> ApiKey | None:
        """The key that this text belongs to, be it expired; None if there is none. Costs one stat and one hash.

        Raises:
            UnavailableError: the file is damaged; no key is accepted.
        """
        self._refresh()
        prefix, _, rest = text.partition("_")
        key_id, _, secret = rest.partition("_")
        key = self._by_id.get(key_id) if prefix == KEY_PREFIX else None
        if key is None or not hmac.compare_digest(_sha256(secret), key.secret_sha256):
            return None
        return key

    def _refresh(self) -> None:
        """Read the file if it has changed since it was read last."""
        try:
            status = self._path.stat()
        except FileNotFoundError:
            self._seen, self._by_id = None, {}
            return
        except OSError as error:
            raise self._damaged(error) from error
        seen = (status.st_ino, status.st_mtime_ns, status.st_size)
        if seen != self._seen:
            try:
                stored = _Stored.model_validate_json(self._path.read_bytes())
            except (OSError, ValidationError) as error:
                raise self._damaged(error) from error
            self._seen, self._by_id = seen, {key.key_id: key for key in stored.keys}

    def _damaged(self, error: Exception) -> UnavailableError:
        self._seen, self._by_id = None, {}
        problem = f"{self._path.name} cannot be read ({type(error).__name__}); no key is accepted."
        return UnavailableError(problem, "Restore the file, or remove it and create new keys.")

    @contextlib.contextmanager
    def _changing(self) -> Iterator[tuple[ApiKey, ...]]:
        """The present keys, while this process holds the lock."""
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with held(self._path.with_name("keys.lock"), "the keys"):
            yield self.list()

    def _write(self, keys: tuple[ApiKey, ...]) -> None:
        replace_file(self._path, _Stored(keys=keys).model_dump_json(indent=1, exclude_none=True).encode())


def expiring_keys(keys: Iterable[ApiKey], now_s: float) -> list[ApiKey]:
    """Those that expire within WARN_BEFORE_S after that UNIX time, and have not yet."""
    return [key for key in keys if not key.has_expired(now_s) and key.has_expired(now_s + WARN_BEFORE_S)]


def no_such_key(key_id: str) -> InputError:
    """The error of an id that no key has."""
    return InputError("ID", f"there is no key {key_id[:40]!r}.", "See `intrasplat keys list`.")


def check_keys(settings: Settings) -> None:
    """Return if the service has keys, or needs none because only this machine can reach it.

    Raises:
        UnavailableError: other machines can reach it and there are no keys.
    """
    if settings.host not in LOOPBACK_NAMES and not KeyFile(settings.data_dir).list():
        problem = f"Other machines can reach the service at {settings.host}, and there are no keys."
        remedy = f"Make one first: `intrasplat keys create --tenant NAME --data-dir {settings.data_dir}`."
        raise UnavailableError(problem, remedy)


def _sha256(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()
