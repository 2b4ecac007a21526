"""API keys: who may do what, kept as hashes in one file that every service of an installation reads.

The text of a key is isp_<id>_<secret>. Lists, logs and the audit log show the id. The secret is 256 random bits. The
file stores only its SHA-256 (no salt and no slow hash, because nobody can guess 256 bits). The file is replaced whole.
Every service reads it again when it has changed, and so refuses a revoked key at once. A key may expire.

Earlier versions refuse a file with a field that they do not know, and then accept no key. So a later version stores
what goes beyond the fields of ApiKey in a second file: keys.rotated.json lists the rotated keys.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import secrets
import time
from collections.abc import Collection, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from contract.runtime.locks import locked
from contract.runtime.settings import LOOPBACK_NAMES, Settings
from contract.wire.job import TENANT_PATTERN
from intrasplat.errors import InputError, UnavailableError
from intrasplat.files.disk_errors import disk_errors
from intrasplat.files.durable import replace_file

KEYS_FILE = "keys.json"
ROTATED_FILE = "keys.rotated.json"
KEY_PREFIX = "isp"
SECRET_BYTES = 32
MAX_LABEL_CHARACTERS = 60
DAY_S = 24 * 3600.0
WARN_BEFORE_S = 14 * DAY_S
"""The metrics and `intrasplat doctor` warn of a key that expires within this time."""


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
    FEEDS = "feeds"
    """Open, pause and end live feeds, push into them and cut clips out of them."""
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


def new_key(
    tenant: str,
    scopes: Collection[KeyScope] = DEFAULT_SCOPES,
    label: str | None = None,
    expires_at_s: float | None = None,
) -> tuple[ApiKey, str]:
    """A new key that is not in a file yet, and its text, which is stored nowhere.

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


class _Rotated(BaseModel):
    """A key that was rotated. successor: the id of the newest. made_until_s: it was made to last until then, UNIX time;
    None: for ever."""

    model_config = ConfigDict(frozen=True)

    successor: str
    made_until_s: float | None


class _RotatedKeys(BaseModel):
    """The file beside, by the ids of keys. Without it, a rotated key counts as one that was made to end so early."""

    model_config = ConfigDict(frozen=True)

    keys: dict[str, _Rotated] = {}


