"""What is measured of a camera that moves: its path, and the tissue that it shows."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.pages.markdown import table

Row = dict[str, str]

_PATHS = """
## Paths of a camera that moves

`python benchmarks/bm_poses.py --frames 128 --out docs/results/poses.csv` and, for the last three rows, `--frames 64
--motions breathing --paths pan advance shake` ([poses.csv](poses.csv)): the error of estimated paths, of every path
and motion of the phantom, and what the report says of it. The rows ran beside other programs, so their seconds are
too many. [Decision 049](../decisions/049-what-is-camera-and-what-is-tissue.md) has the table and what it means.
"""
_TISSUE = """
### Tissue that comes into view later

`python -m benchmarks.bm_keyframes --seeds 1 --out docs/results/keyframes.csv` ([keyframes.csv](keyframes.csv)):
`fast` on stereo clips of 320x256, with the true poses and with those that `auto` finds. Held-out psnr_tissue in dB,
left and right eye; the share of the tissue seen by any frame that the scene covers. Then what has left the view, from
where the camera was a quarter of the clip before: the median error of its depth in mm, had it stayed as it was, and
as shown; the mean confidence there, and of what is in view ([decision 050](../decisions/050-keyframes.md)).
"""


def moving_sections(results: Path) -> list[str]:
    """The sections whose rows exist."""
    parts = [_PATHS] if (results / "poses.csv").exists() else []
    if (results / "keyframes.csv").exists():
        with (results / "keyframes.csv").open(newline="") as file:
            parts += [_TISSUE, _tissue_table(list(csv.DictReader(file)))]
    return parts


def _tissue_table(rows: list[Row]) -> str:
    header = ["clip", "poses", "iterations", "left eye", "right eye", "covered", "had it stayed", "as shown"]
    header += ["confidence there", "in view", "Gaussians", "bases", "tracks, s"]
    names = ("clip", "poses", "iterations", "left_db", "right_db", "covered", "rest_mm", "gone_mm", "gone_confidence")
    names += ("confidence", "gaussians", "bases", "motion_s")
    return table(header, [[row[name] or "–" for name in names] for row in rows])
