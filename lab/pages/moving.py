"""The parts of docs/results/index.md on moving cameras, tissue that comes into view, and clips without masks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from statistics import mode

from intrasplat.notices import NoticeCode
from lab.evaluate.rows import Row, read_rows
from lab.pages.markdown import median_of, source, table

_PATHS = """
## Paths of a camera that moves

Stereo clips of 320x256 without poses; each row is the median over clips of one camera motion ([how paths are
found](../decisions/camera-path.md)). Error: the absolute trajectory error of the estimated path; `d4d_stereo` has a
camera at rest. Clips of 64 frames: the same with `--frames 64 --motions breathing --paths pan advance shake --seeds 1`.
`p1_...`: paths of a robot, `--frames 150 --motions breathing --paths p1_00240 p1_06768 p1_07344 p1_16608`.
"""
_NOISY = """
### Given poses that jump

Clips with depth whose poses err by so many mm along each axis, and by as much again at the tissue by their angles;
medians over clips ([how](../decisions/camera-path.md#given-poses-that-jump-are-corrected-by-the-pictures)).
"""
_TISSUE = """
### Tissue that comes into view later

`fast` on stereo clips of 320x256, with true poses, with a file of them that names neither unit nor direction, and with
those that `auto` finds; medians over clips, held-out dB
([how](../decisions/motion.md#tissue-that-comes-into-view-is-tracked-from-keyframes)). The last three columns are of
tissue that has left the view: its depth error in mm, had it stayed as it was and as shown, and its confidence.
`p1_...`: `--motions breathing --paths p1_00240 p1_06768 p1_07344 p1_16608 --frames 150 --poses true file auto`.
"""
_MASKS = """
## Instruments found without masks

Masks that are found against true ones (those of `d4d-a` are approximate; `surgt_raw` has none), and held-out dB of
`fast` over the true tissue with either ([how](../decisions/instruments.md)).
"""
_PATH_COLUMNS = {
    "ate_mm": ("error, mm", 2), "ate_deg": ("degrees", 2), "held_out_mm": ("held out, mm", 2),
    "extent_mm": ("moved, mm", 1), "sigma_mm": ("stated, mm", 2),
}  # fmt: skip
_NOISY_COLUMNS = {
    "given_mm": ("as given, mm", 2), "given_deg": ("degrees", 2), "ate_mm": ("as trained on, mm", 2),
    "ate_deg": ("degrees", 2),
}  # fmt: skip
_TISSUE_COLUMNS = {
    "left_db": ("found, dB", 1), "covered": ("covered", 3), "rest_mm": ("stayed", 2),
    "gone_mm": ("shown", 2), "gone_confidence": ("confidence", 2),
}  # fmt: skip
_MASK_COLUMNS = {
    "clip": "clip", "iou": "intersection over union", "worst_iou": "worst frame", "sure": "sure",
    "given_left_db": "true masks, dB", "found_left_db": "found",
}  # fmt: skip


def moving_sections(folder: Path) -> list[str]:
    """The sections whose rows exist."""
    parts = []
    if rows := read_rows(folder / "poses.csv"):
        header = ["camera", "clips", *(name for name, _ in _PATH_COLUMNS.values()), "`auto` says"]
        cells = [
            [camera, str(len(here)), *_medians(here, _PATH_COLUMNS), ", ".join(sorted({row["auto"] for row in here}))]
            for camera, here in _by_camera(rows).items()
        ]
        command = "python -m lab.benchmarks.bm_poses --frames 128 --seeds 0 1 --out lab/rows/poses.csv"
        parts += [_PATHS, source(command, "poses.csv"), table(header, cells)]
    if rows := read_rows(folder / "noisy_poses.csv"):
        header = ["noise, mm", "clips", *(name for name, _ in _NOISY_COLUMNS.values()), "warned"]
        cells = []
        for noise in dict.fromkeys(row["noise_mm"] for row in rows):
            here = [row for row in rows if row["noise_mm"] == noise]
            warned = sum(NoticeCode.POSE_JITTER in row["told"].split("; ") for row in here)
            cells.append([noise, str(len(here)), *_medians(here, _NOISY_COLUMNS), f"{warned} of {len(here)}"])
        command = (
            "python -m lab.benchmarks.bm_poses --frames 64 --paths pan advance roll turn shake swing --seeds 1 "
            "--noise 0.1 0.25 1.0 --out lab/rows/noisy_poses.csv"
        )
        parts += [_NOISY, source(command, "noisy_poses.csv"), table(header, cells)]
    if rows := read_rows(folder / "keyframes.csv"):
        header = ["camera", "true poses, dB", "from a file", *(name for name, _ in _TISSUE_COLUMNS.values())]
        cells = []
        for camera, here in _by_camera(rows).items():
            by_poses = {poses: [row for row in here if row["poses"] == poses] for poses in ("true", "file", "auto")}
            given = [median_of(by_poses[poses], "left_db", 1) for poses in ("true", "file")]
            cells.append([camera, *given, *_medians(by_poses["auto"], _TISSUE_COLUMNS)])
        command = (
            "python -m lab.benchmarks.bm_keyframes --motions breathing pull --seeds 1 --out lab/rows/keyframes.csv"
        )
        parts += [_TISSUE, source(command, "keyframes.csv"), table(header, cells)]
    if rows := read_rows(folder / "masks.csv"):
        shown = [[row[name] or "–" for name in _MASK_COLUMNS] for row in rows]
        command = (
            "python -m lab.benchmarks.bm_masks --size 320x256 --seeds 31 --iterations 300 --out lab/rows/masks.csv"
        )
        parts += [_MASKS, source(command, "masks.csv"), table(list(_MASK_COLUMNS.values()), shown)]
    return parts


def _by_camera(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by the camera's motion: phantom:pull+pan:128frames:seed0 is `pan`, with its length if that is not usual."""
    found: dict[str, list[Row]] = {}
    lengths = [length for row in rows for length in re.findall(r":(\d+)frames", row["clip"])]
    for row in rows:
        named = re.fullmatch(r"phantom:\w+?(?:\+(?P<path>\w+))?:(?P<frames>\d+)frames:.*", row["clip"])
        camera = (named["path"] or "rest") if named else f"`{row['clip']}`"
        if named and named["frames"] != mode(lengths):
            camera += f", {named['frames']} frames"
        found.setdefault(camera, []).append(row)
    return found


def _medians(rows: list[Row], columns: dict[str, tuple[str, int]]) -> list[str]:
    return [median_of(rows, name, digits) for name, (_, digits) in columns.items()]
