"""What detail from the recorded training frames adds to views, and what it costs.

    python -m lab.benchmarks.bm_detail [--clips d4d_stereo phantom:pull:60frames:stereo ...] [--preset fast]
        [--iterations 300 | --budget-s 60] [--holdout every8] [--seeds 0 1 2] [--out lab/rows/detail.csv]
        [--picture FILE.jpg]

A row for each view: `left` and `right`, held-out frames of the eyes over tissue, and of a phantom at rest or with a
fixed camera `off5` to `off20`, that many degrees beside the endoscope, over tissue that some training frame saw, and
`hidden`, what an instrument hides from the left eye. model_db and detail_db: mean psnr_tissue without and with detail,
of views as the service renders them. The rows of the left eye also have ssim without and with detail, the two scores of
copying (docs/conventions.md), bytes of the scene, of recorded.zip and of detail.mkv, seconds until the scene was done,
and milliseconds of a view without detail, with it, and with it in a clip that is played frame by frame (medians).

A row is kept as its run ends, in place of an older one of the same clip, preset, limit, seed and view; then the chart
is drawn beside them. --picture: a sheet of the last run, at its middle held-out frame and 0, 3, 8 and 15 degrees beside
it: the truth of a phantom, the model alone, and with detail. Pictures of a patient do not belong into the repository.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, split_frames
from intrasplat.machine.hooks import Hooks
from intrasplat.names import DETAIL, RECORDED
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.report import Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.scoring import judged_pixels
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.render import render_frame
from lab.benchmarks.bm_off_axis import small
from lab.evaluate.length import add_length, length_of
from lab.evaluate.rows import adding_alone, commit, machine, read_rows, replace_row, texts_of
from lab.evaluate.sources import DATA_VARIABLE, OpenClip, open_source, source_of
from lab.evaluate.truth import Expected, Truth
from lab.pages.detail import draw_detail

CLIPS = ("d4d_stereo", *(f"phantom:{motion}:60frames:stereo" for motion in ("still", "breathing", "pull", "cut")))
ANGLES_DEG = (5.0, 10.0, 15.0, 20.0)
SHOWN_DEG = (0.0, 3.0, 8.0, 15.0)
TIMED = 25
KEY = ("clip", "preset", "limit", "holdout", "seed", "view")
FIELDS = (
    *KEY, "model_db", "detail_db", "ssim", "detail_ssim", "copy_blend_db", "copy_flow_db", "scene_bytes",
    "recorded_bytes", "detail_bytes", "t_post_s", "view_ms", "detail_ms", "played_ms", "machine", "commit",
)  # fmt: skip

Pair = tuple[float, float]


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    os.environ.setdefault(DATA_VARIABLE, "../shared/data")
    limit, spelt = length_of(options)
    with adding_alone(options.out.parent):
        for source in map(source_of, options.clips):
            opened = open_source(source, options.holdout, Hooks())
            for seed in options.seeds:
                named = {"clip": source.name, "preset": options.preset, "limit": spelt, "holdout": options.holdout}
                asked = ReconstructionOptions(preset=options.preset, seed=seed, holdout=options.holdout, **limit)
                for found in measured(opened, asked, options.picture):
                    row = {**named, "seed": seed, **found, "machine": machine(), "commit": commit()}
                    text = texts_of(row, FIELDS)
                    replace_row(options.out, FIELDS, KEY, text)
                    print("  ".join(f"{name} {text[name]}" for name in FIELDS[:-2] if text[name]), flush=True)
    draw_detail(read_rows(options.out), options.out.parent)


def measured(
    opened: OpenClip, options: ReconstructionOptions, picture: Path | None = None
) -> Iterator[dict[str, object]]:
    """The rows of one run; its sheet goes into the file `picture`."""
    with TemporaryDirectory() as folder:
        path = Path(folder)
        request = ReconstructionRequest(clip=opened.clip, options=options)
        report, scene = reconstruct(request, path, TrainingHooks()), load_scene(path)
        left = _row("left", list(_recorded(scene, opened.clip, report)))
        yield left | _costs(scene, path, report)
        if opened.clip.right is not None:
            yield _row("right", list(_recorded(scene, opened.clip, report, is_right=True)))
        if opened.phantom is not None and not opened.phantom.settings.camera:
            yield from _off_axis(scene, opened)
        if picture is not None:
            cv2.imwrite(str(picture), sheet(scene, opened, report)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])


def sheet(scene: TrainedScene, opened: OpenClip, report: Report) -> NDArray[np.uint8]:
    """[h, w, 3] a row for each angle beside the endoscope."""
    frame = report.held_out[len(report.held_out) // 2]
    pivot_mm, rows = MEDIAN_DEPTH_UNITS / scene.units_per_mm, []
    for angle_deg in SHOWN_DEG:
        orbit = world_from_camera(OrbitPose(yaw_deg=angle_deg, pitch_deg=0.0, zoom=1.0), pivot_mm)
        pose = scene.world_from_camera[frame] @ np.array(orbit, np.float64)
        shown = [render_frame(scene, frame / scene.frame_count, pose, detail=each).rgb for each in ("off", "on")]
        if opened.phantom is not None:
            true = np.clip(opened.phantom.render(frame, pose)[0], 0, 1) * np.float32(255)
            shown = [true.astype(np.uint8), *shown]
        rows.append(np.concatenate([small(each) for each in shown], axis=1))
    return np.concatenate(rows)


def _row(view: str, pairs: Sequence[Pair]) -> dict[str, object]:
    model, detail = np.nanmean(np.array(pairs), axis=0)
    return {"view": view, "model_db": round(model, 2), "detail_db": round(detail, 2)}


def _recorded(scene: TrainedScene, clip: DepthClip, report: Report, *, is_right: bool = False) -> Iterator[Pair]:
    """Scores of the held-out frames of an eye, without and with detail."""
    eye = clip.right if is_right and clip.right is not None else clip
    left_from_eye = np.linalg.inv(clip.world_from_camera[0]) @ eye.world_from_camera[0]
    for index in report.held_out:
        pixels = judged_pixels(eye, index) if is_right else eye.tissue[index]
        shown = (
            render_frame(
                scene, index / scene.frame_count, scene.world_from_camera[index] @ left_from_eye, eye.intrinsics,
                light="recorded", smoke="show", detail=detail,
            ).rgb
            for detail in ("off", "on")
        )  # fmt: skip
        model_db, detail_db = (psnr_tissue(rgb, eye.rgb[index], pixels) for rgb in shown)
        yield model_db, detail_db


def _off_axis(scene: TrainedScene, opened: OpenClip) -> Iterator[dict[str, object]]:
    """Rows of a phantom's views beside the endoscope, and of what an instrument hides."""
    assert opened.phantom is not None
    split = split_frames(opened.clip, "every8")
    truth = Truth(
        opened.phantom, opened.tissue, split.train, split.held_out, opened.tissue_right, angles_deg=ANGLES_DEG
    )
    for angle_deg, views in truth.off_axis.items():
        yield _row(f"off{angle_deg:g}", [_scores(scene, each) for each in views])
    yield _row("hidden", [_scores(scene, each) for each in truth.hidden])


