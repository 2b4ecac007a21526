"""Stereo depth and its confidence against truth: one real pair, and synthetic tissue made hard to match.

    python -m lab.benchmarks.bm_stereo_truth [--data FOLDER] [--device cuda] [--csv lab/rows/stereo_truth.csv]

FOLDER (INTRASPLAT_DATA, else ../shared/data) may hold `scared_pair`: left.png, right.png and disparity.tiff (px of the
left eye, 0: none) of real tissue under structured light. No calibration comes with it: PAIR_FX_PX and PAIR_BASELINE_MM
are those of such an endoscope, and errors are px. With TRITON_INTERPRET=1 "cuda" needs no GPU.

A row a clip. valid_share: of the pixels with truth, those with depth. median_px, off_1px_share and off_3px_share: of
|error| where valid. rank: Spearman's correlation of confidence and -|error|; 1: the surer, the truer. rank_patches: of
their means over squares of PATCH_PX, where the scatter of the truth itself averages out. rank_bound: the rank of a
confidence that knows the root mean square error of each square, which nobody can. clear_share: of the pixels with
truth, those with confidence >= 0.5; median_mm and p90_mm: of |error| there. burnt_out_share: of the drawn picture.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from intrasplat.camera import Intrinsics
from intrasplat.clip import StereoClip
from intrasplat.clip.calibration import RectifiedClip, rectify
from intrasplat.fusion import CLEAR_CONFIDENCE
from intrasplat.intake.calibration.types import RawCalibration, RawEye
from intrasplat.stereo import estimate_depth
from intrasplat.stereo.matching import SATURATED_LEVEL
from lab.evaluate.rows import commit, machine, read_rows, write_rows
from lab.phantom import PhantomSettings, make_phantom
from lab.phantom.shading import add_noise

PAIR_FX_PX, PAIR_BASELINE_MM = 520.0, 4.2
WIDTH, HEIGHT = 640, 512
DRAWN = PhantomSettings(width=800, height=640, frames=2, noise=False)
"""Wider than the recorded picture, so that distortion has content at its corners."""
FRAME, SEEDS = 1, (0, 1, 2)
PATCH_PX = 8
BESIDE_PX = 24  # from an instrument's edge; nearer than BESIDE_PX of intrasplat/stereo/depth.py no depth is given
DISTORTION = ((-0.30, 0.02, 0.0, 0.0), (-0.29, 0.02, 0.0, 0.0))
"""k1 k2 p1 p2 of each eye: the picture's corner moves by 47 px."""
CENTRES_PX = 6.0  # how far the right eye's principal point lies to the left of the left eye's
DARK_FROM, BLACK_FROM = 0.55, 0.92
"""Distances from the centre, as shares of the half diagonal, at which light starts to fall off and at which it ends."""
WETNESS, ROUGHNESS = 150.0, 0.4
"""Factors of the wet film's mirrored light and of its slopes: broad highlights burn out a third of the picture."""
FLAT_SHARE = 0.97  # of the contrast that flat tissue has lost
FIELDS = (
    "machine", "commit", "device", "clip", "seed", "valid_share", "median_px", "off_1px_share",
    "off_3px_share", "rank", "rank_patches", "rank_bound", "clear_share", "median_mm", "p90_mm", "burnt_out_share",
)  # fmt: skip
CLIPS = {
    "clean": frozenset[str](),
    "dark": frozenset({"dark"}),
    "wet": frozenset({"wet"}),
    "flat": frozenset({"flat"}),
    "distorted": frozenset({"distorted"}),
    "hard": frozenset({"dark", "wet", "distorted"}),
    "beside": frozenset({"masked"}),
}
"""The flaws of each synthetic clip; "masked": none, but only pixels beside instruments are judged."""

Rgb = NDArray[np.uint8]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Judged:
    """A clip of one pair with its true disparity in px [H, W], 0: not judged."""

    clip: RectifiedClip
    truth_px: Floats
    burnt_out_share: float = float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("INTRASPLAT_DATA", "../shared/data")))
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where pairs are matched")
    parser.add_argument("--csv", type=Path, help="file that gets the rows, in place of those of commit and device")
    arguments = parser.parse_args()
    origin = {"machine": machine(), "commit": commit(), "device": arguments.device}
    rows = []
    for name, seed, judged in _clips(arguments.data):
        rows.append({**origin, "clip": name, "seed": seed, **_scores(judged, arguments.device)})
        print(", ".join(f"{key} {value}" for key, value in rows[-1].items() if key not in origin), flush=True)
    if arguments.csv:
        same = (origin["commit"], arguments.device)
        kept = [row for row in read_rows(arguments.csv) if (row["commit"], row["device"]) != same]
        write_rows(arguments.csv, FIELDS, [*kept, *rows])


