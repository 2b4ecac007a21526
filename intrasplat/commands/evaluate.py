"""`intrasplat evaluate`: compare several methods on a clip; write a row and a curve for each, and one chart."""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from intrasplat.commands.arguments import positive
from intrasplat.commands.device import add_device
from intrasplat.commands.exits import ExitCode
from intrasplat.commands.progress_bar import ProgressBar
from intrasplat.errors import InputError, UnavailableError
from intrasplat.names import CURVE, MANIFEST, SCENE, PresetName

if TYPE_CHECKING:
    from intrasplat.report import Report

ROWS, CHART = "runs.csv", "chart.png"
COLUMNS = (
    "method", "t_train_s", "t_post_s", "iterations", "gaussians", "scene_bytes",
    "psnr_tissue_db", "psnr_right_db", "ssim_tissue", "copy_blend_db", "copy_flow_db",
)  # fmt: skip


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `evaluate`; run_cli reads them."""
    parser.add_argument("clip", type=Path, metavar="INPUT", help="a video, a folder or a zip, as for reconstruct")
    parser.add_argument(
        "right", type=Path, metavar="RIGHT", nargs="?", help="the right eye, if it is a file of its own"
    )
    parser.add_argument("--calibration", type=Path, metavar="F", help="JSON, OpenCV YAML or XML, or ini; for stereo")
    parser.add_argument("--masks", type=Path, metavar="F", help="the instruments, as for reconstruct")
    parser.add_argument(
        "--methods",
        nargs="+",
        choices=get_args(PresetName),
        default=["instant", "fast"],
        help="(default: instant fast)",
    )
    parser.add_argument("--budget-s", type=positive, metavar="S", help="of each method (default: its own)")
    parser.add_argument("--holdout", default="every8", help="frames to measure on (default: every8)")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="a scene for each method, runs.csv and chart.png"
    )
    add_device(parser, "auto")


def run_cli(options: argparse.Namespace) -> int:
    """Train with each method, unless its scene exists already, and return the exit code.

    Raises:
        InputError: the clip or an option cannot be used.
        UnavailableError: the device or matplotlib is missing. Without matplotlib, rows and scenes are still written.
    """
    from intrasplat.reconstruction import load, reconstruct
    from intrasplat.recording import read_clip

    clip = read_clip(options.clip, options.right, calibration=options.calibration, masks=options.masks)
    rows, curves = [], {}
    for method in options.methods:
        folder = options.out / method
        if (folder / MANIFEST).is_file():
            scene = load(folder, device=options.device)
        else:
            print(f"{method}:", file=sys.stderr)
            with ProgressBar(sys.stderr) as bar:
                scene = reconstruct(
                    clip, method=method, budget_s=options.budget_s, holdout=options.holdout,
                    device=options.device, out=folder, on_progress=bar.show,
                )  # fmt: skip
        rows.append(_row(method, scene.report, (folder / SCENE).stat().st_size))
        curves[method] = _curve(folder / CURVE)
        _write_rows(options.out / ROWS, rows)
        print("  ".join(f"{name} {value}" for name, value in rows[-1].items() if value != ""))
    chart = options.out / CHART
    _draw(chart, rows, curves)
    print(chart)
    return ExitCode.OK


def _row(method: str, report: Report, scene_bytes: int) -> dict[str, object]:
    """The row of a scene in runs.csv; "" where a value was not measured."""
    found = {
        "method": method,
        "t_train_s": _rounded(report.seconds.get("t_train_s"), 1),
        "t_post_s": _rounded(report.seconds.get("t_post_s"), 1),
        "iterations": report.iterations,
        "gaussians": report.gaussians,
        "scene_bytes": scene_bytes,
        "psnr_tissue_db": _rounded(report.psnr_tissue_db, 2),
        "psnr_right_db": _rounded(report.psnr_right_db, 2),
        "ssim_tissue": _rounded(report.ssim, 4),
        "copy_blend_db": _rounded(report.baseline_blend_db, 2),
        "copy_flow_db": _rounded(report.baseline_flow_db, 2),
    }
    return {name: found[name] for name in COLUMNS}


def _rounded(value: float | None, digits: int) -> float | str:
    return "" if value is None else round(value, digits)


def _write_rows(path: Path, rows: list[dict[str, object]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def _curve(path: Path) -> list[tuple[float, float]]:
    """The points of a curve: seconds of training and psnr_tissue_db."""
    with path.open(newline="") as file:
        return [(float(each["t_train_s"]), float(each["psnr_tissue_db"])) for each in csv.DictReader(file)]


def _draw(path: Path, rows: list[dict[str, object]], curves: dict[str, list[tuple[float, float]]]) -> None:
    """Draw a line for each method, held-out dB over seconds of training; dashed: the copy baselines.

    Raises:
        InputError: no frame was held out, so there is nothing to draw.
    """
    scored = [row for row in rows if row["psnr_tissue_db"] != ""]
    if not scored:
        raise InputError("--holdout", "no frame was held out, so nothing was scored.", "Give every8 or frame numbers.")
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        remedy = "pip install 'intrasplat[charts]'"
        raise UnavailableError("The chart needs matplotlib, which is not installed.", remedy) from None
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for row in scored:
        end = (row["t_train_s"], row["psnr_tissue_db"])
        points = [*curves[str(row["method"])], end]
        axes.plot(*zip(*points, strict=True), marker="o", markersize=4, label=row["method"])
    for name, label in (("copy_blend_db", "copy, blended"), ("copy_flow_db", "copy, by optical flow")):
        if scored[0][name] != "":
            axes.axhline(
                float(str(scored[0][name])), color="grey", linestyle="--" if "blend" in name else ":", label=label
            )
    axes.set(xscale="log", xlabel="seconds of training", ylabel="held-out psnr_tissue, dB")
    axes.legend()
    figure.savefig(path, dpi=130)
