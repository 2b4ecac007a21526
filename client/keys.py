"""`intrasplat keys`: create, rotate, list and revoke the API keys of an installation, in its data directory; and print
the secret with which a tenant's receivers verify webhooks.

The commands edit the file that the services read (contract/access/keys.py). Run them as the user that runs the service:
that user can read the clips anyway.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

from contract.access.audit import AuditAction, AuditEntry, AuditLog, utc_now, utc_text
from contract.access.keys import DAY_S, DEFAULT_SCOPES, ApiKey, KeyFile, KeyScope, new_key
from contract.access.webhook_secrets import tenant_secret
from contract.runtime.arguments import add_data_dir, settings_of
from contract.runtime.settings import Settings
from contract.store.owner import check_owner
from contract.wire.job import TENANT_PATTERN
from intrasplat.commands.arguments import Commands, add_command
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError
from intrasplat.files.disk_errors import disk_errors

UNITS_S = {"d": DAY_S, "h": 3600.0}
TIME_REMEDY = "Give a time to come: 90d, 12h, or a date or time such as 2030-01-31 or 2030-01-31T18:00 (UTC)."


def add_keys(commands: Commands) -> None:
    """Add `keys` with create, rotate, list and revoke."""
    parser = commands.add_parser(
        "keys", help="make, rotate, list and revoke API keys", description="API keys of a service."
    )
    own: Commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    create = add_command(own, "create", "make a key and print it, this once", _create)
    create.add_argument("--tenant", required=True, help="whose jobs the key reaches: 1 to 40 of a-z, 0-9 and -")
    create.add_argument(
        "--scopes",
        default=",".join(sorted(DEFAULT_SCOPES)),
        metavar="A,B",
        help=f"of {', '.join(KeyScope)} (default: %(default)s)",
    )
    create.add_argument("--label", help="what the list shows, at most 60 characters; name no patient")
    webhooks = add_command(own, "webhook-secret", "print what a tenant verifies webhooks with", _webhook_secret)
    webhooks.add_argument("--tenant", required=True, help="whose jobs the webhooks are about")
    rotate = add_command(own, "rotate", "make a key like another, which then ends after a while", _rotate)
    rotate.add_argument("key_id", metavar="ID", help="as `intrasplat keys list` shows it")
    rotate.add_argument("--overlap", default="24h", metavar="TIME", help="while both are good (default: %(default)s)")
    for command in (create, rotate):
        command.add_argument(
            "--expires", metavar="WHEN", help="after this time, such as 90d or 12h, or on this date (UTC) it is refused"
        )
    revoke = add_command(own, "revoke", "refuse a key from now on", _revoke)
    revoke.add_argument("key_id", metavar="ID", help="as `intrasplat keys list` shows it")
    for command in (create, rotate, add_command(own, "list", "show all keys, without their secrets", _list), revoke):
        add_data_dir(command)


def _create(options: argparse.Namespace) -> int:
    key, text = new_key(options.tenant, _scopes(options.scopes), options.label, _expires_at_s(options))
    keys = _own_keys(options)
    with _recorded(options, (AuditAction.KEY_CREATED, key, "")):
        keys.add(key)
        _show(key, text)
    return ExitCode.OK


def _rotate(options: argparse.Namespace) -> int:
    keys, expires_at_s = _own_keys(options), _expires_at_s(options)
    ends_at_s = _until("--overlap", options.overlap)
    old = keys.get(options.key_id).ending(ends_at_s)
    new, text = keys.successor(options.key_id, expires_at_s)
    how = f" (followed by {new.key_id}, ends {utc_text(old.expires_at_s or ends_at_s)})"
    with _recorded(options, (AuditAction.KEY_CREATED, new, ""), (AuditAction.KEY_ROTATED, old, how)):
        old = keys.rotate(old.key_id, new, ends_at_s)
        _show(new, text)
        print(f"the old one: {_line(old)}", file=sys.stderr)
    return ExitCode.OK


def _show(key: ApiKey, text: str) -> None:
    print(text)
    print(f"{_line(key)}\nKeep the key; it is not shown again.", file=sys.stderr)


def _list(options: argparse.Namespace) -> int:
    for key in KeyFile(settings_of(options).data_dir).list():
        print(_line(key))
    return ExitCode.OK


def _revoke(options: argparse.Namespace) -> int:
    keys = _own_keys(options)
    key = keys.get(options.key_id)
    with _recorded(options, (AuditAction.KEY_REVOKED, key, "")):
        keys.revoke(key.key_id)
        print(f"revoked {_line(key)}", file=sys.stderr)
    return ExitCode.OK


def _webhook_secret(options: argparse.Namespace) -> int:
    secret = Settings.from_environment().webhook_secret
    if secret is None:
        remedy = "Set it as for the service; `openssl rand -hex 32` makes one."
        raise InputError("INTRASPLAT_WEBHOOK_SECRET", "it is not set.", remedy)
    if not re.fullmatch(TENANT_PATTERN, options.tenant):
        raise InputError("--tenant", f"{options.tenant!r} is no tenant.", "See `intrasplat keys list`.")
    print(tenant_secret(secret, options.tenant))
    return ExitCode.OK


def _own_keys(options: argparse.Namespace) -> KeyFile:
    """The keys of an installation of this user, for changes."""
    data_dir = settings_of(options).data_dir
    check_owner(data_dir)
    return KeyFile(data_dir)


@contextmanager
def _recorded(options: argparse.Namespace, *acts: tuple[AuditAction, ApiKey, str]) -> Iterator[None]:
    """Record a change of keys in the audit log, before and after. An action with a "begun" line and no "done" line
    failed or was cut off."""
    data_dir = settings_of(options).data_dir.expanduser()
    with disk_errors():
        data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    log = AuditLog(data_dir)

    def note(state: str) -> None:
        for action, key, how in acts:
            about = {"outcome": f"{state}{how}", "tenant": key.tenant, "key_id": key.key_id}
            log.append(AuditEntry(time=utc_now(), action=action, **about))

    note("begun")
    yield
    note("done")


def _scopes(text: str) -> frozenset[KeyScope]:
    try:
        return frozenset(KeyScope(name.strip()) for name in text.split(","))
    except ValueError as error:
        raise InputError("--scopes", f"{error}.", f"Use some of {', '.join(KeyScope)}.") from error


def _until(flag: str, text: str) -> float:
    """Parse a date, or a duration from now. Returns UNIX time.

    Raises:
        InputError: it is neither, or it lies in the past.
    """
    now_s = time.time()
    if length := re.fullmatch(r"(\d{1,5})([dh])", text, re.ASCII):
        until_s = now_s + int(length[1]) * UNITS_S[length[2]]
    else:
        try:
            day = datetime.fromisoformat(text)
        except ValueError:
            raise InputError(flag, f"{text[:40]!r} is no time.", TIME_REMEDY) from None
        until_s = (day if day.tzinfo else day.replace(tzinfo=UTC)).timestamp()
    if until_s <= now_s:
        raise InputError(flag, f"{text[:40]!r} is over.", TIME_REMEDY)
    return until_s


def _expires_at_s(options: argparse.Namespace) -> float | None:
    return None if options.expires is None else _until("--expires", options.expires)


def _line(key: ApiKey) -> str:
    created = utc_text(key.created_at_s)[: len("2026-01-31")]
    expires = "never expires"
    if key.expires_at_s is not None:
        word = "expired" if key.has_expired(time.time()) else "expires"
        expires = f"{word} {utc_text(key.expires_at_s)}"
    scopes = ",".join(sorted(key.scopes))
    return f"{key.key_id}  {key.tenant}  {scopes}  {created}  {expires}  {key.label or ''}".rstrip()
