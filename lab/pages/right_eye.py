"""The part of docs/results/index.md on the right eye of stereo clips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from intrasplat.methods.registry import PRESETS
from lab.evaluate.rows import read_rows
from lab.evaluate.summary import Group, groups_of
from lab.pages.markdown import number, origin, source, table

TWO_EYES = "two-eyes.csv"
"""Rows of bm_two_eyes.py."""
_TWO_EYES = """
## Two eyes

`fast` on stereo clips, trained on the left eye or on both, medians over seeds: `warp` is what the left eye's picture
scores in the right eye, warped by stereo depth ([conventions](../conventions.md#scores)). 10 degrees: a view so
far beside the endoscope, of synthetic clips, which have a truth there.
"""
_COLUMNS = {
    "psnr_tissue_db": ("left, dB", 1), "psnr_right_db": ("right, dB", 1), "warp_db": ("warp, dB", 1),
    "psnr_view10_db": ("10 degrees", 1),
}  # fmt: skip


def both_eyes(groups: Sequence[Group]) -> str:
    """What `fast` reaches, and a row a group whose right eye was scored; empty without any."""
    known = [group for group in groups if not math.isnan(group.median("psnr_right_db"))]
    rows = [
        [*group.place, group.series, group.limit]
        + [number(group.median(name), digits) for name, (_, digits) in _COLUMNS.items()]
        for group in known
    ]
    header = ["clip", "held out", "series", "limit", *(name for name, _ in _COLUMNS.values())]
    return f"\n{right_eye_claim(groups)}\n{table(header, rows)}" if rows else ""


def two_eyes(folder: Path) -> list[Group]:
    """The groups of bm_two_eyes.py's rows in folder."""
    return groups_of(read_rows(folder / TWO_EYES))


def two_eyes_sections(folder: Path) -> list[str]:
    """The section of bm_two_eyes.py; nothing without rows."""
    groups = two_eyes(folder)
    if not groups:
        return []
    command = source("python -m lab.benchmarks.bm_two_eyes", TWO_EYES)
    return [_TWO_EYES, command, both_eyes(groups), origin(read_rows(folder / TWO_EYES))]


def right_eye_claim(groups: Sequence[Group]) -> str:
    """What `fast` scores in both eyes of each recorded stereo clip, in its usual time; empty without such rows."""
    judged = [group for group in groups if not math.isnan(group.median("psnr_right_db")) and not _is_synthetic(group)]
    fast = [group for group in judged if group.series == "fast"]
    usual = [group for group in fast if group.limit == f"{PRESETS['fast'].budget_s:g} s"]
    return " ".join(
        f"In {group.limit}, `fast` scores {group.median('psnr_tissue_db'):.1f} dB in the left eye of "
        f"`{group.clip}` ({group.holdout}) and {group.median('psnr_right_db'):.1f} dB in the right eye; the left eye's "
        f"picture, warped, scores {group.median('warp_db'):.1f} dB there."
        for group in usual or fast
    )


def _is_synthetic(group: Group) -> bool:
    return not math.isnan(group.median("psnr_view10_db"))
