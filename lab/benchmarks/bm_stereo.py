"""Depth from stereo: error on synthetic tissue; on real clips agreement with a reference, rows, seconds per frame.

    python -m lab.benchmarks.bm_stereo [--data FOLDER] [--repeats 3] [--device cuda] [--every 8]

With TRITON_INTERPRET=1 in the environment "cuda" needs no GPU and takes half a minute a pair: accuracy, not speed.
FOLDER (INTRASPLAT_DATA, else ../shared/data) holds `d4d_stereo` and `d4d_endonerf` (one recording, as stereo video and
as frames with another group's stereo depth, 1 mm steps) and `surgt_raw` (unrectified, with an OpenCV YAML).
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, StereoClip, open_clip
from intrasplat.clip.calibration import RectifiedClip, load_calibration, rectify
from intrasplat.clip.features import find_features
from intrasplat.options import ClipOptions
from intrasplat.stereo import estimate_depth
from intrasplat.stereo.alignment import match_features, measure_row_shift
from lab.evaluate.rows import commit
from lab.phantom import PhantomSettings, make_phantom

ROW_CHECKED_PAIRS = 5
SYNTHETIC = PhantomSettings(width=320, height=256, frames=2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("INTRASPLAT_DATA", "../shared/data")))
    parser.add_argument("--repeats", type=int, default=3, help="timed runs a clip; the fastest is printed")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where pairs are matched")
    parser.add_argument("--every", type=int, default=1, help="only each so manieth pair is matched")
    arguments = parser.parse_args()
    print(f"machine {platform.processor() or platform.machine()}, {os.cpu_count()} cores; commit {commit()}")
    every, matched = arguments.every, partial(estimate_depth, device=arguments.device)
    _print_truth(matched)
    missing = [name for name in ("d4d_stereo", "d4d_endonerf", "surgt_raw") if not (arguments.data / name).exists()]
    if missing:
        print(f"nothing else measured: {arguments.data} lacks {', '.join(missing)}")
        return
    d4d = arguments.data / "d4d_stereo"
    clip = thinned(_rectified(d4d / "stereo_sbs.mp4", d4d / "calibration.json", d4d / "tool_masks.zip"), every)
    depth = _timed("d4d_stereo", clip, matched, arguments.repeats)
    reference = open_clip(arguments.data / "d4d_endonerf")
    assert isinstance(reference, DepthClip)
    _print_agreement(depth, reference, every)
    surgt = arguments.data / "surgt_raw"
    clip = thinned(_rectified(surgt / "video.mp4", surgt / "calibration.yaml", None), every)
    depth = _timed("surgt_raw", clip, matched, arguments.repeats)
    _print_rows(clip)


def _print_truth(matched: Callable[[RectifiedClip], DepthClip]) -> None:
    """|depth - truth| in mm over the tissue of a synthetic clip."""
    phantom = make_phantom(SYNTHETIC)
    frames = [phantom.frame(i) for i in range(SYNTHETIC.frames)]
    truth, tissue = np.stack([each.depth_mm for each in frames]), np.stack([each.tissue for each in frames])
    times_s = np.arange(len(frames)) / SYNTHETIC.frame_rate_hz
    pairs = [(each.left, each.right) for each in frames]
    clip = RectifiedClip(
        len(frames), SYNTHETIC.intrinsics, SYNTHETIC.baseline_mm, 0.0, lambda: iter(pairs), tissue, times_s
    )
    depth_mm = matched(clip).depth_mm
    valid = tissue & (truth > 0) & (depth_mm > 0)
    median, high, highest = np.percentile(np.abs(depth_mm - truth)[valid], [50, 90, 99])
    print(f"synthetic: {len(frames)} frames of {SYNTHETIC.width}x{SYNTHETIC.height}, {SYNTHETIC.motion}")
    print(f"  |depth - truth|: median {median:.2f} mm, 90th percentile {high:.2f} mm, 99th {highest:.2f} mm")
    print(f"  valid on {valid.sum() / tissue.sum():.1%} of tissue")


def _rectified(video: Path, calibration: Path, masks: Path | None) -> RectifiedClip:
    clip = open_clip(video, masks=masks, options=ClipOptions(layout="sbs", mask_polarity="tool" if masks else "auto"))
    assert isinstance(clip, StereoClip)
    return rectify(clip, load_calibration(calibration, eye_width=clip.width, eye_height=clip.height))


def thinned(clip: RectifiedClip, every: int) -> RectifiedClip:
    """Every `every`-th frame of a clip."""
    kept = range(0, clip.frame_count, every)
    return replace(
        clip,
        frame_count=len(kept),
        pairs=lambda: islice(clip.pairs(), None, None, every),
        tissue=clip.tissue[::every],
        frame_times_s=clip.frame_times_s[::every],
    )


def _timed(name: str, clip: RectifiedClip, matched: Callable[[RectifiedClip], DepthClip], repeats: int) -> DepthClip:
    """Estimate depth and print the fastest run's seconds per frame, decoding and rectification included."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter(), time.process_time()
        depth = matched(clip)
        seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    size = f"{clip.intrinsics.width}x{clip.intrinsics.height}"
    wall_s, cpu_s = min(seconds)
    print(f"{name}: {clip.frame_count} frames of {size} in {wall_s:.2f} s, {wall_s / clip.frame_count:.4f} s per frame")
    print(f"  {cpu_s / clip.frame_count:.4f} CPU seconds per frame, the figure to compare on a busy machine")
    print("  " + ", ".join(f"{key} {value:.3f}" for key, value in depth.measurements.items()))
    for warning in depth.warnings:
        print(f"  warning: {warning.text}")
    return depth


def _print_agreement(depth: DepthClip, reference: DepthClip, every: int) -> None:
    """|difference| to the reference in mm over tissue where both are valid, at the reference's size."""
    height, width = reference.depth_mm.shape[1:]
    differences, valid = [], []
    others = zip(reference.depth_mm[::every], reference.tissue[::every], strict=True)
    for ours, (theirs, tissue) in zip(depth.depth_mm, others, strict=True):
        resized = cv2.resize(ours, (width, height), interpolation=cv2.INTER_NEAREST)
        differences.append(np.abs(resized - theirs)[(resized > 0) & (theirs > 0) & tissue])
        valid.append((resized > 0)[tissue].mean())
    all_mm: NDArray[np.float32] = np.concatenate(differences)
    median_mm, high_mm, highest_mm = np.percentile(all_mm, [50, 90, 99])
    print(
        f"  |depth - reference|: median {median_mm:.2f} mm (target 1.5), 90th percentile {high_mm:.2f} mm (target 5), "
        f"99th {highest_mm:.2f} mm"
    )
    print(f"  valid on {np.mean(valid):.1%} of tissue (target 90 %)")


def _print_rows(clip: RectifiedClip) -> None:
    """Median |dy| of inlier matches after rectification; vertical_residual_px is that after what the stage corrects."""
    step = max(1, clip.frame_count // ROW_CHECKED_PAIRS)
    found = []
    for left, right in (pair for i, pair in enumerate(clip.pairs()) if i % step == 0):
        greys = [cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY) for eye in (left, right)]
        found.append(match_features(*(find_features(eye, max_width_px=left.shape[1]) for eye in greys)))
    matches = np.concatenate(found)
    off_px = matches[:, 3] - matches[:, 1]
    inliers = np.abs(off_px - measure_row_shift(matches, clip.disparity_offset_px).shift_px) < 2.0
    print(f"  median |dy| rectified: {np.median(np.abs(off_px[inliers])):.3f} px over {inliers.sum()} matches")


if __name__ == "__main__":
    main()
