"""The demo's pictures: a contact sheet, the curve of accuracy over time, and the strip that the README shows.

Nothing here is needed to use a service; matplotlib and Pillow are imported where they draw.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PANEL_INCHES = (3.1, 2.48)
"""One panel; the demo's frames are 5 : 4."""
SHEET_DPI = 130
CURVE_DPI = 110
STRIP_DPI = 115
STRIP_COLOURS = 256
"""Enough for wet tissue without bands; the file stays below 400 kB."""
CURVE_COLOUR = "#00707a"
BASELINE_COLOURS = ("#b35900", "#6b4e9b")
"""Distinct in print and for the colour-blind; the lines also differ in dashes."""


@dataclass(frozen=True)
class Panel:
    """One picture of a sheet: a PNG or JPEG file, or values [H, W] in colours that span limits."""

    caption: str
    image: bytes | None = None
    values: Any = None
    colours: str = "viridis"
    limits: tuple[float, float] = (0.0, 1.0)


def draw_sheet(title: str, rows: Sequence[tuple[str, Sequence[Panel]]], path: Path) -> None:
    """Draw rows of panels, each row with its name at the left."""
    columns = max(len(panels) for _, panels in rows)
    size = (PANEL_INCHES[0] * columns + 0.4, (PANEL_INCHES[1] + 0.25) * len(rows) + 0.4)
    figure, axes = _figure(columns, len(rows), size)
    for number, (name, panels) in enumerate(rows):
        in_row = axes[number * columns : (number + 1) * columns]
        in_row[0].set_ylabel(name, fontsize=11, labelpad=8)
        for axis in in_row[len(panels) :]:
            axis.axis("off")
        for axis, panel in zip(in_row, panels, strict=False):
            _draw_panel(axis, panel)
    figure.suptitle(title, fontsize=12.5)
    figure.savefig(path, dpi=SHEET_DPI)


def draw_strip(panels: Sequence[Panel], path: Path) -> None:
    """Draw one row of panels as a PNG with a palette, which keeps the file small."""
    from PIL import Image

    figure, axes = _figure(len(panels), 1, (PANEL_INCHES[0] * len(panels), PANEL_INCHES[1] + 0.2))
    for axis, panel in zip(axes, panels, strict=True):
        _draw_panel(axis, panel)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=STRIP_DPI)
    picture = Image.open(drawn).convert("RGB")
    picture.quantize(STRIP_COLOURS, method=Image.Quantize.FASTOCTREE).save(path, optimize=True)


def draw_curve(curve_csv: str, baselines_db: dict[str, float], title: str, path: Path) -> None:
    """Draw held-out psnr_tissue over seconds of training, with the copy baselines as dashed lines."""
    rows = list(csv.DictReader(io.StringIO(curve_csv)))
    seconds = [float(row["t_train_s"]) for row in rows]
    decibels = [float(row["psnr_tissue_db"]) for row in rows]
    figure, (axis,) = _figure(1, 1, (7.5, 4.4))
    axis.plot(seconds, decibels, marker="o", markersize=5, linewidth=2, color=CURVE_COLOUR, label="this model")
    styles = zip(BASELINE_COLOURS, ((0, (6, 3)), (0, (2, 2))), strict=True)
    for (name, value_db), (colour, dashes) in zip(baselines_db.items(), styles, strict=False):
        axis.axhline(value_db, linestyle=dashes, linewidth=1.6, color=colour, label=f"{name}: {value_db:.1f} dB")
    if seconds:
        axis.annotate(
            f"{decibels[-1]:.1f} dB", (seconds[-1], decibels[-1]), (0, 8), textcoords="offset points", ha="right"
        )
    axis.set_xlim(left=0)
    axis.margins(y=0.15)
    axis.set_xlabel("seconds of training")
    axis.set_ylabel("psnr_tissue on held-out frames, dB")
    axis.set_title(title, fontsize=11)
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9, loc="best")
    figure.savefig(path, dpi=CURVE_DPI)


def _draw_panel(axis: Any, panel: Panel) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(False)
    axis.set_title(panel.caption, fontsize=9.5, pad=3)
    if panel.image is not None:
        from PIL import Image

        # Without alpha the hatch under unseen pixels shows.
        axis.imshow(Image.open(io.BytesIO(panel.image)).convert("RGB"), interpolation="antialiased")
    else:
        axis.imshow(panel.values, cmap=panel.colours, vmin=panel.limits[0], vmax=panel.limits[1])


def _figure(columns: int, rows: int, size_inches: tuple[float, float]) -> tuple[Any, list[Any]]:
    """A figure without a display, and its axes in reading order."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_inches, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())
