"""`intrasplat poses`: estimate the path of a stereo clip's camera, and compare it with a known one."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from intrasplat.commands.arguments import add_options, given_options
from intrasplat.commands.exits import ExitCode
from intrasplat.commands.progress_bar import ProgressBar
from intrasplat.errors import InputError
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions

OPTIONS = (
    "fov",
    "layout",
    "mask_polarity",
    "mask_source",
    "pose_convention",
    "holdout",
    "use_frames",
    "poses",
    "min_depth_mm",
    "max_depth_mm",
)
"""The options of `reconstruct` that affect poses."""


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `poses`; run_cli reads them."""
    parser.add_argument("clip", type=Path, metavar="CLIP", help="as for reconstruct")
    parser.add_argument(
        "right", type=Path, metavar="RIGHT", nargs="?", help="the right eye, if it is a file of its own"
    )
    parser.add_argument("--calibration", type=Path, metavar="F", help="as for reconstruct")
    parser.add_argument("--masks", type=Path, metavar="F", help="as for reconstruct")
    parser.add_argument("--fov-mask", type=Path, metavar="F", help="as for reconstruct")
    parser.add_argument("--poses-file", type=Path, metavar="F", help="as for reconstruct")
    parser.add_argument("--segmenter", type=Path, metavar="F", help="as for reconstruct")
    parser.add_argument(
        "--against",
        type=Path,
        metavar="TUM",
        help="the true path, with a pose for each frame or beginning with the clip: prints the absolute trajectory "
        "error against it",
    )
    parser.add_argument("--out", type=Path, metavar="TUM", help="file to write the path to, in seconds and metres")
    add_options(parser, ReconstructionOptions, *OPTIONS)
    parser.set_defaults(**{name: None for name in ReconstructionOptions.model_fields if name not in OPTIONS})


def run_cli(options: argparse.Namespace) -> int:
    """Estimate the path, print and write it, and return the exit code.

    Raises:
        InputError: the clip, an option or the true path cannot be used.
    """
    from intrasplat.decode import keep_decoder_ready
    from intrasplat.machine.hooks import Hooks
    from intrasplat.machine.timing import Timings
    from intrasplat.poses import read_poses, with_poses
    from intrasplat.poses.agreement import Convention, likely_unit
    from intrasplat.poses.pose_file import poses_of_frames
    from intrasplat.poses.trajectory import trajectory_error, write_tum
    from intrasplat.stereo import ClipPaths, open_with_depth

    out: Path | None = options.out
    if out is not None and (out.is_dir() or not os.access(out if out.exists() else out.parent, os.W_OK)):
        raise InputError("--out", f"{out} cannot be written.", "Name a file in a folder that is there.")
    known = read_poses(options.against, "--against") if options.against else None
    stored = read_poses(options.poses_file) if options.poses_file else None
    given, timings = given_options(options, ReconstructionOptions), Timings()
    keep_decoder_ready()
    with ProgressBar(sys.stderr) as bar:
        hooks = Hooks(on_progress=bar.show)
        paths = ClipPaths(options.clip, options.right, options.calibration, options.masks, options.fov_mask)
        clip = open_with_depth(paths, given, hooks, timings, segmenter=options.segmenter)
        true = None if known is None else poses_of_frames(clip, known)
        clip = with_poses(clip, given, hooks, timings, stored)
    for notice in clip.assumptions:
        if notice.code is NoticeCode.POSES:
            print(notice.text)
    for notice in clip.warnings:
        print(f"{notice.severity}: {notice.text}")
    if out is not None:
        write_tum(out, clip.frame_times_s, clip.world_from_camera)
    if true is not None:
        is_tum = known is not None and known.stamps is not None
        unit = likely_unit(true) if is_tum else "mm"
        if is_tum and unit == "mm":
            print(f"{options.against}: its positions are in mm, not in metres: a factor of 1000")
        error = trajectory_error(clip.world_from_camera, Convention(unit).world_from_camera(true))
        print(f"absolute trajectory error: {error.mm:.2f} mm, {error.deg:.2f} degrees")
    return ExitCode.OK
