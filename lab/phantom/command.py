"""`python -m lab phantom`: the command that writes a synthetic clip."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from intrasplat.errors import InputError
from lab.phantom.scene import make_phantom
from lab.phantom.settings import CAMERA_PATHS, MOTIONS, TOOLS, PhantomSettings
from lab.phantom.writers import write_endonerf, write_stereo_video, write_stereomis

WRITERS = {"video": write_stereo_video, "stereomis": write_stereomis, "endonerf": write_endonerf}


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `phantom`, which run_cli reads."""
    default = PhantomSettings()
    parser.add_argument("--motion", choices=MOTIONS, default=default.motion, help="how the tissue moves (%(default)s)")
    parser.add_argument("--frames", type=int, default=default.frames, help="frames of the clip (%(default)s)")
    parser.add_argument("--width", type=int, default=default.width, help="width of one eye in pixels (%(default)s)")
    parser.add_argument("--height", type=int, default=default.height, help="height of one eye in pixels (%(default)s)")
    parser.add_argument("--seed", type=int, default=default.seed, help="seed of the tissue and the noise (%(default)s)")
    parser.add_argument(
        "--tools", nargs="+", choices=TOOLS, default=default.tools, help="up to three instruments (grasper)"
    )
    parser.add_argument("--no-tools", dest="tools", action="store_const", const=(), help="draw no instrument")
    parser.add_argument("--no-masks", action="store_true", help="write no masks of the instruments; the truth has them")
    parser.add_argument("--no-noise", action="store_true", help="add no sensor noise")
    parser.add_argument(
        "--camera",
        nargs="+",
        choices=CAMERA_PATHS,
        default=default.camera,
        metavar="PATH",
        help=f"paths that the endoscope follows, all at once: {', '.join(CAMERA_PATHS)} (none: it is fixed). "
        "A clip in --format endonerf has the poses; the others have them as truth alone",
    )
    parser.add_argument(
        "--format",
        choices=sorted(WRITERS),
        default="video",
        help="video: VP9 side by side, calibration, masks; stereomis: frames as PNG; "
        "endonerf: frames, depth, poses. Each has the exact truth in the folder truth (%(default)s)",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write into; new or empty")


def run_cli(args: argparse.Namespace) -> int:
    """Write the clip and return the exit code. InputError for a bad setting or a folder that is not empty."""
    out: Path = args.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("out", f"{out} exists and is not an empty folder.", "Name a new folder.")
    settings = PhantomSettings(
        width=args.width,
        height=args.height,
        frames=args.frames,
        motion=args.motion,
        seed=args.seed,
        tools=tuple(args.tools),
        noise=not args.no_noise,
        camera=tuple(args.camera),
    )
    on_frame = _show_progress if sys.stderr.isatty() else _show_nothing
    WRITERS[args.format](make_phantom(settings), out, on_frame, masks=not args.no_masks)
    print(f"{settings.frames} frames of {settings.width}x{settings.height} ({settings.moves}) are in {out}")
    return 0


def _show_progress(done: int, frames: int) -> None:
    print(f"\rframe {done}/{frames}", end="\n" if done == frames else "", file=sys.stderr, flush=True)


def _show_nothing(done: int, frames: int) -> None:
    del done, frames
