"""Checks the owner of a data directory: its service can neither read nor change what another user writes into it."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from contract.store.shelf import Area
from intrasplat.errors import UnavailableError


def check_owner(data_dir: Path) -> None:
    """Return if this user may write into a data directory: it is the service's user, or none has worked there yet.

    Raises:
        UnavailableError: the directory is another user's.
    """
    folder = data_dir.expanduser()
    owner = os.getuid()
    with contextlib.suppress(FileNotFoundError):
        owner = folder.stat().st_uid
        if owner == 0:  # root may own a volume that belongs to a group: then its first folder names the user
            owner = os.getuid()
        with contextlib.suppress(PermissionError):
            owner = (folder / Area.SPOOL).stat().st_uid
    if owner != os.getuid():
        problem = f"{folder} belongs to another user (uid {owner})."
        raise UnavailableError(problem, f"Run the command as that user, who is the service's: sudo -u '#{owner}' ...")
