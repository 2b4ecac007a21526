"""Are measured distances true within their stated uncertainties?

    python -m lab.benchmarks.bm_measure [--fit] [--scenes DIR] [--csv lab/rows/measure.csv]

Trains `fast` for a fixed number of iterations on small stereo clips of synthetic tissue. Measures depths of points in
views of several times and poses, and distances between them over all frames, and compares them with the truth: how many
lie within one and two standard uncertainties (two are stated), and within 0.5 mm or these. Prints a row a clip; with
--csv it writes them.

--fit finds DISPARITY_PX of intrasplat/view/measure.py, and the factor of the spread (taken as 1), anew on the clips
FITTED_ON. The others confirm them. --scenes keeps the trained scenes in a folder, and uses those that are there.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from intrasplat.names import MANIFEST
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.measure import DISPARITY_PX, MIN_CONFIDENCE, MeasuredPlace, distances, places_at, uncertainty_mm
from lab.evaluate.rows import commit, machine, write_rows
from lab.evaluate.sources import open_source, source_of
from lab.phantom import Phantom

FRAMES = 24
CLIPS = {
    "still:160x128": 200,
    "still:320x256": 300,
    "cut:160x128": 200,
    "cut:320x256": 300,
    "breathing:160x128": 200,
    "breathing:320x256": 300,
    "pull:160x128": 200,
    "pull:320x256": 300,
    "breathing+turn:160x128": 200,
}
"""Iterations by clip."""
FITTED_ON = ("still", "cut")
SHOWN_FRAMES = (3, 12, 20)
ORBITS = (None, OrbitPose(yaw_deg=10, pitch_deg=0, zoom=1), OrbitPose(yaw_deg=0, pitch_deg=-12, zoom=1))
"""The poses of the views; None: the endoscope's own pose."""
POINTS_A_SIDE = 10
ALLOWED_MM = 0.5


@dataclass(frozen=True)
class Row:
    """Shares of depths and of distances over all frames; errors and uncertainties are medians."""

    clip: str
    tuned: bool
    points: int
    refused: float
    depth_error_mm: float
    depth_within_1: float
    depth_within_2: float
    distances: int
    distance_error_mm: float
    uncertainty_mm: float
    within_1: float
    within_2: float
    within_half_mm_or_1: float
    within_half_mm_or_2: float


@dataclass(frozen=True, eq=False)
class SeenPoint:
    """The measured points of one view that were not refused, their indices, and their true values.

    depth_mm [P], paths_mm [T, P, 3]
    """

    frame: int
    asked: int
    places: list[MeasuredPlace]
    depth_mm: NDArray[np.float64]
    paths_mm: NDArray[np.float64]


def trained(clip: str, scenes: Path) -> tuple[TrainedScene, Phantom]:
    """The scene of a clip in the folder of scenes. Trains it if it does not exist."""
    opened = open_source(source_of(f"phantom:{clip}:{FRAMES}frames:stereo"), "every8", TrainingHooks())
    folder = scenes / clip.replace(":", "-")
    if not (folder / MANIFEST).is_file():
        options = ReconstructionOptions(iterations=CLIPS[clip])
        reconstruct(ReconstructionRequest(opened.clip, options), folder, TrainingHooks())
    assert opened.phantom is not None
    return load_scene(folder), opened.phantom


