"""How well are instruments found in clips without masks, what does it cost, and what does the model lose?

    python -m lab.benchmarks.bm_masks [--seeds 11 12] [--frames 64] [--size 640x512] [--iterations 300] [--out
        masks.csv]
        [--places moving rests lies inside small]

Draws stereo clips of each kind of instrument and of none, withholds their masks and finds them (`--mask-source auto`).
--places: the instrument moves above the tissue, rests there, lies on the tissue, hovers wholly inside the picture, or
is small: only its jaws are in view. `told`: the notices that say that instruments may not be masked.
Prints and writes of each: intersection over union with the true masks, over all frames and in the worst one; the share
of true instruments that is found and of found ones that is true; the shares of the picture that are true and found; how
sure the report is; and the seconds of one core that finding takes in all frames. With --iterations it trains `fast`
with the true masks and with those found, and scores held-out frames of both eyes (psnr_tissue), over the tissue of the
true masks, and over what both masks take for tissue (`_in_both`): what is masked and never seen is a hole. With
INTRASPLAT_DATA set, its recordings come last, those of d4d with their (approximate) masks as truth.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, StereoClip, training_frames
from intrasplat.instruments import Finder, FoundMask
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import Notice, NoticeCode
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import make, score_scene
from intrasplat.quality.checks import clip_warnings
from intrasplat.report import Report
from intrasplat.stereo import ClipPaths, match_eyes, open_with_depth
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from lab.benchmarks.bm_poses import write
from lab.evaluate.rows import commit
from lab.phantom import TOOLS, PhantomSettings, instrument, make_phantom

HOLDOUT = "every8"
TELLING = (NoticeCode.MASKS_UNSURE, NoticeCode.NO_INSTRUMENT_MASKED)


@dataclass(frozen=True, eq=False)
class Opened:
    """A clip with its own masks (None if it has none), the same with found masks, and the seconds of finding them."""

    given: DepthClip | None
    found: DepthClip
    cost_s: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", nargs="+", default=["breathing", "pull"])
    parser.add_argument("--tools", nargs="*", default=[*TOOLS, "none"])
    parser.add_argument("--places", nargs="+", choices=[*PLACES], default=["moving"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[11])
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--size", default="640x512")
    parser.add_argument("--iterations", type=int, default=0)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    rows: list[dict[str, object]] = []
    measured_at = commit()

    def add(name: str, opened: Opened) -> None:
        row = {"commit": measured_at, "clip": name, "frames": opened.found.frame_count, **measured(opened)}
        row |= compared(opened, arguments.iterations)
        rows.append(row)
        print("  ".join(f"{key} {value}" for key, value in row.items() if key != "commit"), flush=True)
        if arguments.out:
            write(arguments.out, rows)

    for motion, place in product(arguments.motions, arguments.places):
        for tools in arguments.tools:
            for seed in arguments.seeds:
                settings = PhantomSettings(
                    width=width,
                    height=height,
                    frames=arguments.frames,
                    motion=motion,
                    seed=seed,
                    tools=() if tools == "none" else tuple(tools.split("+")),
                )
                where = "" if place == "moving" else f":{place}"
                with patch.multiple(instrument, **PLACES[place](settings)):
                    add(f"phantom:{motion}:{width}x{height}:seed{seed}:{tools}{where}", drawn(settings))
    if os.environ.get("INTRASPLAT_DATA"):
        folder = Path(os.environ["INTRASPLAT_DATA"])
        for name, paths in recorded(folder).items():
            add(name, opened_files(paths))


def _at(u_mm: float, v_mm: float, above_mm: float) -> Callable[..., tuple[NDArray[np.float64], float]]:
    """An instrument whose tip stays above_mm above one point of the tissue."""
    return lambda surface, frame, settings: (surface.point_mm(u_mm, v_mm, 0.0) - (0.0, 0.0, above_mm), 0.2)


def _peeping(settings: PhantomSettings) -> dict[str, object]:
    camera, depth_mm = settings.intrinsics, 70.0
    right_mm, down_mm = (depth_mm * side / 2 / camera.fx for side in (camera.width, camera.height))
    tip_mm = np.array([0.8 * right_mm, 0.78 * down_mm, depth_mm])
    return {"_tip_and_opening": lambda *_: (tip_mm, 0.1)}


def _from(*port_mm: float) -> NDArray[np.float64]:
    return np.vstack([port_mm, instrument.PORTS_MM[1:]])


PLACES: Mapping[str, Callable[[PhantomSettings], dict[str, Any]]] = {
    "moving": lambda _: {"HOVER_MM": instrument.HOVER_MM},
    "rests": lambda _: {"_tip_and_opening": _at(4.0, 3.0, 3.0)},
    "lies": lambda _: {"_tip_and_opening": _at(8.0, -2.0, 1.0), "PORTS_MM": _from(110.0, 60.0, 68.0)},
    "inside": lambda _: {
        "_tip_and_opening": _at(-4.0, -6.0, 3.0),
        "PORTS_MM": _from(90.0, 60.0, 62.0),
        "SHAFT_MM": 26.0,
    },
    "small": _peeping,
}
"""Changes to the phantom's first instrument, by the name of its position."""


