"""The parts of docs/results/index.md on stereo depth, confidence and views beside the endoscope, each against truth."""

from __future__ import annotations

from pathlib import Path

from lab.evaluate.rows import read_rows
from lab.pages.markdown import median_of, origin, source, table

STEREO_TRUTH, CONFIDENCE, MEASURE = "stereo_truth.csv", "confidence.csv", "measure.csv"
CONFIDENCE_CHART, OFF_AXIS = "confidence.png", "off-axis.jpg"
_STEREO = """
### Against truth

`scared_pair` is tissue under structured light; the others are synthetic, medians over seeds, `beside` within 24 px of
an instrument. Columns in mm count pixels with a confidence of 0.5 or more.
"""
_CONFIDENCE = """
## Does confidence tell what is right

Pixels by the confidence that the model reports: `right` is the share of them that is right, in synthetic clips
(chart) and at held-out frames of recordings (table, against the recorded picture and stereo depth). On the
diagonal, confidence is a probability ([rank
correlations](../decisions/views.md#confidence-is-the-probability-that-a-pixel-is-right)); between stills
(`hamlyn20`) views are trusted too much.

![Share of right pixels against confidence](confidence.png)
"""
_RECORDED = ("confidence", "depth_right", "colour_right", "right")
_MEASURE = """
## Are measured distances true

Medians in mm, and the shares that lie within two standard uncertainties (2 u), which API and page state
([what it means](../conventions.md#measuring)). `still` and `cut` had a part in the calibration, the others had none.
"""
_MEASURED = {
    "clip": "clip", "refused": "refused", "depth_error_mm": "depth error",
    "depth_within_2": "within 2 u", "distance_error_mm": "distance error",
    "uncertainty_mm": "u", "within_2": "within 2 u",
}  # fmt: skip
_OFF_AXIS = """
## Beside the endoscope

A synthetic pull, seen from 12 and 20 degrees to each side: truth; trained on the left eye, its guesses shown; trained
on both eyes, with what no frame showed hatched
([what is still wrong](../decisions/stereo-depth.md#tissue-takes-no-depth-from-instruments)).

![Truth, left eye alone and both eyes from 12 and 20 degrees](off-axis.jpg)

`python -m lab.benchmarks.bm_off_axis --picture docs/results/off-axis.jpg`
"""
_COLUMNS = {
    "valid_share": ("valid", 4), "median_px": ("median, px", 3), "off_3px_share": ("off by 3 px", 4),
    "clear_share": ("confident", 2), "median_mm": ("median, mm", 2), "p90_mm": ("90 %, mm", 2),
}  # fmt: skip


def stereo_truth_sections(folder: Path) -> list[str]:
    """The section of bm_stereo_truth.py, of its last commit alone; nothing without rows."""
    rows = read_rows(folder / STEREO_TRUTH)
    rows = [row for row in rows if row["commit"] == rows[-1]["commit"]]
    if not rows:
        return []
    cells = []
    for clip in dict.fromkeys(row["clip"] for row in rows):
        here = [row for row in rows if row["clip"] == clip]
        cells.append([clip, *(median_of(here, name, digits) for name, (_, digits) in _COLUMNS.items())])
    command = f"python -m lab.benchmarks.bm_stereo_truth --csv lab/rows/{STEREO_TRUTH}"
    header = ["clip", *(name for name, _ in _COLUMNS.values())]
    return [_STEREO, source(command, STEREO_TRUTH), table(header, cells), origin(rows)]


def confidence_sections(folder: Path, pictures: Path) -> list[str]:
    """The reliability diagram of bm_confidence.py; nothing without it."""
    rows = read_rows(folder / CONFIDENCE)
    if not rows or not (pictures / CONFIDENCE_CHART).exists():
        return []
    command = f"python -m lab.benchmarks.bm_confidence --csv lab/rows/{CONFIDENCE}"
    cells = []
    for clip, views in dict.fromkeys((row["clip"], row["views"]) for row in rows if "held-out" in row["views"]):
        here = [row for row in rows if (row["clip"], row["views"]) == (clip, views) and int(row["pixels"])]
        pixels = sum(int(row["pixels"]) for row in here)
        means = (sum(int(row["pixels"]) * float(row[name]) for row in here) / pixels for name in _RECORDED)
        cells.append([clip, views, *(f"{mean:.2f}" for mean in means)])
    tables = (
        [table(["recording", "views", "confidence", "depth right", "colour right", "both"], cells)] if cells else []
    )
    return [_CONFIDENCE, source(command, CONFIDENCE), *tables, origin(rows)]


def measure_sections(folder: Path) -> list[str]:
    """The table of bm_measure.py; nothing without rows."""
    rows = read_rows(folder / MEASURE)
    cells = [[row[name] for name in _MEASURED] for row in rows]
    command = f"python -m lab.benchmarks.bm_measure --csv lab/rows/{MEASURE}"
    return [_MEASURE, source(command, MEASURE), table([*_MEASURED.values()], cells), origin(rows)] if rows else []


def off_axis_sections(pictures: Path) -> list[str]:
    """The sheet of bm_off_axis.py; nothing without it."""
    return [_OFF_AXIS] if (pictures / OFF_AXIS).exists() else []
