"""What becomes of a sequence of stills: pairs taken seconds apart, between which endoscope and tissue move far?

    python -m lab.benchmarks.bm_stills [--seeds 0 1] [--budget-s 30] [--out lab/rows/stills.csv]

Of each seed: 25 pairs of the phantom, 1.7 s apart, while the endoscope advances by 100 mm and returns and the tissue
breathes; a rectification's black borders, an instrument in two pairs, and a camera that keeps its mean brightness. With
INTRASPLAT_DATA set, the recording hamlyn20 (17 pairs, 3.3 s apart) as well.

Prints and writes of each: the path's absolute trajectory error (mm, degrees; of all frames that the report does not
call lost), frames lost, the held-out scores of both eyes and of blending neighbours, and the seconds.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import intrasplat as isp
from intrasplat.poses.trajectory import trajectory_error
from lab.evaluate.rows import commit, machine, write_rows
from lab.evaluate.sources import DATA_VARIABLE, source_of
from lab.phantom import Phantom, PhantomSettings, make_phantom

FRAMES, EVERY_S, BREATH_S = 25, 1.7, 4.2
WITH_TOOL = (9, 10)
"""The stills in which the instrument is seen."""
BULGE, SHIFT_PX = 0.06, 7.0
"""The rectified pictures' borders: how far the sides bulge inwards, as a share of the side, and how far the whole
is moved, in opposite directions for the two eyes."""
MARGIN_PX = 4
"""Around the field of view, for the motion of the tissue and of the right eye."""
STAGES = ("poses_s", "finish_s", "shrink_s", "t_post_s")
"""Frames in memory are placed before the clock of the report starts: they have no poses_s."""
FIELDS = (
    "clip", "ate_mm", "ate_deg", "sigma_mm", "lost", "psnr_tissue_db", "psnr_right_db", "blend_db", "train_db",
    "gaussians", "outside_field", "poses_s", "finish_s", "shrink_s", "t_post_s", "machine", "commit",
)  # fmt: skip

Rgb = NDArray[np.uint8]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--budget-s", type=float, default=30.0)
    parser.add_argument("--out", type=Path, default=Path("lab/rows/stills.csv"))
    options = parser.parse_args()
    rows = []
    for seed in options.seeds:
        frames, true = stills(seed)
        rows.append(measured(f"stills:seed{seed}", frames, options.budget_s, true))
    if os.environ.get(DATA_VARIABLE):
        recording = source_of("hamlyn20")
        frames = isp.read_clip(recording.clip, calibration=recording.files["calibration"])
        rows.append(measured(recording.name, frames, 20.0, None))
    write_rows(options.out, FIELDS, [row | {"machine": machine(), "commit": commit()} for row in rows])


def stills(seed: int, width: int = 320, height: int = 256) -> tuple[isp.Clip, NDArray[np.float64]]:
    """The stills, and their true poses [T, 4, 4] (mm, world_from_camera)."""
    settings = PhantomSettings(
        width=width,
        height=height,
        frames=FRAMES,
        seed=seed,
        camera=("retreat",),
        period_frames=BREATH_S / EVERY_S,
        frame_rate_hz=1 / EVERY_S,
    )
    phantom = make_phantom(settings)
    order = np.roll(np.arange(FRAMES), -(FRAMES // 2))  # the clip begins and ends far away
    eyes, masks = [], []
    for place, index in enumerate(order):
        pair, tissue = _without_tool(phantom, int(index)), np.ones((height, width), np.bool_)
        if place in WITH_TOOL:
            frame = phantom.frame(int(index))
            pair, tissue = (frame.left, frame.right), frame.tissue
        gain = 110 / pair[0].mean()
        eyes.append([bordered(np.clip(gain * eye, 0, 255).astype(np.uint8), side) for side, eye in enumerate(pair)])
        masks.append(~tissue)
    left, right = (np.stack(eye) for eye in zip(*eyes, strict=True))
    times_s = EVERY_S * np.arange(FRAMES)
    clip = isp.read_clip(
        left, right, calibration=settings.calibration.model_dump(mode="json"), masks=np.stack(masks),
        frame_times_s=times_s,
    )  # fmt: skip
    return clip, np.stack([phantom.world_from_camera(int(index)) for index in order])


def _without_tool(phantom: Phantom, index: int) -> tuple[Rgb, Rgb]:
    eyes = phantom.render(index)[0], phantom.render(index, phantom.world_from_right(index))[0]
    left, right = ((255 * eye).astype(np.uint8) for eye in eyes)
    return left, right


def bordered(rgb: Rgb, side: int) -> Rgb:
    """A picture [H, W, 3] with the black border that rectification leaves."""
    height, width = rgb.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    x = x + (2 * side - 1) * 2 * SHIFT_PX / width
    seen = (np.abs(x) < 1 - BULGE * (1 - y**2)) & (np.abs(y) < 1 - BULGE * (1 - x**2))
    return np.where(cv2.erode(seen.astype(np.uint8), np.ones((3, 3)))[..., None] > 0, rgb, np.uint8(0))


def measured(name: str, recording: isp.Clip, budget_s: float, true: NDArray[np.float64] | None) -> dict[str, Any]:
    """A row, which it prints."""
    scene = isp.reconstruct(recording, method="fast", budget_s=budget_s)
    report = scene.report
    poses, seconds = report.poses, report.seconds
    assert poses is not None
    field = recording.with_depth().field_of_view
    row: dict[str, Any] = {
        "clip": name,
        "sigma_mm": poses.sigma_mm and round(poses.sigma_mm, 2),
        "lost": len(poses.unsure_frames),
        "psnr_tissue_db": round(report.psnr_tissue_db or 0.0, 2),
        "psnr_right_db": round(report.psnr_right_db or 0.0, 2),
        "blend_db": round(report.baseline_blend_db or 0.0, 2),
        "train_db": round(report.train_psnr_tissue_db or 0.0, 2),
        "gaussians": report.gaussians,
        "outside_field": 0.0 if field is None else round(outside(scene, field), 4),
        **{name: round(seconds[name], 1) for name in STAGES if name in seconds},
    }
    if true is not None:
        found = scene.world_from_camera
        placed = [i for i in range(len(true)) if i not in poses.unsure_frames]
        error = trajectory_error(found[placed], true[placed])
        row |= {"ate_mm": round(error.mm, 2), "ate_deg": round(error.deg, 2)}
    print("  ".join(f"{each} {row.get(each, '')}" for each in FIELDS[:-2]), flush=True)
    return row


def outside(scene: isp.Scene, field: NDArray[np.bool_]) -> float:
    """The share of Gaussians that lie outside the field of view [H, W], and MARGIN_PX around it, of all frames."""
    trained, camera, margin = scene.trained, scene.intrinsics, np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    near = cv2.dilate(field.astype(np.uint8), margin) > 0
    points_mm = trained.gaussians.mean.numpy() / trained.units_per_mm
    seen = np.zeros(len(points_mm), np.bool_)
    lost = scene.report.poses.unsure_frames if scene.report.poses else ()
    for pose in np.linalg.inv(np.delete(scene.world_from_camera, lost, axis=0)):
        x, y, z = (points_mm @ pose[:3, :3].T + pose[:3, 3]).T
        column = np.floor(camera.fx * x / np.maximum(z, 1e-3) + camera.cx).astype(int)
        row = np.floor(camera.fy * y / np.maximum(z, 1e-3) + camera.cy).astype(int)
        inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        seen[inside] |= near[row[inside], column[inside]]
    return float(1 - seen.mean())


if __name__ == "__main__":
    main()
