"""Is the confidence layer the probability that a pixel is right, and does it rank the errors?

    python -m lab.benchmarks.bm_confidence [--fit] [--csv lab/rows/confidence.csv]

Trains `fast` for a fixed number of iterations on small stereo clips of synthetic tissue, on both eyes, and compares
views 10 and 15 degrees off the axis and the right eye's views with the truth. Prints the rank correlations of
lab/evaluate/truth.py. With INTRASPLAT_DATA set, recordings follow, at their held-out frames (recorded_confidence.py).
With --csv it also writes the reliability diagram: a row a clip, kind of view and bin of
confidence, and the same as PNG beside it.

--fit finds the constants of intrasplat/quality/trust.py and intrasplat/view/confidence.py anew: a logistic regression
on pixels of the clips FITTED_ON, trained on both eyes and on the left one alone. The other clips confirm it.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.quality import trust
from intrasplat.report import Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.model import model_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.metrics import RIGHT_COLOUR, RIGHT_DEPTH
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.targets import TrainingFrames
from intrasplat.view.camera import view_camera
from intrasplat.view.confidence import LEAST_DISAGREEMENT, evidence, seen_from_endoscope
from intrasplat.view.render import render_frame
from lab.benchmarks.recorded_confidence import recorded_errors
from lab.evaluate.ranking import PixelErrors, rank_scores, reliability
from lab.evaluate.rows import commit, machine
from lab.evaluate.sources import OpenClip, open_source, source_of
from lab.evaluate.style import GREY, PANEL_INCHES, PNG_DPI, SETTINGS
from lab.evaluate.truth import Expected, ShownView, Truth, errors_of

MOTIONS = ("still", "breathing", "pull", "cut")
FITTED_ON = ("still", "cut")
CLIP, ITERATIONS = "phantom:{}:160x128:24frames:stereo", 200
PIXELS_FITTED = 20_000
"""Pixels of each clip that the fit uses, drawn at random."""
FIELDS = ("clip", "views", "low", "high", "pixels", "confidence", "depth_right", "colour_right", "right")
LOOKS = dict(zip(MOTIONS, (("#0072B2", "o"), ("#E69F00", "^"), ("#009E73", "s"), ("#D55E00", "D")), strict=True))


@dataclasses.dataclass(frozen=True)
class Trained:
    """A scene, the frames of the eyes it was trained on, and the truth."""

    scene: TrainedScene
    eyes: list[TrainingFrames]
    truth: Truth


@contextmanager
def trained(motion: str, eyes: str) -> Iterator[Trained]:
    """Its views have detail until this ends."""
    opened = open_source(source_of(CLIP.format(motion)), "every8", TrainingHooks())
    options = ReconstructionOptions(iterations=ITERATIONS, eyes=eyes)  # type: ignore[arg-type]  # pydantic checks it
    with tempfile.TemporaryDirectory() as folder:
        report = reconstruct(ReconstructionRequest(opened.clip, options), Path(folder), TrainingHooks())
        yield _trained(opened, report, load_scene(Path(folder)), eyes)


def _trained(opened: OpenClip, report: Report, scene: TrainedScene, eyes: str) -> Trained:
    train = [i for i in range(report.frame_count) if i not in {*report.held_out, *report.repeated}]
    assert opened.phantom is not None
    truth = Truth(opened.phantom, opened.tissue, train, report.held_out, opened.tissue_right)
    sides = zip(opened.clip.eyes, (0.0, 1.0) if eyes == "both" else (0.0,), strict=False)
    return Trained(scene, [TrainingFrames(eye, train, scene.units_per_mm, side) for eye, side in sides], truth)


def measured(motion: str) -> Iterator[dict[str, Any]]:
    """Rows of the reliability diagram; prints the rank correlations."""
    with trained(motion, "both") as run:
        for views, expected in run.truth.expected.items():
            errors = errors_of([_shown(run.scene, each) for each in expected], expected)
            yield from rows_of(f"phantom-{motion}", views, errors)


def _shown(scene: TrainedScene, expected: Expected) -> ShownView:
    """The view, as the service shows it."""
    shown = render_frame(scene, expected.frame / scene.frame_count, expected.pose)
    rgb, is_shown = shown.rgb.astype(np.float32) / np.float32(255), ~shown.unseen
    return ShownView(rgb, shown.depth_mm * is_shown, shown.confidence * is_shown)


def rows_of(clip: str, views: str, errors: PixelErrors) -> list[dict[str, Any]]:
    """A row a bin of confidence; prints the rank correlations and the expected calibration error."""
    bins = reliability(errors)
    off = sum(each.pixels * abs(each.confidence - each.right) for each in bins if each.pixels) / errors.confidence.size
    scores = {**rank_scores(errors, "rank"), "calibration_error": off}
    print(f"{clip:17} {views:14}", *(f"{name} {value:.2f}" for name, value in scores.items()), flush=True)
    return [{"clip": clip, "views": views, **dataclasses.asdict(each)} for each in bins]


def evidence_of(run: Trained, rng: np.random.Generator) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """The evidence [P, 5] from which confidence is computed (the last column is 1), and [P] whether the pixel is right,
    at random pixels that show seen tissue. The two values of the Gaussians are blended as logarithms.
    """
    scene, model = run.scene, model_of(run.scene)
    found = trust.logarithms(trust.evidence(model, run.eyes))
    numbers, rights = [], []
    for expected in (each for views in run.truth.expected.values() for each in views):
        t, k = expected.frame / scene.frame_count, scene.intrinsics
        shown = render_frame(scene, t, expected.pose)
        own_pose = scene.world_from_camera[expected.frame]
        own, image = (model.render(view_camera(scene, t, pose, k), t).copy() for pose in (own_pose, expected.pose))
        alpha = np.maximum(image[4], 1e-3)
        planes = np.stack([*found, np.zeros_like(found[0])]).astype(np.float32)
        blended = model.blended(view_camera(scene, t, expected.pose, k), t, planes)[:2] / alpha
        known = seen_from_endoscope(own[:3], shown.depth_mm, (k, expected.pose), (k, own_pose))
        seen = evidence(np.full_like(alpha, 0.5), image[:3], known)[1:]
        depth_right = np.abs(shown.depth_mm - expected.depth_mm) < RIGHT_DEPTH * expected.depth_mm
        colour = np.abs(np.clip(image[:3], 0, 1).transpose(1, 2, 0) - expected.rgb).mean(-1)
        judged = (shown.depth_mm > 0) & ~shown.unseen & (expected.depth_mm > 0)
        numbers.append(np.stack([*blended, *seen, np.ones_like(alpha)], -1)[judged])
        rights.append((depth_right & (colour < RIGHT_COLOUR))[judged])
    every, right = np.concatenate(numbers), np.concatenate(rights)
    chosen = rng.permutation(len(every))[:PIXELS_FITTED]
    return every[chosen], right[chosen]


def logistic(numbers: NDArray[np.floating], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The weights of a logistic regression, by Newton's method."""
    x, y, weights = numbers.astype(np.float64), right.astype(np.float64), np.zeros(numbers.shape[1])
    for _ in range(12):
        likely = 1 / (1 + np.exp(-(x @ weights)))
        spread = (likely * (1 - likely) + 1e-6)[:, None]
        weights += np.linalg.solve((x * spread).T @ x + 1e-3 * np.eye(x.shape[1]), x.T @ (y - likely))
    return weights


