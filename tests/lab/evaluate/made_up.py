"""Rows that nobody measured, for what is computed and drawn from rows."""

from __future__ import annotations

from collections.abc import Sequence

from lab.evaluate.rows import KEY, RUN_FIELDS, Row


def run_row(series: str, psnr_tissue_db: float, *, seed: int = 0, limit: str = "60 s", **values: object) -> Row:
    """A run's row with a score, a size and a speed."""
    known: dict[str, object] = {
        "clip": "d4d-a", "holdout": "every8", "series": series, "seed": seed, "limit": limit,
        "psnr_tissue_db": psnr_tissue_db, "copy_blend_db": 40.2, "copy_flow_db": 41.9, "t_train_s": 60.0,
        "render_fps": 70.0, "scene_bytes": 2_000_000, "iterations": 3000, "width": 640, "height": 512, **values,
    }  # fmt: skip
    return {name: str(known.get(name, "")) for name in RUN_FIELDS}


def failed_row(series: str) -> Row:
    """A run that ended in an error."""
    return run_row(series, 0.0, error="TrainingDiverged: no more") | {"psnr_tissue_db": "", "t_train_s": ""}


def curve_rows(
    run: Row, points: Sequence[tuple[float, int, float]], before_training_s: float | None = None
) -> list[Row]:
    """The run's curve: seconds, iterations, dB; SSIM and depth error do not change.

    before_training_s: between the request and training; without it the curve has no t_post_s.
    """
    names = ("t_train_s", "iteration", "psnr_tissue_db")
    other = {"ssim": "0.9", "depth_agreement_mm": "0.4"}
    key = {name: run[name] for name in KEY}
    rows = [{**key, **dict(zip(names, map(str, each), strict=True)), **other} for each in points]
    if before_training_s is None:
        return rows
    return [row | {"t_post_s": str(before_training_s + each[0])} for row, each in zip(rows, points, strict=True)]
