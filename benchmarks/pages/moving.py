"""What is measured of a camera that moves, its path and the tissue that it shows, and of clips without masks."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.pages.markdown import table
from contract.wire.notices import NoticeCode

Row = dict[str, str]

_PATHS = """
## Paths of a camera that moves

`python benchmarks/bm_poses.py --frames 128 --seeds 0 1 --out docs/results/poses.csv` and, for the last three rows,
`--frames 64 --motions breathing --paths pan advance shake --seeds 1` ([poses.csv](poses.csv)): stereo clips of 320x256
without poses. The absolute trajectory error of the estimated path, of training frames and of held-out ones, and what
the report says of it. `d4d_stereo` has no true path; its camera is fixed, and its error is the distance from rest of
the path before `estimate` decides that the camera is fixed. The rows ran beside other programs, so their seconds are
too many ([how paths are found](../decisions/camera-path.md)).
"""
_NOISY = """
### Given poses that jump

`python benchmarks/bm_poses.py --frames 64 --paths pan advance roll turn shake swing --seeds 1 --noise 0.1 0.25 1.0
--out docs/results/noisy_poses.csv` ([noisy_poses.csv](noisy_poses.csv)): clips with depth whose poses err by so many mm
along each axis, and by as much again at the tissue by their angles; the absolute trajectory error as given and as
trained on. Each report says by how much the given poses jump and what steadying may leave; warned is from two
pixels of 640 on ([how](../decisions/camera-path.md#given-poses-that-jump-are-corrected-by-the-pictures)).
"""
_TISSUE = """
### Tissue that comes into view later

`python -m benchmarks.bm_keyframes --motions breathing pull --seeds 1 --out docs/results/keyframes.csv`, in parts that
ran one after another ([keyframes.csv](keyframes.csv)): `fast` on stereo clips of 320x256, with the true poses and with
those that `auto` finds. Held-out psnr_tissue in dB, left and right eye; the share of the tissue seen by any frame that
the scene covers. Then what has left the view, from where the camera was a quarter of the clip before: the median error
of its depth in mm, had it stayed as it was, and as shown; the mean confidence there, and of what is in view. The rows
ran beside other programs ([how](../decisions/motion.md#tissue-that-comes-into-view-is-tracked-from-keyframes)).
"""
_MASKS = """
## Instruments found without masks

`python benchmarks/bm_masks.py --size 320x256 --seeds 31 --iterations 300 --out docs/results/masks.csv`
([masks.csv](masks.csv)): masks that are found against true ones, of every kind of instrument, and held-out dB of
`fast` with the true masks and with those found, over the tissue of the true ones: what is masked and never seen is a
hole there, and counts. The masks of `d4d-a` and `d4d-a-stereo` are approximate, and `surgt_raw` has none. The rows ran
beside other programs, so their seconds, of one core, are too many
([how](../decisions/instruments.md)).
"""

_PATH_COLUMNS = {
    "clip": "clip",
    "ate_mm": "error, mm",
    "ate_deg": "degrees",
    "held_out_mm": "held out, mm",
    "held_out_deg": "degrees",
    "auto": "`auto` says",
    "extent_mm": "moved, mm",
    "extent_deg": "degrees",
    "sigma_mm": "good to, mm",
    "sigma_deg": "degrees",
    "path_s": "s",
}
_NOISY_COLUMNS = {
    "clip": "clip",
    "noise_mm": "noise, mm",
    "given_mm": "error as given, mm",
    "given_deg": "degrees",
    "ate_mm": "as trained on, mm",
    "ate_deg": "degrees",
    "share_mm": "share of the error, mm",
    "share_deg": "degrees",
}
_MASK_COLUMNS = {
    "clip": "clip",
    "frames": "frames",
    "iou": "intersection over union",
    "worst_iou": "in the worst frame",
    "true_share": "true share",
    "found_share": "found share",
    "sure": "sure",
    "told": "told",
    "given_left_db": "left eye, true",
    "found_left_db": "found",
    "given_right_db": "right eye, true",
    "found_right_db": "found",
    "cost_s": "s",
}


def moving_sections(results: Path) -> list[str]:
    """The sections whose rows exist."""
    parts = []
    if rows := _rows(results / "poses.csv"):
        shown = [[row[name] for name in _PATH_COLUMNS] for row in rows]
        parts += [_PATHS, table(list(_PATH_COLUMNS.values()), shown)]
    if rows := _rows(results / "noisy_poses.csv"):
        shown = [[row[name] for name in _NOISY_COLUMNS] + [_warned(row)] for row in rows]
        parts += [_NOISY, table([*_NOISY_COLUMNS.values(), "warned"], shown)]
    if rows := _rows(results / "keyframes.csv"):
        parts += [_TISSUE, _tissue_table(rows)]
    if rows := _rows(results / "masks.csv"):
        shown = [[row[name] or "–" for name in _MASK_COLUMNS] for row in rows]
        parts += [_MASKS, table(list(_MASK_COLUMNS.values()), shown)]
    return parts


def _rows(path: Path) -> list[Row]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _warned(row: Row) -> str:
    return "yes" if NoticeCode.POSE_JITTER in row["told"].split("; ") else "no"


def _tissue_table(rows: list[Row]) -> str:
    header = ["clip", "poses", "iterations", "left eye", "right eye", "covered", "had it stayed", "as shown"]
    header += ["confidence there", "in view", "Gaussians", "bases", "tracks, s"]
    names = ("clip", "poses", "iterations", "left_db", "right_db", "covered", "rest_mm", "gone_mm", "gone_confidence")
    names += ("confidence", "gaussians", "bases", "motion_s")
    return table(header, [[row[name] or "–" for name in names] for row in rows])
