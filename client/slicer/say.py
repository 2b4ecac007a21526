"""Prints the bridge's messages to stderr."""

from __future__ import annotations

import sys


def say(words: str) -> None:
    """Print a line at once."""
    print(f"intrasplat: {words}", file=sys.stderr, flush=True)
