"""What is lost when a clip shows a round field of view, and what the model claims outside of it.

    python -m lab.benchmarks.bm_field [--clip d4d_stereo] [--iterations 300] [--radius 0.47] [--out lab/rows/field.csv]

Cuts both eyes of a stereo recording to a disc, with a rim of 12 px on which light falls to black, and noise outside.
Then it trains `fast` on the whole clip, on the disc, and on the disc with fov=all. Each row has held-out psnr_tissue of
the left eye inside the disc, less its rim, against the whole recording; of what lies outside, the shares that claim a
confidence of at least 0.5 and that are marked as unseen; and the field that was found. psnr_tissue of the report is
that of the field alone.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import intrasplat as isp
from intrasplat.clip import held_out_frames
from intrasplat.decode import decode_clip
from intrasplat.decode.decoding import StereoRecording
from intrasplat.names import Fov
from lab.evaluate.rows import commit, machine, write_rows
from lab.evaluate.sources import source_of

HOLDOUT = "every8"
RIM_PX, NOISE_LEVELS, MARGIN_PX = 12, 4.0, 2
CONFIDENT = 0.5
FIELDS = (
    "clip", "cut", "fov", "iterations", "psnr_in_disc_db", "psnr_tissue_db", "psnr_right_db", "outside_confident",
    "outside_unseen", "field_share", "field_shape", "gaussians", "t_post_s", "machine", "commit",
)  # fmt: skip

Rgb = NDArray[np.uint8]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clip", default="d4d_stereo")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--radius", type=float, default=0.47, help="of the disc, as a share of the picture's height")
    parser.add_argument("--out", type=Path, default=Path("lab/rows/field.csv"))
    options = parser.parse_args()
    os.environ.setdefault("INTRASPLAT_DATA", "../shared/data")
    source = source_of(options.clip)
    recording = decode_clip(source.clip, calibration=source.files["calibration"], masks=source.files["masks"])
    assert isinstance(recording, StereoRecording)
    eyes = [np.stack(eye) for eye in zip(*recording.clip.pairs(), strict=True)]
    height, width = eyes[0].shape[1:3]
    rows, columns = np.mgrid[:height, :width]
    away_px = np.hypot(rows - height / 2, columns - width / 2) - options.radius * height
    light = np.clip(-away_px / RIM_PX, 0, 1)[..., None].astype(np.float32)
    cut = [darkened(eye, light, seed) for seed, eye in enumerate(eyes)]
    tissue = recording.clip.tissue
    assert tissue is not None
    found = []
    runs: tuple[tuple[str, list[Rgb], Fov], ...] = (
        ("none", eyes, "auto"), ("disc", cut, "auto"), ("disc", cut, "all")
    )  # fmt: skip
    for name, (left, right), fov in runs:
        clip = isp.read_clip(left, right, calibration=recording.calibration.model_dump(mode="json"), masks=~tissue)
        scene = isp.reconstruct(clip, method="fast", iterations=options.iterations, holdout=HOLDOUT, fov=fov)
        judged = tissue & (away_px < -RIM_PX - MARGIN_PX)
        row: dict[str, Any] = {"clip": source.name, "cut": name, "fov": fov, "iterations": options.iterations}
        row |= judged_views(scene, eyes[0], judged, away_px > MARGIN_PX) | described(scene.report)
        found.append(row | {"machine": machine(), "commit": commit()})
        print("  ".join(f"{each} {found[-1][each]}" for each in FIELDS[:-2]), flush=True)
    write_rows(options.out, FIELDS, found)


def darkened(rgb: Rgb, light: NDArray[np.float32], seed: int) -> Rgb:
    """Frames [T, H, W, 3] under a gain [H, W, 1], with noise where it is 0."""
    noise = np.random.default_rng(seed)
    outside = 1 - light
    return np.stack(
        [
            np.clip(frame * light + outside * noise.normal(0, NOISE_LEVELS, frame.shape), 0, 255).astype(np.uint8)
            for frame in rgb
        ]
    )


def judged_views(
    scene: isp.Scene, truth: Rgb, judged: NDArray[np.bool_], outside: NDArray[np.bool_]
) -> dict[str, float]:
    """The held-out score over the pixels `judged` [T, H, W], and the claims in the pixels `outside` [H, W]."""
    errors, confident, unseen = [], [], []
    for index in held_out_frames(len(truth), HOLDOUT):
        view = scene.render(t=index / len(truth), light="recorded", smoke="show")
        errors.append(np.square(view.rgb.astype(np.float64) - truth[index])[judged[index]].mean())
        confident.append((view.confidence[outside] >= CONFIDENT).mean())
        unseen.append(view.unseen[outside].mean())
    return {
        "psnr_in_disc_db": round(float(np.mean(10 * np.log10(255**2 / np.array(errors)))), 2),
        "outside_confident": round(float(np.mean(confident)), 4),
        "outside_unseen": round(float(np.mean(unseen)), 4),
    }


def described(report: isp.Report) -> dict[str, object]:
    """The row's values from the report."""
    field = report.field_of_view
    assert field is not None
    return {
        "psnr_tissue_db": round(report.psnr_tissue_db or 0.0, 2),
        "psnr_right_db": round(report.psnr_right_db or 0.0, 2),
        "field_share": round(field.share, 4),
        "field_shape": field.shape,
        "gaussians": report.gaussians,
        "t_post_s": round(report.seconds["t_post_s"], 1),
    }


if __name__ == "__main__":
    main()
