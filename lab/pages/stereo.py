"""The part of docs/results/index.md on depth from stereo."""

from __future__ import annotations

from pathlib import Path

from lab.pages.markdown import source
from lab.pages.truth import stereo_truth_sections

STEREO = "stereo.txt"
_STEREO = """
## Depth from stereo

Seconds a frame, and agreement with the recordings' own depth, stand in the file.
"""


def stereo_sections(folder: Path) -> list[str]:
    """Where the figures of recorded clips stand, and errors against truth; nothing without either."""
    parts = []
    if (folder / STEREO).exists():
        command = source(f"python -m lab.benchmarks.bm_stereo | tee lab/rows/{STEREO}", STEREO)
        parts += [_STEREO, command]
    return [*parts, *stereo_truth_sections(folder)]