def recorded(folder: Path) -> dict[str, ClipPaths]:
    """The recordings of INTRASPLAT_DATA that have two eyes and a calibration, or depth."""
    d4d, surgt = folder / "d4d_stereo", folder / "surgt_raw"
    return {
        "d4d-a-stereo": ClipPaths(
            d4d / "stereo_sbs.mp4", calibration=d4d / "calibration.json", masks=d4d / "tool_masks.zip"
        ),
        "surgt_raw": ClipPaths(surgt / "video.mp4", calibration=surgt / "calibration.yaml"),
        "d4d-a": ClipPaths(folder / "d4d_endonerf"),
    }


def drawn(settings: PhantomSettings) -> Opened:
    """A phantom as a stereo clip."""
    recording = make_phantom(settings).stereo_recording()
    bare = replace(recording.clip, tissue=None, tissue_right=None)

    def opened(clip: StereoClip) -> DepthClip:
        return match_eyes(clip, recording.calibration, HOLDOUT, Hooks(), Timings(), mask_source="auto")

    with finding_timed() as spent_s:
        found = opened(bare)
    return Opened(opened(recording.clip), found, sum(spent_s))


def opened_files(paths: ClipPaths) -> Opened:
    """A recording."""

    def opened(paths: ClipPaths) -> DepthClip:
        return open_with_depth(paths, ReconstructionOptions(holdout=HOLDOUT, mask_source="auto"), Hooks(), Timings())

    with tempfile.TemporaryDirectory() as folder, finding_timed() as spent_s:
        bare = replace(paths, masks=None)
        if paths.clip.is_dir():  # its masks lie beside its frames
            for each in paths.clip.iterdir():
                if each.name != "masks":
                    (Path(folder) / each.name).symlink_to(each)
            bare = ClipPaths(Path(folder))
        found = opened(bare)
    has_masks = paths.masks is not None or paths.clip.is_dir()
    return Opened(opened(paths) if has_masks else None, found, sum(spent_s))


@contextmanager
def finding_timed() -> Iterator[list[float]]:
    """Collect the CPU seconds of finding instruments in each frame, during the context."""
    spent_s: list[float] = []
    find = Finder.__call__

    def timed(
        self: Finder, rgb: NDArray[np.uint8], nearness: Callable[[NDArray[np.uint8]], NDArray[np.float32]]
    ) -> FoundMask:
        began_s = time.thread_time()
        found = find(self, rgb, nearness)
        spent_s.append(time.thread_time() - began_s)
        return found

    with patch.object(Finder, "__call__", timed):
        yield spent_s


def measured(opened: Opened) -> dict[str, object]:
    """Compare the found masks with the given ones."""
    found = opened.found
    assert found.masks is not None
    used = [i for i in range(found.frame_count) if i not in found.skipped]
    row: dict[str, object] = {}
    if opened.given is not None:
        counts = np.array([_counts(~found.tissue[i], ~opened.given.tissue[i]) for i in used])
        both, either, one, other = counts.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            worst = np.nanmin(counts[:, 0] / counts[:, 1]) if either else 1.0
        row = {
            "iou": f"{both / either:.3f}" if either else "",
            "worst_iou": f"{worst:.3f}" if either else "",
            "recall": f"{both / other:.3f}" if other else "",
            "precision": f"{both / one:.3f}" if one else "",
            "true_share": f"{other / (len(used) * found.tissue[0].size):.4f}",
        }
    else:
        row = dict.fromkeys(("iou", "worst_iou", "recall", "precision", "true_share"), "")
    return row | {
        "found_share": f"{found.masks.share:.4f}",
        "sure": f"{found.masks.sure or 0:.2f}",
        "told": " ".join(each.code for each in doubts_of(found) if each.code in TELLING),
        "cost_s": f"{opened.cost_s:.2f}",
    }


def doubts_of(clip: DepthClip) -> Sequence[Notice]:
    """The warnings of the clip's report."""
    split = sorted(set(training_frames(clip.frame_count, HOLDOUT)) - set(clip.skipped))
    return [*clip.warnings, *clip_warnings(clip, split)]


def _counts(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    return int((one & other).sum()), int((one | other).sum()), int(one.sum()), int(other.sum())


def compared(opened: Opened, iterations: int) -> dict[str, object]:
    """Scores of models that were trained with the given masks and with those found, by what is counted as tissue."""
    names = [
        f"{name}_{eye}_db{where}"
        for name in ("given", "found")
        for where in ("", "_in_both")
        for eye in ("left", "right")
    ]
    if not iterations or opened.given is None or opened.given.right is None or opened.found.right is None:
        return dict.fromkeys(names, "")
    right = replace(opened.given.right, tissue=opened.given.right.tissue & opened.found.right.tissue)
    in_both = replace(opened.given, tissue=opened.given.tissue & opened.found.tissue, right=right)
    reports = [
        report for clip in (opened.given, opened.found) for report in trained(clip, (opened.given, in_both), iterations)
    ]
    scores = [score for report in reports for score in (report.psnr_tissue_db, report.psnr_right_db)]
    return {name: "" if score is None else f"{score:.2f}" for name, score in zip(names, scores, strict=True)}


def trained(clip: DepthClip, truths: Sequence[DepthClip], iterations: int) -> list[Report]:
    """The report of a model of `clip`, scored on the pixels that are tissue in each of `truths`."""
    options = ReconstructionOptions(holdout=HOLDOUT, iterations=iterations)
    with tempfile.TemporaryDirectory() as folder:
        made = make(ReconstructionRequest(clip, options, device="cpu"), Path(folder), TrainingHooks())
        return [score_scene(replace(made, clip=truth), TrainingHooks()) for truth in truths]


if __name__ == "__main__":
    main()