def _clips(data: Path) -> Iterator[tuple[str, int, Judged]]:
    if (data / "scared_pair").exists():
        yield "scared_pair", 0, real_pair(data / "scared_pair")
    else:
        print(f"{data} lacks scared_pair")
    for name, flaws in CLIPS.items():
        for seed in SEEDS:
            yield name, seed, synthetic(flaws, seed)


def real_pair(folder: Path) -> Judged:
    """The recorded pair with truth from structured light."""
    eyes = [cv2.cvtColor(cv2.imread(str(folder / f"{eye}.png")), cv2.COLOR_BGR2RGB) for eye in ("left", "right")]
    truth_px = np.asarray(cv2.imread(str(folder / "disparity.tiff"), cv2.IMREAD_UNCHANGED), np.float32)
    height, width = truth_px.shape
    camera = Intrinsics(width=width, height=height, fx=PAIR_FX_PX, fy=PAIR_FX_PX, cx=width / 2, cy=height / 2)
    everywhere = np.ones((1, height, width), np.bool_)
    clip = RectifiedClip(1, camera, PAIR_BASELINE_MM, 0.0, lambda: iter([(eyes[0], eyes[1])]), everywhere, np.zeros(1))
    return Judged(clip, truth_px)


def synthetic(flaws: frozenset[str], seed: int) -> Judged:
    """One pair of synthetic tissue, recorded with these flaws."""
    dry = make_phantom(replace(DRAWN, seed=seed, motion="cut" if "masked" in flaws else DRAWN.motion))
    albedo, film = dry.paint.albedo, dry.paint.film
    if "wet" in flaws:
        film = film * np.array([ROUGHNESS, ROUGHNESS, 1], np.float32)
        film[..., 2] = np.clip(film[..., 2], 0.5, 1) * WETNESS
    if "flat" in flaws:
        film = film * np.array([1 - FLAT_SHARE, 1 - FLAT_SHARE, 1], np.float32)
        albedo = albedo + np.float32(FLAT_SHARE) * (albedo.mean(axis=(0, 1)) - albedo)
    drawn = replace(dry, paint=replace(dry.paint, albedo=albedo, film=film)).frame(FRAME)
    burnt_out = cv2.cvtColor(drawn.left, cv2.COLOR_RGB2GRAY) >= SATURATED_LEVEL
    calibration = _calibration("distorted" in flaws)
    random = np.random.default_rng(seed)
    pair = [
        _recorded(picture, camera, "dark" in flaws, random)
        for picture, camera in ((drawn.left, calibration.left), (drawn.right, calibration.right))
    ]
    masks = _as_recorded(drawn.tissue)[None] > 0 if "masked" in flaws else None
    recording = StereoClip(1, HEIGHT, WIDTH, lambda: iter([(pair[0], pair[1])]), masks, np.zeros(1))
    clip = rectify(recording, calibration)
    depth_mm, tissue = (_as_rectified(each, clip.intrinsics) for each in (drawn.depth_mm, drawn.tissue))
    seen = (tissue > 0) & (depth_mm > 0)
    if "masked" in flaws:
        seen &= cv2.distanceTransform((tissue > 0).astype(np.uint8), cv2.DIST_C, 3) <= BESIDE_PX
    truth_px = clip.intrinsics.fx * clip.baseline_mm / np.where(seen, depth_mm, 1) + clip.disparity_offset_px
    return Judged(clip, np.where(seen, truth_px, 0).astype(np.float32), float(burnt_out.mean()))


def _calibration(distorted: bool) -> RawCalibration:
    focal = DRAWN.intrinsics.fx
    eyes = [
        {"fx_px": focal, "fy_px": focal, "cx_px": cx_px, "cy_px": (HEIGHT - 1) / 2, "distortion": list(coefficients)}
        for cx_px, coefficients in zip(
            ((WIDTH - 1) / 2, (WIDTH - 1) / 2 - CENTRES_PX),
            DISTORTION if distorted else ((), ()),
            strict=True,
        )
    ]
    return RawCalibration.model_validate(
        {
            "model": "raw",
            "width": WIDTH,
            "height": HEIGHT,
            "left": eyes[0],
            "right": eyes[1],
            "right_from_left_rotation": np.eye(3).tolist(),
            "right_from_left_translation_mm": [-DRAWN.baseline_mm, 0.0, 0.0],
        }
    )


