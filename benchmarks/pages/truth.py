"""The parts of docs/results/index.md on stereo depth, confidence and views beside the endoscope, each against truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from benchmarks.pages.markdown import number, origin, table
from worker.evaluate.rows import Row, read_rows

STEREO_TRUTH, CONFIDENCE, OFF_AXIS = "stereo_truth.csv", "confidence.csv", "off-axis.jpg"
MEASURE = "measure.csv"
_STEREO = """
### Against truth

`python -m benchmarks.bm_stereo_truth --csv docs/results/stereo_truth.csv` ([stereo_truth.csv](stereo_truth.csv)):
`scared_pair` is tissue under structured light, the others are synthetic, medians over seeds. `hard` has dark borders,
wet highlights on a third of the picture and strong distortion; of `beside` only what lies within 24 px of an instrument
is judged. Columns in mm are of pixels with a confidence of 0.5 or more.
"""
_CONFIDENCE = """
## Does confidence tell what is right

`python -m benchmarks.bm_confidence --csv docs/results/confidence.csv` ([confidence.csv](confidence.csv)): pixels of
synthetic clips by the confidence that the model reports; `right` is the share of them that is right. On the diagonal,
confidence is a probability.
[views.md](../decisions/views.md#confidence-is-the-probability-that-a-pixel-is-right) has the rank correlations.

![Share of right pixels against confidence](confidence.png)
"""
_MEASURE = """
## Are measured distances true

`python -m benchmarks.bm_measure --csv docs/results/measure.csv` ([measure.csv](measure.csv)): points of views of three
times and three poses, and distances between them followed over all frames, against the truth of synthetic clips. Errors
and standard uncertainties are medians in mm; 1 u and 2 u are the shares that lie within one and two of them.
API and page state 2 u.
Still and cut had a part in the calibration, the others had none ([what it means](../conventions.md#measuring)).
"""
_MEASURED = {
    "clip": "clip", "points": "points", "refused": "refused", "depth_error_mm": "depth: error",
    "depth_within_1": "1 u", "depth_within_2": "2 u", "distances": "distances", "distance_error_mm": "error",
    "uncertainty_mm": "uncertainty", "within_1": "1 u", "within_2": "2 u",
    "within_half_mm_or_1": "0.5 mm or 1 u", "within_half_mm_or_2": "0.5 mm or 2 u",
}  # fmt: skip
_OFF_AXIS = """
## Beside the endoscope

`python -m benchmarks.bm_off_axis --picture docs/results/off-axis.jpg`: a synthetic pull, from 12 and 20 degrees to the
right, left, top and bottom. Columns: truth; trained on the left eye, its guesses shown; trained on both eyes, with what
no frame showed hatched.
[stereo-depth.md](../decisions/stereo-depth.md#tissue-takes-no-depth-from-instruments) says what is still wrong.

![Truth, left eye alone and both eyes from 12 and 20 degrees](off-axis.jpg)
"""
_COLUMNS = {
    "valid_share": ("valid", 4), "median_px": ("median, px", 3), "off_3px_share": ("off by 3 px", 4),
    "rank": ("rank", 2), "rank_patches": ("rank of patches", 2), "rank_bound": ("bound of rank", 2),
    "clear_share": ("confident", 2), "median_mm": ("median, mm", 2), "p90_mm": ("90 %, mm", 2),
}  # fmt: skip


def stereo_truth_sections(folder: Path) -> list[str]:
    """The section of bm_stereo_truth.py, of its last commit alone; nothing without rows."""
    rows = read_rows(folder / STEREO_TRUTH)
    rows = [row for row in rows if row["commit"] == rows[-1]["commit"]]
    clips = dict.fromkeys(row["clip"] for row in rows)
    cells = [[clip, *_medians([row for row in rows if row["clip"] == clip])] for clip in clips]
    return [_STEREO, table(["clip", *(name for name, _ in _COLUMNS.values())], cells), origin(rows)] if rows else []


def confidence_sections(folder: Path) -> list[str]:
    """The reliability diagram of bm_confidence.py; nothing without it."""
    rows = read_rows(folder / CONFIDENCE)
    return [_CONFIDENCE, origin(rows)] if rows else []


def measure_sections(folder: Path) -> list[str]:
    """The table of bm_measure.py; nothing without rows."""
    rows = read_rows(folder / MEASURE)
    cells = [[row[name] for name in _MEASURED] for row in rows]
    return [_MEASURE, table([*_MEASURED.values()], cells), origin(rows)] if rows else []


def off_axis_sections(folder: Path) -> list[str]:
    """The sheet of bm_off_axis.py; nothing without it."""
    return [_OFF_AXIS] if (folder / OFF_AXIS).exists() else []


def _medians(rows: Sequence[Row]) -> list[str]:
    found = []
    for name, (_, digits) in _COLUMNS.items():
        values = [float(row[name]) for row in rows if row[name]]
        found.append(number(median(values) if values else math.nan, digits))
    return found