def fit() -> None:
    """Print the constants. A trusted Gaussian is one that the endoscope's own view shows with usual texture."""
    rng, parts = np.random.default_rng(0), []
    for motion in FITTED_ON:
        for eyes in ("both", "left"):
            with trained(motion, eyes) as run:
                parts.append(evidence_of(run, rng))
    numbers, right = (np.concatenate(each) for each in zip(*parts, strict=True))
    weights = logistic(numbers, right)
    view = float(weights[2] * np.log(LEAST_DISAGREEMENT) + weights[3] * np.median(numbers[:, 3]))
    print("trust.WEIGHTS", np.round(weights[:2], 2), "trust.BIAS", round(float(weights[4]) + view, 1))
    print("confidence.WEIGHTS", np.round([1, *weights[2:4]], 2), "confidence.BIAS", round(-view, 1))


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """The share of right pixels over confidence, a panel a kind of view and a line a clip."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(2 * PANEL_INCHES[0], PANEL_INCHES[1] * 1.15), layout="constrained")
        for axis, views in zip(figure.subplots(1, 2), ("off-axis", "right"), strict=True):
            axis.plot([0, 1], [0, 1], color=GREY, dashes=(4, 3), linewidth=1, label="as it says")
            for motion, (colour, marker) in LOOKS.items():
                bins = [row for row in rows if (row["clip"], row["views"]) == (f"phantom-{motion}", views)]
                shown = [(row["confidence"], row["right"]) for row in bins if row["pixels"] >= 100]
                axis.plot(*zip(*shown, strict=True), color=colour, marker=marker, markersize=4.5, label=motion)
            axis.set(xlabel="confidence", ylabel="share of pixels that are right", xlim=(0, 1), ylim=(0, 1))
            axis.set_title({"off-axis": "views 10 and 15 degrees off", "right": "the right eye"}[views])
        figure.axes[0].legend(loc="upper left", fontsize=8)
        figure.savefig(path, dpi=PNG_DPI, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    if options.fit:
        fit()
        return
    rows = [row for motion in MOTIONS for row in measured(motion)]
    for clip, views, errors in recorded_errors():
        rows += rows_of(clip, views, errors)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow([*FIELDS, "machine", "commit"])
            for row in rows:
                values = [f"{row[name]:.4g}" if isinstance(row[name], float) else row[name] for name in FIELDS]
                writer.writerow([*("" if each == "nan" else each for each in values), machine(), commit()])
        draw(rows, options.csv.with_suffix(".png"))


if __name__ == "__main__":
    main()
