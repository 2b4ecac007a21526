"""`intrasplat poses`: estimates the path of a stereo clip's camera, and compares it with a known one."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from contract.runtime.arguments import add_options, given_options
from contract.runtime.exits import ExitCode
from contract.runtime.progress_bar import ProgressBar
from contract.wire.errors import InputError
from contract.wire.notices import NoticeCode
from contract.wire.options import ReconstructionOptions

OPTIONS = (
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
"""Those of reconstruct that decide on poses."""


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `poses`; run_cli reads them."""
    parser.add_argument("clip", type=Path, metavar="CLIP", help="as for reconstruct")
    parser.add_argument(
        "right", type=Path, metavar="RIGHT", nargs="?", help="the right eye, if it is a file of its own"
    )
    parser.add_argument("--calibration", type=Path, metavar="F", help="as for reconstruct")
    parser.add_argument("--masks", type=Path, metavar="F", help="as for reconstruct")
    parser.add_argument(
        "--against", type=Path, metavar="TUM", help="the true path: prints the absolute trajectory error against it"
    )
    parser.add_argument("--out", type=Path, metavar="TUM", help="file to write the path to, in seconds and metres")
    add_options(parser, ReconstructionOptions, *OPTIONS)
    parser.set_defaults(**{name: None for name in ReconstructionOptions.model_fields if name not in OPTIONS})


def run_cli(options: argparse.Namespace) -> int:
    """Estimates, prints, writes. Returns the exit code.

    Raises:
        InputError: the clip, an option or the true path cannot be used.
    """
    from worker.daemon.orders import job_progress
    from worker.input.decode import keep_decoder_ready
    from worker.machine.hooks import Hooks
    from worker.machine.timing import Timings
    from worker.poses import with_poses
    from worker.poses.trajectory import at_times, from_first, read_tum, trajectory_error, write_tum
    from worker.stereo import ClipPaths, open_with_depth

    true = read_tum(options.against) if options.against else None
    given, timings = given_options(options, ReconstructionOptions), Timings()
    keep_decoder_ready()
    with ProgressBar(sys.stderr) as bar:
        hooks = Hooks(on_progress=lambda now: bar.show(job_progress(now)))
        paths = ClipPaths(options.clip, options.right, options.calibration, options.masks)
        clip = with_poses(open_with_depth(paths, given, hooks, timings), given, hooks, timings)
    told = clip.poses
    assert told is not None
    for notice in clip.assumptions:
        if notice.code is NoticeCode.POSES:
            print(notice.text)
    for notice in clip.warnings:
        print(f"{notice.severity}: {notice.text}")
    if options.out is not None:
        write_tum(options.out, clip.frame_times_s, clip.world_from_camera)
    if true is not None:
        times_s, poses = true
        if len(poses) != clip.frame_count:
            first_s = clip.frame_times_s + times_s[0]
            if first_s[-1] > times_s[-1] + 1:
                problem = f"{options.against} ends before the clip does."
                raise InputError("--against", problem, "Give the path of this clip.")
            poses = at_times(times_s, poses, first_s)
        error = trajectory_error(clip.world_from_camera, from_first(poses))
        print(f"absolute trajectory error: {error.mm:.2f} mm, {error.deg:.2f} degrees")
    return ExitCode.OK
