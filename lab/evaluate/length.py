"""How long a benchmark trains: so many steps, or so many seconds."""

from __future__ import annotations

import argparse
from typing import Any

STEPS = 300


def add_length(parser: argparse.ArgumentParser) -> None:
    """Add --iterations (default: STEPS) and --budget-s, which exclude each other."""
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--iterations", type=int, default=STEPS)
    length.add_argument("--budget-s", type=float)


def length_of(options: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """The option of a reconstruction, and its text for a row, such as "300 steps" or "60 s"."""
    if options.budget_s is None:
        return {"iterations": options.iterations}, f"{options.iterations} steps"
    return {"budget_s": options.budget_s}, f"{options.budget_s:g} s"
