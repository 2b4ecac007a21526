"""The option --data-dir of the commands that use an installation."""

from __future__ import annotations

import argparse
from pathlib import Path

from contract.runtime.settings import Settings


def add_data_dir(parser: argparse.ArgumentParser) -> None:
    """Add --data-dir, which settings_of reads."""
    parser.add_argument("--data-dir", type=Path, metavar="DIR", help="of the service (default: its settings')")


def settings_of(namespace: argparse.Namespace) -> Settings:
    """The settings of the environment, with the data directory of --data-dir if given. Raises InputError."""
    settings = Settings.from_environment()
    chosen: Path | None = namespace.data_dir
    return settings if chosen is None else settings.model_copy(update={"data_dir": chosen})
