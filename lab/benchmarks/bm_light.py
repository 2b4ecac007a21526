"""What `fast` makes of stereo clips with smoke or drops before both eyes, or with exposure or colours that change.

    python -m lab.benchmarks.bm_light [--clips d4d_stereo ...] [--lights none smoke exposure ...]
        [--iterations 300 | --budget-s 60] [--out lab/rows/light.csv]

Each clip is matched once as it is, which gives the truth: its frames, masks and depth. Then each of LIGHTS is put on
both eyes, and the result is read, matched and trained on like any recording. Scores of held-out frames over tissue,
of the model alone, each in dB, of the left eye and (right_) of the right:

plain     the view in the model's steady light against the clean frames
fitted    the same after one fit of gain and offset by channel over all held-out frames
by_frame  the same after a fit for each frame
recorded  the view in the light of the recording against the frames as they were given

A row is kept as its run ends, in place of an older one of the same clip, light and limit.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import intrasplat as isp
from intrasplat.clip import DepthClip, held_out_frames
from intrasplat.clip.types import Eye
from intrasplat.errors import InputError
from intrasplat.machine.hooks import Hooks
from lab.conditions.exposure import with_drift, with_tint
from lab.conditions.lens import with_splash
from lab.conditions.smoke import with_haze, with_smoke
from lab.evaluate.fitted import fitted_db, plain_db
from lab.evaluate.length import add_length, length_of
from lab.evaluate.rows import adding_alone, commit, machine, replace_row, texts_of
from lab.evaluate.sources import DATA_VARIABLE, Source, open_source, source_of

HOLDOUT = "every8"
CLIPS = ("d4d_stereo", "phantom:breathing:60frames:stereo", "phantom:pull:60frames:stereo")
LIGHTS: dict[str, tuple[float, Callable[[DepthClip, float, np.random.Generator], DepthClip]]] = {
    "none": (0.0, lambda clip, *_: clip),
    "smoke": (0.35, with_smoke),
    "haze": (0.35, with_haze),
    "exposure": (1.5, with_drift),
    "white_balance": (1.3, with_tint),
    "splash": (0.1, with_splash),
}
"""Levels as in lab/conditions/, and what puts each on a clip."""
KEY = ("clip", "light", "level", "limit")
SCORES = ("plain_db", "fitted_db", "by_frame_db", "recorded_db")
FIELDS = (
    *KEY, *SCORES, *(f"right_{name}" for name in SCORES), "reported_db", "iterations", "t_post_s", "codes", "machine",
    "commit",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    os.environ.setdefault(DATA_VARIABLE, "../shared/data")
    limit, spelt = length_of(options)
    with adding_alone(options.out.parent):
        for source in map(source_of, options.clips):
            clean = open_source(source, HOLDOUT, Hooks()).clip
            for light in options.lights:
                row = {"clip": source.name, "light": light, "level": LIGHTS[light][0], "limit": spelt}
                row |= measured(source, clean, light, limit) | {"machine": machine(), "commit": commit()}
                text = texts_of(row, FIELDS)
                replace_row(options.out, FIELDS, KEY, text)
                print("  ".join(f"{name} {text[name]}" for name in FIELDS[:-2]), flush=True)


def measured(source: Source, clean: DepthClip, light: str, limit: dict[str, Any]) -> dict[str, object]:
    """The scores of a clip in one of LIGHTS. InputError if the clip has one eye."""
    if clean.right is None:
        raise InputError("--clips", f"{source.argument} is of one eye.", "Name stereo clips.")
    level, spoil = LIGHTS[light]
    spoilt = spoil(clean, level, np.random.default_rng(0))
    assert spoilt.right is not None
    calibration: Any = source.files.get("calibration")
    if source.phantom is not None:
        calibration = source.phantom.calibration.model_dump(mode="json")
    times_s, masks = clean.frame_times_s, ~clean.tissue
    clip = isp.read_clip(spoilt.rgb, spoilt.right.rgb, calibration=calibration, masks=masks, frame_times_s=times_s)
    scene = isp.reconstruct(clip, method="fast", holdout=HOLDOUT, **limit)
    report = scene.report
    right = {f"right_{name}": value for name, value in scores(scene, clean.right, spoilt.right, is_right=True).items()}
    return (
        scores(scene, clean, spoilt)
        | right
        | {
            "reported_db": report.psnr_tissue_db,
            "iterations": report.iterations,
            "t_post_s": report.seconds["t_post_s"],
            "codes": " ".join(f"{each.severity}:{each.code}" for each in report.warnings),
        }
    )


def scores(scene: isp.Scene, clean: Eye, spoilt: Eye, *, is_right: bool = False) -> dict[str, float]:
    """SCORES of an eye."""
    steady, recorded = [], []
    for index in held_out_frames(clean.frame_count, HOLDOUT):
        pose, camera = scene.world_from_camera[index], scene.intrinsics
        if is_right:
            eye = scene.report.right_eye
            assert eye is not None
            pose = pose @ np.reshape(eye.left_from_right, (4, 4))
            camera = replace(camera, fx=eye.fx_px, fy=eye.fy_px, cx=eye.cx_px, cy=eye.cy_px)
        t, tissue = index / clean.frame_count, clean.tissue[index]
        clear = scene.render(t, pose, intrinsics=camera, detail="off")
        as_recorded = scene.render(t, pose, intrinsics=camera, light="recorded", smoke="show", detail="off")
        views = [clear.rgb, as_recorded.rgb]
        steady.append((views[0], clean.rgb[index], tissue))
        recorded.append((views[1], spoilt.rgb[index], tissue))
    by_frame = float(np.mean([fitted_db([view]) for view in steady]))
    found = plain_db(steady), fitted_db(steady), by_frame, plain_db(recorded)
    return {name: round(value, 2) for name, value in zip(SCORES, found, strict=True)}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=list(CLIPS))
    parser.add_argument("--lights", nargs="+", choices=list(LIGHTS), default=list(LIGHTS))
    add_length(parser)
    parser.add_argument("--out", type=Path, default=Path("lab/rows/light.csv"))
    return parser


if __name__ == "__main__":
    main()
