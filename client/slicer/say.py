"""What the bridge tells on stderr, where its user reads."""

from __future__ import annotations

import sys


def say(words: str) -> None:
    """Print a line at once."""
    print(f"intrasplat: {words}", file=sys.stderr, flush=True)
