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
from contract.store.disk_errors import disk_errors
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
    """Until then it was made to last, UNIX time; None: for ever."""
    ends_at_s: float | None = Field(default=None, gt=0, lt=1e11, allow_inf_nan=False)
    """Until then it lasts at most, because it has a successor; None: it has none."""

    @property
    def refused_from_s(self) -> float | None:
        """The UNIX time from which on it is refused; None: never."""
        return min((at_s for at_s in (self.expires_at_s, self.ends_at_s) if at_s is not None), default=None)

    def has_expired(self, now_s: float) -> bool:
        """Whether it is refused at that UNIX time."""
        return self.refused_from_s is not None and self.refused_from_s <= now_s

    def ending(self, at_s: float) -> ApiKey:
        """The same key, which ends at that UNIX time at the latest."""
        return self.model_copy(update={"ends_at_s": min(at_s, self.ends_at_s or at_s)})

    def successor(self, expires_at_s: float | None = None) -> tuple[ApiKey, str]:
        """A new key with this one's tenant, scopes and label, and its text.

        Args:
            expires_at_s: of the new key; None: it lasts as long as this one was made to last.
        """
        if self.expires_at_s is not None:
            expires_at_s = expires_at_s or time.time() + self.expires_at_s - self.created_at_s
        return new_key(self.tenant, self.scopes, self.label, expires_at_s)


def new_key(
    tenant: str,
    scopes: Collection[KeyScope] = DEFAULT_SCOPES,
    label: str | None = None,
    expires_at_s: float | None = None,
) -> tuple[ApiKey, str]:
    """A key that no file holds yet, and its text, which is kept nowhere.

    Raises:
        InputError: the tenant, the scopes or the label is not accepted.
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
    return key, f"{KEY_PREFIX}_{key.key_id}_{secret}"


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
        """A new key that is accepted from now on, and its text. Raises as new_key() and add()."""
        key, text = new_key(tenant, scopes, label, expires_at_s)
        self.add(key)
        return key, text

    def add(self, key: ApiKey) -> None:
        """Accept a key from now on.

        Raises:
            UnavailableError: the file is damaged or cannot be written, or another process keeps it locked.
        """
        with self._changing() as keys:
            self._write((*keys, key))

    def rotate(self, key_id: str, successor: ApiKey, ends_at_s: float) -> ApiKey:
        """Accept the successor of a key, and let that key end at that UNIX time, unless it does so before: both or
        neither. Returns the key that ends.

        Raises:
            InputError: no key has that id.
            UnavailableError: as add().
        """
        with self._changing() as keys:
            ending = self.get(key_id).ending(ends_at_s)
            self._write((*(ending if key.key_id == key_id else key for key in keys), successor))
        return ending

    def get(self, key_id: str) -> ApiKey:
        """The key with that id.

        Raises:
            InputError: no key has it.
            UnavailableError: the file is damaged.
        """
        found = next((key for key in self.list() if key.key_id == key_id), None)
        if found is None:
            raise InputError("ID", f"there is no key {key_id[:40]!r}.", "See `intrasplat keys list`.")
        return found

    def list(self) -> tuple[ApiKey, ...]:
        """All keys, oldest first.

        Raises:
            UnavailableError: the file is damaged.
        """
        self._refresh()
        return tuple(self._by_id.values())

    def revoke(self, key_id: str) -> ApiKey:
        """Remove a key, which is refused from now on; the key that it was.

        Raises:
            InputError: no key has that id.
            UnavailableError: as add().
        """
        with self._changing() as keys:
            revoked = self.get(key_id)
            self._write(tuple(key for key in keys if key != revoked))
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
        with disk_errors():
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with held(self._path.with_name("keys.lock"), "the keys"):
                yield self.list()

    def _write(self, keys: tuple[ApiKey, ...]) -> None:
        replace_file(self._path, _Stored(keys=keys).model_dump_json(indent=1, exclude_none=True).encode())


def expiring_keys(keys: Iterable[ApiKey], now_s: float) -> list[ApiKey]:
    """Those without a successor that expire within WARN_BEFORE_S after that UNIX time, and have not yet."""
    lasting = (key for key in keys if key.ends_at_s is None and not key.has_expired(now_s))
    return [key for key in lasting if key.has_expired(now_s + WARN_BEFORE_S)]


def needs_keys(settings: Settings) -> bool:
    """Whether every caller needs a key: others than this machine's user can reach the service."""
    return settings.host not in LOOPBACK_NAMES or bool(settings.hosts)


def check_keys(settings: Settings) -> None:
    """Return if the service has keys, or needs none because only this machine's user may reach it.

    Raises:
        UnavailableError: nobody could get in without a key, and there are none.
    """
    if needs_keys(settings) and not KeyFile(settings.data_dir).list():
        at = settings.host if settings.host not in LOOPBACK_NAMES else ", ".join(sorted(settings.hosts))
        problem = f"Others can reach the service at {at}, and there are no keys."
        remedy = f"Make one first: `intrasplat keys create --tenant NAME --data-dir {settings.data_dir}`."
        raise UnavailableError(problem, remedy)


def _sha256(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()
