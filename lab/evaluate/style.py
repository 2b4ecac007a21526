"""The style of charts: readable in print and by the colour-blind. The same rows give the same bytes.

Colours are those of Okabe and Ito (2008); every series has a mark of its own as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lab.evaluate.cells import BOTH_EYES, eyes_of, preset_name_of

PANEL_INCHES = (5.4, 3.5)
LEGEND_ROW_INCHES = 0.24
LEGEND_ENTRIES = 3  # a row of the legend and column of panels
PNG_DPI = 130
GREY = "#666666"
FAINT = "#bbbbbb"
SETTINGS = {
    "font.family": "DejaVu Sans",  # it comes with matplotlib: the same everywhere
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "svg.hashsalt": "intrasplat",
}


@dataclass(frozen=True)
class Look:
    """Colour and marker of a series; hollow: markers are filled with white."""

    colour: str
    marker: str
    hollow: bool = False

    @property
    def face(self) -> str:
        return "white" if self.hollow else self.colour

    @property
    def edge(self) -> str:
        return self.colour if self.hollow else "white"


_LOOKS = {
    "instant": Look("#E69F00", "^"),
    "fast": Look("#0072B2", "o"),
    "quality": Look("#009E73", "s"),
    "small": Look("#882255", "h"),
    "paper": Look("#D55E00", "D"),
    "paper-released": Look("#CC79A7", "v"),
    "without_mapf": Look("#56B4E9", "<"),
    "pfs": Look("#8C7A00", "P"),
    "hexplane": Look("#000000", "X"),
    "paper-wide": Look("#7F7F7F", ">"),
    "endonerf": Look("#8B4513", "p"),
    "lerplane": Look("#556B2F", "d"),
    "endogaussian": Look("#4B0082", "*"),
}
"""pfs has Okabe and Ito's yellow darkened: on white it is too light for a line."""
BASES_LOOKS = (
    Look("#E69F00", "^"), Look("#56B4E9", "v"), Look("#009E73", "s"), Look("#D55E00", "D"), Look("#CC79A7", "P"),
)  # fmt: skip
"""The looks of the grid's numbers of bases, in ascending order; the automatic choice looks like its preset."""


def look_of(series: str) -> Look:
    """The look of a preset's series; variants look like their preset, those of the left eye alone are hollow."""
    look = _LOOKS.get(preset_name_of(series), Look(GREY, "h"))
    return look if eyes_of(series) == BOTH_EYES else replace(look, hollow=True)


def figure_of(panels: int, columns: int, handles: Sequence[Any]) -> tuple[Any, list[Any]]:
    """A figure with its legend at the foot, and the axes of its panels, row by row."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    rows, entries = math.ceil(panels / columns), min(LEGEND_ENTRIES * columns, len(handles))
    legend_inches = LEGEND_ROW_INCHES * (math.ceil(len(handles) / entries) + 1)
    height = PANEL_INCHES[1] * rows + legend_inches
    room = ConstrainedLayoutEngine(rect=(0, legend_inches / height, 1, 1 - legend_inches / height))
    figure = Figure(figsize=(PANEL_INCHES[0] * columns, height), layout=room)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in axes[panels:]:
        unused.axis("off")
    figure.legend(handles=list(handles), loc="lower center", ncols=entries, fontsize=8.5, labelspacing=0.8)
    return figure, axes[:panels]


def save(figure: Any, folder: Path, name: str) -> None:
    """name.png and name.svg; nothing in them depends on the day or the machine."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", dpi=PNG_DPI, metadata={"Software": None})
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None, "Creator": None})
