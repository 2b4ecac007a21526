"""The `intrasplat` command.

reconstruct, render, phantom and doctor work on this machine, in a process of the worker's (`python -m worker ...`);
up starts a service; submit, watch and fetch talk to one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

from pydantic import ValidationError

from client.api import DEFAULT_URL, Client
from client.keys import add_keys
from contract.arguments import Commands, add_command, finite, positive
from contract.errors import InputError, IntrasplatError
from contract.exits import EXIT_CODES_HELP, ExitCode, exit_code_of
from contract.job import JobProgress, JobView, Layout, MaskPolarity, PoseConvention, PresetName
from contract.progress_bar import ProgressBar
from contract.settings import Settings, default_data_dir

LOCAL_COMMANDS = {
    "reconstruct": "train a scene from a clip, on this machine",
    "render": "render images of a scene that is on this machine",
    "phantom": "make a synthetic stereo clip of tissue",
    "doctor": "say what is installed, what would be used, what is missing",
}

EXAMPLES = """\
a clip on this machine:
  intrasplat reconstruct left.mp4 right.mp4 --calibration calibration.json --out scene
  intrasplat render scene --t 0.4 --pose orbit:10,0,1 --out view.png
through a service:
  intrasplat up
  intrasplat submit clip.mp4 --calibration calibration.json --watch
  intrasplat fetch JOB --out results
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in LOCAL_COMMANDS:
        return _run_local(arguments)
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except IntrasplatError as error:
        print(f"intrasplat: {error}", file=sys.stderr)
        return exit_code_of(error)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


def _run_local(arguments: list[str]) -> int:
    """Become the worker's program, with the command line unchanged: signals and exit status are its own."""
    command = [sys.executable, "-m", "worker", *arguments]
    if os.name == "posix":
        os.execv(sys.executable, command)
    process = subprocess.Popen(command)  # elsewhere whoever called does not wait for what a process has become
    while True:
        with contextlib.suppress(KeyboardInterrupt):  # it reaches both, and the worker decides
            return process.wait()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="intrasplat",
        description="Dynamic 3D Gaussians of tissue from a stereo endoscope clip. Research use only.",
        epilog=f"{EXAMPLES}\n{EXIT_CODES_HELP}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in LOCAL_COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)  # its own options are parsed by the worker
    _add_up(commands)
    _add_submit(commands)
    _add_watch(commands)
    _add_fetch(commands)
    add_keys(commands)
    return parser


def _add_up(commands: Commands) -> None:
    parser = add_command(commands, "up", "start a queue, the service and one worker on this machine", _up)
    parser.add_argument("--port", type=int, default=None, help="where the service answers (default: 8765)")
    parser.add_argument(
        "--data-dir", type=Path, help=f"where clips and scenes are kept (default: {default_data_dir()})"
    )


def _add_submit(commands: Commands) -> None:
    parser = add_command(commands, "submit", "send a clip to a service and print its job's id", _submit)
    parser.add_argument("clip", type=Path, metavar="INPUT", help="a video or a zip; both eyes, or the left one")
    parser.add_argument(
        "right", type=Path, metavar="RIGHT", nargs="?", help="the right eye, if it is a file of its own"
    )
    parser.add_argument("--calibration", type=Path, metavar="F", help="JSON, OpenCV YAML or XML, or ini")
    parser.add_argument("--masks", type=Path, metavar="F", help="zip of PNGs or a video that shows the instruments")
    parser.add_argument("--mask-polarity", choices=get_args(MaskPolarity), help="what is bright in the masks")
    parser.add_argument("--layout", choices=get_args(Layout), help="how the eyes are laid out")
    parser.add_argument("--pose-convention", choices=get_args(PoseConvention), help="axes of poses_bounds.npy")
    parser.add_argument(
        "--holdout", metavar="every8|blocks8|none|LIST", help="frames kept from training, to measure on"
    )
    parser.add_argument(
        "--preset", choices=get_args(PresetName), help="fast, ours, is the default; paper, as published"
    )
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument("--budget-s", type=positive, metavar="S", help="seconds of training")
    limit.add_argument("--iterations", type=int, metavar="N", help="steps of training")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--watch", action="store_true", help="wait for the scene, with a progress bar")
    _add_url(parser)


def _add_watch(commands: Commands) -> None:
    parser = add_command(commands, "watch", "wait for a job, with a progress bar", _watch)
    parser.add_argument("job", metavar="JOB", help="the id that submit printed")
    _add_url(parser)


def _add_fetch(commands: Commands) -> None:
    parser = add_command(commands, "fetch", "save a finished scene's report, curve, picture and Gaussians", _fetch)
    parser.add_argument("job", metavar="JOB", help="the id that submit printed")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write into; made if need be")
    parser.add_argument("--t", type=finite, default=0.0, help="time of picture and Gaussians, 0 to 1 (default: 0)")
    parser.add_argument("--pose", help="12 or 16 numbers or orbit:yaw,pitch,zoom (default: the endoscope's own)")
    parser.add_argument("--no-ply", action="store_true", help="leave the Gaussians out")
    _add_url(parser)


def _add_url(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--url", default=DEFAULT_URL, help=f"the service (default: {DEFAULT_URL})")


def _up(options: argparse.Namespace) -> int:
    from client.up import run  # it brings the queue's client along, which no other command needs

    chosen = {"port": options.port, "data_dir": options.data_dir}
    given = {name: value for name, value in chosen.items() if value is not None}
    try:
        settings = Settings.model_validate({**Settings.from_environment().model_dump(), **given})
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"--{first['loc'][0]}".replace("_", "-"), f"{first['msg']}.", "See --help.") from error
    run(settings)
    return ExitCode.OK


def _submit(options: argparse.Namespace) -> int:
    names = ("mask_polarity", "layout", "pose_convention", "holdout", "preset", "budget_s", "iterations", "seed")
    chosen = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    with Client(options.url) as client:
        paths = {"calibration": options.calibration, "masks": options.masks}
        job = client.reconstruct(options.clip, options.right, **paths, **chosen)
        print(job.id)
        return _show_until_done(client, job.id) if options.watch else ExitCode.OK


def _watch(options: argparse.Namespace) -> int:
    with Client(options.url) as client:
        return _show_until_done(client, options.job)


def _show_until_done(client: Client, job_id: str) -> int:
    with ProgressBar(sys.stderr) as bar:
        client.wait(job_id, on_progress=lambda job: bar.show(progress_of(job)))
    print(f"done: {client.url}/render?scene={job_id}", file=sys.stderr)
    return ExitCode.OK


def progress_of(job: JobView) -> JobProgress:
    """What the bar shows of a job; before its first report that is its state."""
    if job.stage is None:
        return JobProgress(stage=job.state.value, fraction=0.0)
    return JobProgress(
        stage=job.stage,
        fraction=job.fraction or 0.0,
        iteration=job.iteration or 0,
        iterations=job.iterations or 0,
        psnr_db=job.psnr_db,
        seconds_left=job.seconds_left,
    )


def _fetch(options: argparse.Namespace) -> int:
    with Client(options.url) as client:
        files: dict[str, bytes] = {
            "report.json": json.dumps(client.report(options.job), indent=1).encode(),
            "curve.csv": client.curve(options.job).encode(),
            "view.png": client.render(options.t, scene=options.job, pose=options.pose).content,
        }
        if not options.no_ply:
            files["scene.ply"] = client.export(options.job, options.t)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (options.out / name).write_bytes(content)
            print(options.out / name)
    except OSError as error:
        raise InputError("--out", f"{options.out} cannot be written ({error.strerror}).", "Name a folder.") from error
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