def _recorded(drawn: Rgb, eye: RawEye, dark: bool, random: np.random.Generator) -> Rgb:
    """The drawn picture as recorded through this lens: distorted, dark at the border, with noise."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    matrix = np.array([[eye.fx_px, 0, eye.cx_px], [0, eye.fy_px, eye.cy_px], [0, 0, 1]])
    rays = cv2.undistortPointsIter(
        np.stack([x.ravel(), y.ravel()], 1)[:, None],
        matrix,
        np.array(eye.distortion or (0.0, 0.0, 0.0, 0.0)),
        None,
        None,
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-7),
    ).reshape(HEIGHT, WIDTH, 2)
    centre = np.array([DRAWN.width / 2 - 0.5, DRAWN.height / 2 - 0.5], np.float32)
    at = (rays * DRAWN.intrinsics.fx + centre).astype(np.float32)
    light = cv2.remap(drawn, at, None, cv2.INTER_CUBIC).astype(np.float32) / 255
    if dark:
        away = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) / np.hypot(WIDTH / 2, HEIGHT / 2)
        light *= np.clip((BLACK_FROM - away) / (BLACK_FROM - DARK_FROM), 0, 1)[..., None] ** 1.5
    return np.asarray(np.clip(255 * add_noise(light, random) + 0.5, 0, 255), np.uint8)


def _as_recorded(drawn: NDArray[np.generic]) -> Floats:
    """Resample a drawn picture of the left eye to a lens without distortion; nearest neighbour."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    maps = x + (DRAWN.width - WIDTH) / 2, y + (DRAWN.height - HEIGHT) / 2
    to_x, to_y = (each.astype(np.float32) for each in maps)
    return np.asarray(cv2.remap(drawn.astype(np.float32), to_x, to_y, cv2.INTER_NEAREST))


def _as_rectified(drawn: NDArray[np.generic], camera: Intrinsics) -> Floats:
    """Resample a drawn picture of the left eye to its rectified camera; nearest neighbour, 0 outside."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32) + np.float32(0.5)
    to_x = (x - camera.cx) / camera.fx * DRAWN.intrinsics.fx + DRAWN.width / 2 - 0.5
    to_y = (y - camera.cy) / camera.fy * DRAWN.intrinsics.fy + DRAWN.height / 2 - 0.5
    maps = to_x.astype(np.float32), to_y.astype(np.float32)
    return np.asarray(cv2.remap(drawn.astype(np.float32), *maps, cv2.INTER_NEAREST, borderValue=0), np.float32)


def _scores(judged: Judged, device: Literal["cpu", "cuda"]) -> dict[str, str]:
    clip, truth_px = judged.clip, judged.truth_px
    depth = estimate_depth(clip, device=device)
    depth_mm, confidence = depth.depth_mm[0], depth.depth_confidence[0]
    known = truth_px > 0
    valid = known & (depth_mm > 0)
    clear = valid & (confidence >= CLEAR_CONFIDENCE)
    focal_baseline = clip.intrinsics.fx * clip.baseline_mm
    found_px = focal_baseline / np.where(valid, depth_mm, 1) + clip.disparity_offset_px
    error_image_px = np.where(valid, np.abs(found_px - truth_px), 0)
    error_px = error_image_px[valid]
    patch_rms_px, _ = _patches(error_image_px**2, valid)
    patch_error_px, some = _patches(error_image_px, valid)
    patch_confidence, _ = _patches(confidence, valid)
    whole = valid[: PATCH_PX * some.shape[0], : PATCH_PX * some.shape[1]]
    bound = np.kron(patch_rms_px, np.ones((PATCH_PX, PATCH_PX)))[whole]
    bounded_px = error_image_px[: whole.shape[0], : whole.shape[1]][whole]
    true_mm = focal_baseline / (truth_px[clear] - clip.disparity_offset_px)
    median_mm, p90_mm = np.percentile(np.abs(depth_mm[clear] - true_mm), [50, 90])
    scores = {
        "valid_share": valid.sum() / known.sum(),
        "median_px": np.median(error_px),
        "off_1px_share": np.mean(error_px > 1),
        "off_3px_share": np.mean(error_px > 3),
        "rank": -spearmanr(confidence[valid], error_px).statistic,
        "rank_patches": -spearmanr(patch_confidence[some], patch_error_px[some]).statistic,
        "rank_bound": spearmanr(bound, bounded_px).statistic,
        "clear_share": clear.sum() / known.sum(),
        "median_mm": median_mm,
        "p90_mm": p90_mm,
        "burnt_out_share": judged.burnt_out_share,
    }
    return {name: "" if np.isnan(value) else f"{value:.4f}" for name, value in scores.items()}


def _patches(image: NDArray[np.generic], valid: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
    """Means over the valid pixels of each square of PATCH_PX, and which squares have one."""
    rows, columns = (side // PATCH_PX for side in valid.shape)
    squares = (slice(rows * PATCH_PX), slice(columns * PATCH_PX))
    shape = (rows, PATCH_PX, columns, PATCH_PX)
    number = valid[squares].reshape(shape).sum(axis=(1, 3))
    total = np.where(valid, image, 0)[squares].reshape(shape).sum(axis=(1, 3))
    return (total / np.maximum(number, 1)).astype(np.float32), number > 0


if __name__ == "__main__":
    main()
