"""`intrasplat backup` and `intrasplat restore` (contract/backup)."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from contract.runtime.arguments import add_data_dir, settings_of
from contract.runtime.settings import Settings
from contract.store.owner import check_owner
from contract.wire.job import JobState
from intrasplat.commands.arguments import Commands, add_command
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError

UNREADABLE = (
    "have records that cannot be read, which were left out; a restored service queues those anew whose clips are there"
)


def add_backup(commands: Commands) -> None:
    """Add backup and restore."""
    backup = add_command(commands, "backup", "copy all of a service, also of a busy one", _backup)
    backup.add_argument("destination", type=Path, metavar="DEST", help="the folder of all backups")
    backup.add_argument(
        "--full",
        action="store_true",
        help="copy unchanged files too; else they are hard links into the backup before",
    )
    restore = add_command(commands, "restore", "fill an empty data directory and queue from a backup", _restore)
    restore.add_argument("source", type=Path, metavar="SOURCE", help="a backup, or the folder of all: the newest")
    restore.add_argument(
        "--audit",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="written after the backup: what it says was purged or revoked does not come back; may be repeated",
    )
    for command in (backup, restore):
        add_data_dir(command)


def _backup(options: argparse.Namespace) -> int:
    from contract.backup.take import take_backup  # imports the queue's client
    from contract.queue.installed import installed_queue

    settings = settings_of(options)
    _check_installation(settings)
    with installed_queue(settings) as queue:
        taken = take_backup(settings, queue, options.destination, full=options.full)
    linked = f", {taken.linked} of them as in the backup before" if taken.linked else ""
    _say(f"{_counts(taken.jobs)}; {taken.files} files, {taken.bytes} bytes{linked}")
    if settings.store_url is not None:
        _say(f"clips and scenes stay in {settings.store_url}: back up the bucket by its own means")
    _say_skipped("were purged meanwhile and left out", taken.purged)
    why = "have no files here and were left out (is INTRASPLAT_STORE_URL that of the service?)"
    _say_skipped(why, taken.without_files)
    _say_skipped(UNREADABLE, taken.unreadable)
    print(taken.path)
    return ExitCode.FAILED if taken.unreadable else ExitCode.OK


def _restore(options: argparse.Namespace) -> int:
    from contract.backup.restore import restore_backup
    from contract.queue.installed import installed_queue

    settings = settings_of(options)
    check_owner(settings.data_dir)
    restored = restore_backup(settings, installed_queue(settings), options.source, options.audit)
    _say(f"restored the backup of {restored.created_at}, every hash compared: {_counts(restored.jobs)}")
    _say_skipped("had been purged and did not come back", restored.purged)
    _say_skipped("have neither clip nor scene and did not come back", restored.lost)
    _say_skipped(UNREADABLE, restored.unreadable)
    if restored.revoked_keys:
        _say(f"keys that had been revoked and did not come back: {', '.join(restored.revoked_keys)}")
    if not options.audit:
        _say("what was purged after the backup is here again, unless an --audit tells of it")
    print(settings.data_dir)
    return ExitCode.OK


def _check_installation(settings: Settings) -> None:
    """Refuse a data directory or a queue that cannot belong to a service's installation."""
    check_owner(settings.data_dir)
    data_dir = settings.data_dir.expanduser()
    if not os.path.isdir(data_dir / "spool"):  # False also where this user may not read
        remedy = "Name that of the service (--data-dir, or INTRASPLAT_DATA_DIR), and run the command as its user."
        raise InputError("--data-dir", f"{data_dir} is no data directory.", remedy)
    if settings.redis_url is None and not (data_dir / "valkey").is_dir():
        problem = f"it is not set, and {data_dir} has no queue of its own."
        raise InputError("REDIS_URL", problem, "Set it as the service has it.")


def _counts(jobs: Mapping[JobState, int]) -> str:
    counts = ", ".join(f"{number} {state}" for state, number in jobs.items() if number)
    return f"{sum(jobs.values())} jobs" + (f" ({counts})" if counts else "")


def _say_skipped(why: str, job_ids: Sequence[str]) -> None:
    if job_ids:
        _say(f"{len(job_ids)} jobs {why}: {', '.join(job_ids)}")


def _say(text: str) -> None:
    print(f"intrasplat: {text}", file=sys.stderr)
