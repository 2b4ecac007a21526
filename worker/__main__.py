"""`python -m worker COMMAND`: everything that happens on this machine, without a service, and the service's worker.

`intrasplat reconstruct|render|phantom|evaluate|stability|doctor` end here with the same arguments. Modules that bring
torch along are imported by the command that needs them, so that --help and doctor answer at once, and doctor even
without torch.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import get_args

from pydantic import ValidationError

from contract.runtime.arguments import Commands, add_command, add_options, finite, given_options
from contract.runtime.exits import EXIT_CODES_HELP, ExitCode, end_by
from contract.runtime.logs import configure
from contract.runtime.processes import told_to_end
from contract.runtime.progress_bar import ProgressBar
from contract.runtime.settings import Settings
from contract.wire.errors import Cancelled, InputError, IntrasplatError, UnavailableError
from contract.wire.names import MANIFEST, DeviceName
from contract.wire.options import ReconstructionOptions
from contract.wire.rendering import ImageFormat, IntrinsicsOverride, Layer
from contract.wire.report import Report

SUFFIX_FORMATS = {
    ".png": ImageFormat.PNG,
    ".jpg": ImageFormat.JPEG,
    ".jpeg": ImageFormat.JPEG,
    ".webp": ImageFormat.WEBP,
    ".npy": ImageFormat.NPY,
}
MAX_RENDER_PIXELS = 8192 * 8192


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    options = _parser(sys.argv[1:] if argv is None else argv).parse_args(argv)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except IntrasplatError as error:
        return end_by(error)
    except ModuleNotFoundError as error:
        return end_by(UnavailableError(f"{error.name} is not installed.", "`intrasplat doctor` tells the remedy."))
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="intrasplat", epilog=EXIT_CODES_HELP)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_reconstruct(commands)
    _add_render(commands)
    _add_phantom(commands, wanted="phantom" in argv[:1])
    _add_evaluate(commands, wanted="evaluate" in argv[:1])
    _add_stability(commands, wanted="stability" in argv[:1])
    add_command(commands, "consume", "claim jobs from the queue and serve renders, until a signal ends it", _consume)
    add_command(commands, "device", "what consume starts for itself: train and render as it is told on stdin", _device)
    add_command(commands, "doctor", "say what is installed, what would be used, what is missing", _doctor)
    return parser


def _add_reconstruct(commands: Commands) -> None:
    parser = add_command(commands, "reconstruct", "train a scene from a clip", _reconstruct)
    parser.add_argument(
        "clip", type=Path, metavar="INPUT", help="a video, a folder or a zip: both eyes, or the left one"
    )
    parser.add_argument(
        "right", type=Path, metavar="RIGHT", nargs="?", help="the right eye, if it is a file of its own"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="SCENE", help="folder for the scene: new, empty, or of a stopped run"
    )
    parser.add_argument("--calibration", type=Path, metavar="F", help="JSON, OpenCV YAML or XML, or ini; for stereo")
    parser.add_argument("--masks", type=Path, metavar="F", help="zip or folder of PNGs, or a video: the instruments")
    add_options(parser, ReconstructionOptions)
    _add_device(parser, "auto")


def _add_render(commands: Commands) -> None:
    parser = add_command(commands, "render", "render images of a scene", _render)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the folder that reconstruct wrote")
    when = parser.add_mutually_exclusive_group(required=True)
    when.add_argument("--t", type=finite, help="time: 0 is the first frame, 1 the end of the clip")
    when.add_argument("--frames", type=_frames, metavar="LIST", help="frame numbers such as 1,9,17; writes a folder")
    parser.add_argument(
        "--pose",
        help="world_from_camera, 12 or 16 numbers in mm, or orbit:YAW,PITCH,ZOOM in degrees and times nearer "
        "(default: the endoscope's own)",
    )
    camera = {"width": "of the image", "height": "of the image", "fx": "focal length", "fy": "focal length"}
    for name, what in (camera | {"cx": "optical axis from the left edge", "cy": "from the upper edge"}).items():
        kind = int if name in ("width", "height") else float
        parser.add_argument(f"--{name}", type=kind, metavar="PX", help=f"{what}, in pixels (default: the clip's)")
    parser.add_argument(
        "--layer",
        choices=[layer.value for layer in Layer],
        default=Layer.RGB.value,
        help="depth: 16-bit PNG in 0.01 mm, or NPY in mm, 0 where there is none; confidence: 0 to 1 (default: rgb)",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="PATH", help="a .png, .jpg or .npy file; with --frames a folder"
    )
    _add_device(parser, "cpu")  # a GPU needs longer to begin than the CPU for a few images


def _add_device(parser: argparse.ArgumentParser, default: str) -> None:
    what = "auto: an NVIDIA GPU where there is one and Triton, else the CPU"
    parser.add_argument("--device", choices=get_args(DeviceName), default=default, help=f"{what} (default: {default})")


def _add_phantom(commands: Commands, wanted: bool) -> None:
    parser = add_command(commands, "phantom", "make a synthetic stereo clip of tissue, with its truth", _phantom)
    if wanted:
        from worker.phantom import add_cli_arguments

        add_cli_arguments(parser)


def _add_evaluate(commands: Commands, wanted: bool) -> None:
    parser = add_command(commands, "evaluate", "measure presets on clips, and draw speed against accuracy", _evaluate)
    if wanted:
        from worker.evaluate.command import add_cli_arguments

        add_cli_arguments(parser)


def _add_stability(commands: Commands, wanted: bool) -> None:
    summary = "spoil synthetic clips in many ways, and draw where presets break and whether they say so"
    parser = add_command(commands, "stability", summary, _stability)
    if wanted:
        from worker.evaluate.stability_command import add_cli_arguments

        add_cli_arguments(parser)


def _frames(text: str) -> list[int]:
    try:
        frames = [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list such as 1,9,17") from None
    if min(frames) < 0:
        raise argparse.ArgumentTypeError("frames count from 0")
    return frames


def _reconstruct(options: argparse.Namespace) -> int:
    from worker.daemon.orders import job_progress
    from worker.pipeline import reconstruct
    from worker.scene.resume_file import RESUME_FILE
    from worker.train.hooks import TrainingHooks
    from worker.train.request import ReconstructionRequest

    out: Path = options.out
    if out.exists() and not (out.is_dir() and {path.name for path in out.iterdir()} <= {RESUME_FILE}):
        problem = f"{out} is there already and is neither an empty folder nor that of a stopped run."
        raise InputError("--out", problem, "Name a new folder.")
    request = ReconstructionRequest(
        clip=options.clip,
        right=options.right,
        calibration=options.calibration,
        masks=options.masks,
        options=given_options(options, ReconstructionOptions),
        device=options.device,
    )
    interrupted = threading.Event()
    is_new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    before = {number: signal.signal(number, _once(interrupted)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ProgressBar(sys.stderr) as bar:
            hooks = TrainingHooks(on_progress=lambda now: bar.show(job_progress(now)), should_stop=interrupted.is_set)
            report = reconstruct(request, out, hooks)
    except Cancelled as error:
        again = " The same command goes on from there." if (out / RESUME_FILE).exists() else ""
        raise Cancelled(f"{error}{again}") from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if is_new and not any(out.iterdir()):
            out.rmdir()
    _print_report(report, out)
    return ExitCode.OK


def _once(event: threading.Event) -> Callable[[int, FrameType | None], None]:
    """A handler that asks politely the first time; at the second signal the run is left as Ctrl-C leaves a program."""

    def handle(number: int, frame: FrameType | None) -> None:
        event.set()
        signal.signal(number, signal.default_int_handler)

    return handle


def _print_report(report: Report, out: Path) -> None:
    quality = report.psnr_tissue_db
    shown = "not measured (no frames were held out)" if quality is None else f"{quality:.2f} dB on held-out frames"
    print(f"scene: {out}\npsnr_tissue: {shown}")
    for notice in report.warnings:
        print(f"{notice.severity}: {notice.text}")


def _render(options: argparse.Namespace) -> int:
    from contract.wire.pose import parse_pose
    from worker.daemon.views import camera_of, pose_of
    from worker.raster.backend import choose_device
    from worker.render.encode import encode_layer
    from worker.render.view import render_frame
    from worker.scene.checkpoint import load_scene

    device = choose_device(options.device)
    if not (options.scene / MANIFEST).is_file():
        raise InputError("SCENE", f"{options.scene} holds no scene.", "Name a folder that `reconstruct --out` wrote.")
    scene = load_scene(options.scene)
    wanted = _camera(options)
    camera = camera_of(scene.intrinsics, wanted, MAX_RENDER_PIXELS)
    pose = pose_of(scene, None if options.pose is None else parse_pose(options.pose))
    for t, path in _targets(options, scene.frame_count):
        image_format = SUFFIX_FORMATS.get(path.suffix.lower())
        if image_format is None:
            raise InputError("--out", f"{path.name!r} has no known ending.", f"Use {', '.join(SUFFIX_FORMATS)}.")
        frame = render_frame(scene, t, pose, camera, device)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_layer(frame, Layer(options.layer), image_format))
        print(path)
        for warning in frame.warnings:
            print(f"{warning.severity}: {warning.text}", file=sys.stderr)
    return ExitCode.OK


def _camera(options: argparse.Namespace) -> IntrinsicsOverride:
    """The parts of the camera that the caller gave."""
    try:
        return IntrinsicsOverride(**{name: getattr(options, name) for name in IntrinsicsOverride.model_fields})
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{first['input']} is not accepted: {first['msg']}."
        raise InputError(f"--{first['loc'][0]}", problem, "Give pixels of a usual size.") from error


def _targets(options: argparse.Namespace, frame_count: int) -> list[tuple[float, Path]]:
    """Times and files to write; frame i is shown at t = i / T and written as 00000i.png."""
    if options.frames is None:
        return [(options.t, options.out)]
    beyond = [frame for frame in options.frames if frame >= frame_count]
    if beyond:
        raise InputError("--frames", f"{beyond[0]} is not there.", f"The clip has frames 0 to {frame_count - 1}.")
    return [(frame / frame_count, options.out / f"{frame:06d}.png") for frame in options.frames]


def _phantom(options: argparse.Namespace) -> int:
    from worker.phantom import run_cli

    return run_cli(options)


def _evaluate(options: argparse.Namespace) -> int:
    from worker.evaluate.command import run_cli

    return run_cli(options)


def _stability(options: argparse.Namespace) -> int:
    from worker.evaluate.stability_command import run_cli

    return run_cli(options)


def _doctor(options: argparse.Namespace) -> int:
    from worker.doctor import run_doctor

    return ExitCode.UNAVAILABLE if run_doctor() else ExitCode.OK


def _consume(options: argparse.Namespace) -> int:
    settings = Settings.from_environment()
    configure(settings, "worker")
    if settings.redis_url is None:
        raise UnavailableError("REDIS_URL is not set.", "Use `intrasplat up`, which starts a queue and a worker.")
    from worker.daemon.supervisor import run_supervisor

    run_supervisor(settings, told_to_end())
    return ExitCode.OK


def _device(options: argparse.Namespace) -> int:
    settings = Settings.from_environment()
    configure(settings, "device")
    from worker.daemon.device import run_device

    run_device(settings)
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
