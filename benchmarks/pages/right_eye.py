"""The part of docs/results/index.md on the right eye of stereo clips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from benchmarks.pages.markdown import number, origin, table
from worker.evaluate.rows import read_rows
from worker.evaluate.summary import Group, groups_of
from worker.methods.registry import PRESETS

TWO_EYES = "two-eyes.csv"
"""Rows of bm_two_eyes.py."""
_TWO_EYES = """
## Two eyes

`python benchmarks/bm_two_eyes.py` ([two-eyes.csv](two-eyes.csv), a row a run): `fast` on a stereo clip, trained on the
left eye or on both, judged at held-out moments by the left eye and by the right; medians over seeds. `warp` is what the
left eye's picture scores in the right eye, warped by stereo depth ([conventions](../conventions.md#scores)).
"""
_TRUTH = """
Synthetic clips have a truth for every pose. 10 and 15 degrees: views so far beside the endoscope, in dB; bound: what a
perfect model scores whose highlights are painted onto the tissue. empty: the share of pixels in which the model draws
nothing solid in front of the true surface, or where there is none. seen: of the pixels that some frame of either eye
showed as tissue, the share that the model covers.
"""
RIGHT_EYE_CHARTS = {
    "curves-eyes": """
### Left and right eye

![Held-out scores of the left and of the right eye against seconds of training](curves-eyes.png)

The right eye of a stereo recording is a true view some degrees beside the left one. `psnr_right` scores it at held-out
moments, over tissue that the left eye sees, too ([conventions](../conventions.md#scores)). Series with `eyes=left`,
drawn hollow, trained on the left eye alone. So did the published method and its variants. All others trained on both
eyes, never on a held-out moment of either. Dashed is what warping the left eye's picture of the same moment scores. No
model has that picture.
""",
    "pareto-right": """
![Final psnr_right against seconds of training](pareto-right.png)
""",
}
"""By chart: what stands with it."""
_COLUMNS = {
    "psnr_tissue_db": ("left, dB", 1), "psnr_right_db": ("right, dB", 1), "warp_db": ("warp, dB", 1),
    "psnr_clear_db": ("left without highlights", 1), "psnr_right_clear_db": ("right without highlights", 1),
    "warp_clear_db": ("warp without highlights", 1), "iterations": ("iterations", 0), "step_ms": ("step, ms", 1),
    "t_train_s": ("t_train_s", 1), "t_post_s": ("t_post_s", 1),
}  # fmt: skip

_TRUTH_COLUMNS = {
    "psnr_view10_db": ("10 degrees", 1), "bound10_db": ("bound", 1), "psnr_view15_db": ("15 degrees", 1),
    "bound15_db": ("bound", 1), "empty_ok": ("empty", 4), "seen_ok": ("seen", 4),
    "depth_error_mm": ("depth error, mm", 2), "motion_error_mm": ("motion error, mm", 2),
}  # fmt: skip


def both_eyes(groups: Sequence[Group]) -> str:
    """What `fast` reaches, and a row a group whose right eye was scored; empty without any."""
    known = [group for group in groups if not math.isnan(group.median("psnr_right_db"))]
    rows = [
        [*group.place, group.series, group.limit, str(len(group.rows))]
        + [number(group.median(name), digits) for name, (_, digits) in _COLUMNS.items()]
        for group in known
    ]
    header = ["clip", "held out", "series", "limit", "seeds", *(name for name, _ in _COLUMNS.values())]
    return f"\n{right_eye_claim(groups)}\n{table(header, rows)}" if rows else ""


def two_eyes(folder: Path) -> list[Group]:
    """The groups of bm_two_eyes.py's rows in folder."""
    return groups_of(read_rows(folder / TWO_EYES))


def two_eyes_sections(folder: Path) -> list[str]:
    """The section of bm_two_eyes.py; nothing without rows."""
    groups = two_eyes(folder)
    return [_TWO_EYES, both_eyes(groups), *_truth(groups), origin(read_rows(folder / TWO_EYES))] if groups else []


def _truth(groups: Sequence[Group]) -> list[str]:
    """What the truth of synthetic clips says of other poses; nothing without any."""
    rows = [
        [*group.place, group.series, group.limit, str(len(group.rows))]
        + [number(group.median(name), digits) for name, (_, digits) in _TRUTH_COLUMNS.items()]
        for group in groups
        if _is_synthetic(group)
    ]
    header = ["clip", "held out", "series", "limit", "seeds", *(name for name, _ in _TRUTH_COLUMNS.values())]
    return [_TRUTH, table(header, rows)] if rows else []


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