def _scores(scene: TrainedScene, expected: Expected) -> Pair:
    t = expected.frame / scene.frame_count
    model, detail = (render_frame(scene, t, expected.pose, detail=each).rgb for each in ("off", "on"))
    return psnr_tissue(model, expected.rgb, expected.judged), psnr_tissue(detail, expected.rgb, expected.judged)


def _costs(scene: TrainedScene, folder: Path, report: Report) -> dict[str, object]:
    middle = (scene.frame_count // 2 + 0.5) / scene.frame_count
    return {
        "ssim": report.ssim,
        "detail_ssim": None if report.detail is None else report.detail.ssim,
        "copy_blend_db": report.baseline_blend_db,
        "copy_flow_db": report.baseline_flow_db,
        "scene_bytes": report.scene_bytes,
        "recorded_bytes": (folder / RECORDED).stat().st_size,
        "detail_bytes": (folder / DETAIL).stat().st_size,
        "t_post_s": report.seconds["t_post_s"],
        "view_ms": _median_ms(scene, [middle] * TIMED, is_detailed=False),
        "detail_ms": _median_ms(scene, [middle] * TIMED, is_detailed=True),
        "played_ms": _median_ms(scene, [i / scene.frame_count for i in range(scene.frame_count)], is_detailed=True),
    }


def _median_ms(scene: TrainedScene, times: Sequence[float], *, is_detailed: bool) -> float:
    found = []
    for t in [times[0], *times]:
        start_s = time.perf_counter()
        render_frame(scene, t, detail="on" if is_detailed else "off")
        found.append(1e3 * (time.perf_counter() - start_s))
    return round(median(found[1:]), 1)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=list(CLIPS))
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--holdout", default="every8")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    add_length(parser)
    parser.add_argument("--out", type=Path, default=Path("lab/rows/detail.csv"))
    parser.add_argument("--picture", type=Path, metavar="FILE.jpg")
    return parser


if __name__ == "__main__":
    main()
