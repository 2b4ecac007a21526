"""The option --device of several commands."""

from __future__ import annotations

import argparse
from typing import get_args

from intrasplat.names import DeviceName


def add_device(parser: argparse.ArgumentParser, default: str) -> None:
    """Add --device to a parser."""
    what = "auto: an NVIDIA GPU if all of its requirements are met, else the CPU"
    parser.add_argument("--device", choices=get_args(DeviceName), default=default, help=f"{what} (default: {default})")
