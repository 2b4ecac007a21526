"""`intrasplat keys`: make, list and revoke the API keys of an installation, in its data directory; and tell the secret
with which a tenant's receivers verify webhooks.

The commands edit the file that the services read (contract/access/keys.py). Run them as the user that runs the service:
that user can read the clips anyway.
"""

from __future__ import annotations

import argparse
import re
import sys
from datetime import UTC, datetime

from contract.access.audit import AuditAction, AuditEntry, AuditLog, utc_now
from contract.access.keys import DEFAULT_SCOPES, ApiKey, KeyFile, KeyScope
from contract.access.webhook_secrets import tenant_secret
from contract.runtime.arguments import Commands, add_command, add_data_dir, settings_of
from contract.runtime.exits import ExitCode
from contract.runtime.settings import Settings
from contract.wire.errors import InputError
from contract.wire.job import TENANT_PATTERN


def add_keys(commands: Commands) -> None:
    """Add `keys` with create, list and revoke."""
    parser = commands.add_parser("keys", help="make, list and revoke API keys", description="API keys of a service.")
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
    revoke = add_command(own, "revoke", "refuse a key from now on", _revoke)
    revoke.add_argument("key_id", metavar="ID", help="as `intrasplat keys list` shows it")
    for command in (create, add_command(own, "list", "show all keys, without their secrets", _list), revoke):
        add_data_dir(command)


def _create(options: argparse.Namespace) -> int:
    keys = KeyFile(settings_of(options).data_dir)
    key, text = keys.create(options.tenant, _scopes(options.scopes), options.label)
    try:
        _record(options, AuditAction.KEY_CREATED, key)
    except BaseException:
        keys.revoke(key.key_id)  # it was never shown
        raise
    print(text)
    print(f"{_line(key)}\nKeep the key; it is not shown again.", file=sys.stderr)
    return ExitCode.OK


def _list(options: argparse.Namespace) -> int:
    for key in KeyFile(settings_of(options).data_dir).list():
        print(_line(key))
    return ExitCode.OK


def _revoke(options: argparse.Namespace) -> int:
    key = KeyFile(settings_of(options).data_dir).revoke(options.key_id)
    if key is None:
        raise InputError("ID", f"there is no key {options.key_id!r}.", "See `intrasplat keys list`.")
    print(f"revoked {_line(key)}", file=sys.stderr)
    _record(options, AuditAction.KEY_REVOKED, key)
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


def _record(options: argparse.Namespace, action: AuditAction, key: ApiKey) -> None:
    entry = AuditEntry(time=utc_now(), action=action, tenant=key.tenant, key_id=key.key_id)
    AuditLog(settings_of(options).data_dir).append(entry)


def _scopes(text: str) -> frozenset[KeyScope]:
    try:
        return frozenset(KeyScope(name.strip()) for name in text.split(","))
    except ValueError as error:
        raise InputError("--scopes", f"{error}.", f"Use some of {', '.join(KeyScope)}.") from error


def _line(key: ApiKey) -> str:
    created = datetime.fromtimestamp(key.created_at_s, UTC).strftime("%Y-%m-%d")
    return f"{key.key_id}  {key.tenant}  {','.join(sorted(key.scopes))}  {created}  {key.label or ''}".rstrip()