def views(scene: TrainedScene, phantom: Phantom) -> Iterator[SeenPoint]:
    """Measure the points of a grid in views of several frames and poses."""
    median_mm = MEDIAN_DEPTH_UNITS / scene.units_per_mm
    for frame in SHOWN_FRAMES:
        for orbit in ORBITS:
            pose = None if orbit is None else np.array(world_from_camera(orbit, median_mm))
            truth = phantom.trajectories(scene.intrinsics.width // POINTS_A_SIDE, frame, pose)
            points = [(column + 0.5, row + 0.5) for row, column in truth.pixels.tolist()]
            places = places_at(scene, frame / FRAMES, pose, scene.intrinsics, points)
            stands = phantom.world_from_camera(frame) if pose is None else pose
            depth_mm = (truth.points_mm[frame] - stands[:3, 3]) @ stands[:3, 2]
            kept = [n for n, each in enumerate(places) if not each.unseen and each.confidence >= MIN_CONFIDENCE]
            yield SeenPoint(frame, len(places), [places[n] for n in kept], depth_mm[kept], truth.points_mm[:, kept])


def row_of(clip: str, seen: list[SeenPoint], scene: TrainedScene) -> Row:
    """The row of a clip. Distances are those of random pairs of points in each view."""
    rng, errors, sigmas = np.random.default_rng(0), [], []
    for view in seen:
        pairs = rng.permutation(len(view.places))[: len(view.places) // 2 * 2].reshape(-1, 2)
        for first, second in pairs:
            found = distances(scene, view.frame / FRAMES, view.places[first], view.places[second])
            true_mm = np.linalg.norm(view.paths_mm[:, first] - view.paths_mm[:, second], axis=1)
            errors.append(np.abs(found.distances_mm - true_mm)[found.known])
            sigmas.append(found.uncertainties_mm[found.known])
    error_mm, sigma_mm = np.concatenate(errors), np.concatenate(sigmas)
    depth_error_mm = np.abs(depths_of(seen) - np.concatenate([view.depth_mm for view in seen]))
    depth_sigma_mm = np.array([each.uncertainty_mm for view in seen for each in view.places])
    asked = sum(view.asked for view in seen)
    return Row(
        clip=clip,
        tuned=clip.startswith(FITTED_ON),
        points=asked,
        refused=1 - len(depth_sigma_mm) / asked,
        depth_error_mm=float(np.median(depth_error_mm)),
        depth_within_1=float(np.mean(depth_error_mm <= depth_sigma_mm)),
        depth_within_2=float(np.mean(depth_error_mm <= 2 * depth_sigma_mm)),
        distances=len(error_mm),
        distance_error_mm=float(np.median(error_mm)),
        uncertainty_mm=float(np.median(sigma_mm)),
        within_1=float(np.mean(error_mm <= sigma_mm)),
        within_2=float(np.mean(error_mm <= 2 * sigma_mm)),
        within_half_mm_or_1=float(np.mean(error_mm <= np.maximum(ALLOWED_MM, sigma_mm))),
        within_half_mm_or_2=float(np.mean(error_mm <= np.maximum(ALLOWED_MM, 2 * sigma_mm))),
    )


def depths_of(seen: list[SeenPoint]) -> NDArray[np.float64]:
    return np.array([each.depth_mm for view in seen for each in view.places])


def fit(scenes: Path) -> None:
    """Print the two factors with which 95 % of the depths lie within two uncertainties and 68 % within one. They
    minimise the sum of both quantiles' pinball losses, with equal weights of the clips.
    """
    clips = []
    for clip in (each for each in CLIPS if each.startswith(FITTED_ON)):
        scene, phantom = trained(clip, scenes)
        seen = list(views(scene, phantom))
        error_mm = np.abs(depths_of(seen) - np.concatenate([view.depth_mm for view in seen]))
        clips.append((error_mm, *parts_of(scene, seen)))

    def loss(factors: NDArray[np.float64]) -> float:
        total = 0.0
        for error_mm, px_mm, spread_mm in clips:
            sigma_mm = np.hypot(factors[0] * px_mm, factors[1] * spread_mm)
            for times, share in ((1, 0.68), (2, 0.95)):
                beyond = error_mm - times * sigma_mm
                total += float(np.mean(np.where(beyond > 0, share, share - 1) * beyond) / np.mean(error_mm))
        return total

    found = np.abs(minimize(loss, np.array([0.1, 1.0]), method="Nelder-Mead").x)
    print("DISPARITY_PX", round(float(found[0]), 3), "factor of the spread", round(float(found[1]), 2))


def parts_of(scene: TrainedScene, seen: list[SeenPoint]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The uncertainties of all points from one pixel of disparity alone, and from the spread alone."""
    places = [each for view in seen for each in view.places]
    both = np.array([each.uncertainty_mm for each in places])
    only_px = np.array([uncertainty_mm(scene, each.own_depth_mm, 0.0, each.confidence) for each in places])
    return only_px / DISPARITY_PX, np.sqrt(np.maximum(both**2 - only_px**2, 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--scenes", type=Path, metavar="DIR")
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        scenes = options.scenes or Path(scratch)
        if options.fit:
            fit(scenes)
            return
        rows = []
        for clip in CLIPS:
            scene, phantom = trained(clip, scenes)
            rows.append(row_of(clip, list(views(scene, phantom)), scene))
            print(*(f"{name} {_told(value)}" for name, value in asdict(rows[-1]).items()), flush=True)
    if options.csv:
        told = [{name: _told(value) for name, value in asdict(row).items()} for row in rows]
        made = {"machine": machine(), "commit": commit()}
        write_rows(options.csv, [*told[0], *made], [row | made for row in told])


def _told(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
