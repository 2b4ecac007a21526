"""Write docs/results/index.md, and README's evaluation block, from the rows in lab/rows/: no figure is typed by hand.

    python -m lab.pages

Rows stand in lab/rows/, pictures in docs/results/. The commands that measure draw their charts beside the rows; this
one moves those that a page shows (SHOWN) to docs/results/, and git ignores the others. A section without rows, and a
chart that is not there, are left out.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from lab.pages.detail import DETAIL_CHART, detail_sections
from lab.pages.evaluation import sections, write_readme
from lab.pages.gpu import gpu_sections
from lab.pages.live import live_sections
from lab.pages.moving import moving_sections
from lab.pages.post import post_sections
from lab.pages.programs import (
    long_sections,
    memory_sections,
    raster_sections,
    service_sections,
    survival_sections,
)
from lab.pages.recordings import recording_sections
from lab.pages.right_eye import two_eyes_sections
from lab.pages.stability import MAP, stability_sections
from lab.pages.stereo import stereo_sections
from lab.pages.table1 import table1_sections
from lab.pages.truth import CONFIDENCE_CHART, confidence_sections, measure_sections, off_axis_sections

REPOSITORY = Path(__file__).resolve().parent.parent.parent
ROWS, PICTURES = REPOSITORY / "lab" / "rows", REPOSITORY / "docs" / "results"
SHOWN = (
    "curves.png", "pareto.png", "pareto-one-clip.png", "frames.png", "capacity/knee.png", "table1/curves.png",
    "table1/pareto.png", "table1/frames.png", CONFIDENCE_CHART, DETAIL_CHART, MAP,
)  # fmt: skip
"""The charts that the results page or README shows, by their place beside the rows."""
_INTRODUCTION = """# Results

A command in this repository printed every figure here; its rows are in [lab/rows/](../../lab/rows/), and
`python -m lab.pages` writes this page from them. `d4d-a` is a real da Vinci recording (96 frames, 640x512, camera at
rest; `d4d-a-stereo` and `d4d_stereo` are the same as raw stereo) and `surgt_raw` another of 10 frames, neither part of
the project; the rest is synthetic. `psnr_tissue` is the honest score, `psnr_paper` what papers print
([conventions](../conventions.md)). The machines are shared and noisy, and a section holds for its commits (+: with
changes not yet committed); later ones may train or splat differently.
"""


def main() -> None:
    """Move the charts, then write both pages."""
    collect_charts(ROWS, PICTURES)
    parts = [
        _INTRODUCTION,
        *sections(ROWS, PICTURES),
        *post_sections(ROWS),
        *table1_sections(ROWS),
        *two_eyes_sections(ROWS),
        *detail_sections(ROWS, PICTURES),
        *off_axis_sections(PICTURES),
        *confidence_sections(ROWS, PICTURES),
        *measure_sections(ROWS),
        *stability_sections(ROWS, PICTURES),
        *moving_sections(ROWS),
        *recording_sections(ROWS),
        *live_sections(ROWS),
        *stereo_sections(ROWS),
        *raster_sections(ROWS),
        *gpu_sections(ROWS),
        *service_sections(ROWS),
        *memory_sections(ROWS),
        *long_sections(ROWS),
        *survival_sections(ROWS),
    ]
    (PICTURES / "index.md").write_text("".join(parts))
    write_readme(REPOSITORY / "README.md", ROWS, PICTURES)


def collect_charts(rows: Path, pictures: Path) -> None:
    """Move the charts of SHOWN that were drawn beside the rows to the pictures."""
    for name in SHOWN:
        if (rows / name).exists():
            (pictures / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(rows / name, pictures / name)


if __name__ == "__main__":
    main()
