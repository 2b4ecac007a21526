"""The part of docs/results/index.md on the right eye of stereo clips."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.pages.markdown import number, table
from worker.evaluate.summary import Group
from worker.train.presets import PRESETS

RIGHT_EYE_CHARTS = {
    "curves-eyes": """
### Left and right eye

![Held-out scores of the left and of the right eye against seconds of training](curves-eyes.png)

The right eye of a stereo recording is a true view some degrees beside the left one. `psnr_right` scores it at held-out
moments, over tissue that the left eye sees, too ([conventions](../conventions.md#scores)). Series with `eyes=left`,
drawn hollow, trained on the left eye alone. So did the published method and its rivals. All others trained on both
eyes, never on a held-out moment of either. Dashed is what warping the left eye's picture of the same moment scores. No
model has that picture.
""",
    "pareto-right": """
![Final psnr_right against seconds of training](pareto-right.png)
""",
}
"""By chart: what stands with it."""
_EYES = {
    "psnr_tissue_db": "left, dB", "psnr_right_db": "right, dB", "warp_db": "warp, dB",
    "psnr_clear_db": "left without highlights", "psnr_right_clear_db": "right without highlights",
    "warp_clear_db": "warp without highlights", "t_train_s": "t_train_s", "t_post_s": "t_post_s",
}  # fmt: skip


def both_eyes(groups: Sequence[Group]) -> str:
    """A row a group whose right eye was scored."""
    known = [group for group in groups if not math.isnan(group.median("psnr_right_db"))]
    rows = [
        [*group.place, group.series, group.limit, *(number(group.median(name), 1) for name in _EYES)] for group in known
    ]
    header = ["clip", "held out", "series", "limit", *_EYES.values()]
    return f"\n{right_eye_claim(groups)}\n{table(header, rows)}" if rows else ""


def right_eye_claim(groups: Sequence[Group]) -> str:
    """What `fast` scores in both eyes of each stereo clip, in its usual time; empty without such rows."""
    fast = [group for group in groups if group.series == "fast" and not math.isnan(group.median("psnr_right_db"))]
    usual = [group for group in fast if group.limit == f"{PRESETS['fast'].budget_s:g} s"]
    return " ".join(
        f"In {group.limit}, `fast` scores {group.median('psnr_tissue_db'):.1f} dB in the left eye of "
        f"`{group.clip}` ({group.holdout}) and {group.median('psnr_right_db'):.1f} dB in the right eye; the left eye's "
        f"picture, warped, scores {group.median('warp_db'):.1f} dB there."
        for group in usual or fast
    )