class KeyFile:
    """The keys of one data directory. If the file cannot be read, no key is accepted."""

    def __init__(self, data_dir: Path) -> None:
        self._path = data_dir.expanduser() / KEYS_FILE
        self._rotated_path = data_dir.expanduser() / ROTATED_FILE
        self._seen: tuple[int, int, int] | None = None
        self._by_id: dict[str, ApiKey] = {}

    def create(
        self,
        tenant: str,
        scopes: Collection[KeyScope] = DEFAULT_SCOPES,
        label: str | None = None,
        expires_at_s: float | None = None,
    ) -> tuple[ApiKey, str]:
        """Create a key that is accepted from now on. Returns it and its text. Raises as new_key() and add()."""
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

    def successor(self, key_id: str, expires_at_s: float | None = None) -> tuple[ApiKey, str]:
        """A new key with the tenant, scopes and label of `key_id`, and its text. The key is not in a file yet.

        Args:
            expires_at_s: when the new key expires, UNIX time; None: it lasts as long as the old key was created for.

        Raises:
            InputError: no key has that id.
            UnavailableError: a file is damaged.
        """
        key = self.get(key_id)
        until_s = self._made_until_s(key)
        if until_s is not None:
            expires_at_s = expires_at_s or time.time() + until_s - key.created_at_s
        return new_key(key.tenant, key.scopes, key.label, expires_at_s)

    def rotate(self, key_id: str, successor: ApiKey, ends_at_s: float) -> ApiKey:
        """Accept the successor of a key, and let the old key expire at `ends_at_s` (UNIX time) at the latest.

        Both happen, or neither. Returns the old key.

        Raises:
            InputError: no key has that id.
            UnavailableError: as add().
        """
        with self._changing() as keys:
            key = self.get(key_id)
            ending = key.ending(ends_at_s)
            rotated = _Rotated(successor=successor.key_id, made_until_s=self._made_until_s(key))
            by_id = {each: kept for each, kept in self._rotated().items() if each in self._by_id} | {key_id: rotated}
            # Write the rotation first: an entry whose successor does not exist has no effect.
            replace_file(self._rotated_path, _RotatedKeys(keys=by_id).model_dump_json(indent=1).encode())
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
        """Remove a key, which is refused from now on. Returns the removed key.

        Raises:
            InputError: no key has that id.
            UnavailableError: as add().
        """
        with self._changing() as keys:
            revoked = self.get(key_id)
            self._write(tuple(key for key in keys if key != revoked))
        return revoked

    def expiring(self, now_s: float) -> tuple[ApiKey, ...]:
        """The keys without a successor that are valid at `now_s` (UNIX time) and expire within WARN_BEFORE_S of it.

        Raises:
            UnavailableError: the file is damaged.
        """
        keys, rotated = self.list(), {}
        with contextlib.suppress(UnavailableError):  # without the file, rotated keys are listed too
            rotated = self._rotated()
        there = {key.key_id for key in keys}
        followed = {key_id for key_id, each in rotated.items() if each.successor in there}
        lasting = (key for key in keys if key.key_id not in followed and not key.has_expired(now_s))
        return tuple(key for key in lasting if key.has_expired(now_s + WARN_BEFORE_S))

    def find(self, text: str) -> ApiKey | None:
        """The key with this text, even if it has expired; None if there is none. Costs one stat and one hash.

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
        """Read the file again if it has changed."""
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

    def _rotated(self) -> dict[str, _Rotated]:
        try:
            return _RotatedKeys.model_validate_json(self._rotated_path.read_bytes()).keys
        except FileNotFoundError:
            return {}
        except (OSError, ValidationError) as error:
            problem = f"{self._rotated_path} cannot be read ({type(error).__name__})."
            remedy = "Restore or remove it; without it, give the successors of rotated keys --expires yourself."
            raise UnavailableError(problem, remedy) from error

    def _made_until_s(self, key: ApiKey) -> float | None:
        rotated = self._rotated().get(key.key_id)
        return key.expires_at_s if rotated is None else rotated.made_until_s

    def _damaged(self, error: Exception) -> UnavailableError:
        self._seen, self._by_id = None, {}
        problem = f"{self._path.name} cannot be read ({type(error).__name__}); no key is accepted."
        return UnavailableError(problem, "Restore the file, or remove it and create new keys.")

    @contextlib.contextmanager
    def _changing(self) -> Iterator[tuple[ApiKey, ...]]:
        """Yield the present keys while this process holds the lock."""
        with disk_errors():
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with locked(self._path.with_name("keys.lock"), "the keys"):
                yield self.list()

    def _write(self, keys: tuple[ApiKey, ...]) -> None:
        replace_file(self._path, _Stored(keys=keys).model_dump_json(indent=1, exclude_none=True).encode())


def needs_keys(settings: Settings) -> bool:
    """Whether every caller needs a key: others than this machine's user can reach the service."""
    return settings.host not in LOOPBACK_NAMES or bool(settings.hosts)


def check_keys(settings: Settings) -> None:
    """Return if the service has keys, or needs none because only this machine's user may reach it.

    Raises:
        UnavailableError: every caller needs a key, and there are none.
    """
    if needs_keys(settings) and not KeyFile(settings.data_dir).list():
        at = settings.host if settings.host not in LOOPBACK_NAMES else ", ".join(sorted(settings.hosts))
        problem = f"Others can reach the service at {at}, and there are no keys."
        remedy = f"Make one first: `intrasplat keys create --tenant NAME --data-dir {settings.data_dir}`."
        raise UnavailableError(problem, remedy)


def _sha256(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()
