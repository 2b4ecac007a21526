"""`intrasplat reconstruct`: train a scene from a clip."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from intrasplat.commands.arguments import add_options, given_options
from intrasplat.commands.device import add_device
from intrasplat.commands.exits import ExitCode
from intrasplat.commands.progress_bar import ProgressBar
from intrasplat.errors import Cancelled, InputError
from intrasplat.files.durable import temporary_path
from intrasplat.names import CURVE, DETAIL, MANIFEST, MASKS, RECORDED, REPORT, RESUME_STATE, SCENE
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions
from intrasplat.report import Report

if TYPE_CHECKING:
    from intrasplat.clip import DepthClip
    from intrasplat.machine.hooks import Hooks


_BEFORE_MANIFEST = (*RESUME_STATE, REPORT, CURVE, MASKS, RECORDED, DETAIL, SCENE)
UNFINISHED = {*_BEFORE_MANIFEST, *(temporary_path(Path(name)).name for name in (*_BEFORE_MANIFEST, MANIFEST))}
"""Files that a stopped or killed run may leave. The manifest is written last: it marks a finished scene."""


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `reconstruct`; run_cli reads them."""
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
    parser.add_argument(
        "--masks",
        type=Path,
        metavar="F",
        help="zip or folder of PNGs, or a video: the instruments, of the left eye or of both",
    )
    parser.add_argument(
        "--fov-mask",
        type=Path,
        metavar="F",
        help="PNG of the field of view, white inside: of the left eye, or of both side by side; replaces the search",
    )
    parser.add_argument(
        "--poses-file", type=Path, metavar="F", help="the camera's poses: TUM, or a matrix a frame as JSON or text"
    )
    parser.add_argument(
        "--segmenter", type=Path, metavar="F", help="a network of your own (ONNX) that finds instruments without masks"
    )
    add_options(parser, ReconstructionOptions)
    add_device(parser, "auto")


def run_cli(options: argparse.Namespace) -> int:
    """Reconstruct and return the exit code. SIGINT or SIGTERM stops the run; the same command resumes it.

    Raises:
        InputError: --out contains other files, or as intrasplat.pipeline.reconstruct.
        Cancelled: a signal stopped the run.
    """
    accepted_at_s = time.time()
    from intrasplat.machine.hooks import Hooks

    out: Path = options.out
    if out.exists() and not (out.is_dir() and {path.name for path in out.iterdir()} <= UNFINISHED):
        problem = f"{out} is there already and is neither an empty folder nor that of a stopped run."
        raise InputError("--out", problem, "Name a new folder.")
    interrupted = threading.Event()
    is_new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    before = {number: signal.signal(number, _once(interrupted)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ProgressBar(sys.stderr) as bar:
            hooks = Hooks(on_progress=bar.show, should_stop=interrupted.is_set)
            report = _reconstruct(options, out, hooks, accepted_at_s)
    except Cancelled as error:
        again = " The same command goes on from there." if any((out / name).exists() for name in RESUME_STATE) else ""
        raise Cancelled(f"{error}{again}") from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if is_new and not any(out.iterdir()):
            out.rmdir()
    _print_report(report, out)
    return ExitCode.OK


def _compile(on_cpu: bool) -> None:
    """Compile the kernels for the CPU, or load them from the cache."""
    from intrasplat.scene.compact import compile_coder
    from intrasplat.splat.cpu import compile_kernels
    from intrasplat.view.transfer import compile_transfer

    compile_coder()
    compile_transfer()
    if on_cpu:
        compile_kernels()


def _reconstruct(options: argparse.Namespace, out: Path, hooks: Hooks, accepted_at_s: float) -> Report:
    """Reconstruct. A thread imports torch and loads the kernels while the clip is opened, unless the run may use a GPU,
    which torch must find first."""
    given = given_options(options, ReconstructionOptions)
    from intrasplat.decode import keep_decoder_ready

    keep_decoder_ready()  # the decoder loads its libraries while this process loads its own
    from intrasplat.machine.gpu import may_have_gpu
    from intrasplat.machine.timing import Timings
    from intrasplat.poses import read_poses
    from intrasplat.stereo import ClipPaths, open_with_depth

    clip: Path | DepthClip = options.clip
    timings = Timings()
    on_cpu = options.device == "cpu" or not may_have_gpu()
    background = ThreadPoolExecutor(1)
    pipeline = background.submit(import_module, "intrasplat.pipeline")
    background.submit(_compile, on_cpu)  # not awaited here: the pipeline waits for it, and shows that as a stage
    if on_cpu:
        paths = ClipPaths(options.clip, options.right, options.calibration, options.masks, options.fov_mask)
        if options.poses_file is not None:
            read_poses(options.poses_file)  # fails before the clip is opened
        clip = open_with_depth(paths, given, hooks, timings, segmenter=options.segmenter)
    pipeline.result()
    background.shutdown(wait=False)
    from intrasplat.pipeline import reconstruct
    from intrasplat.train.hooks import TrainingHooks
    from intrasplat.train.request import ReconstructionRequest

    request = ReconstructionRequest(
        clip=clip,
        right=options.right,
        calibration=options.calibration,
        masks=options.masks,
        fov_mask=options.fov_mask,
        poses=options.poses_file,
        segmenter=options.segmenter,
        options=given,
        device=options.device,
        accepted_at_s=accepted_at_s,
        seconds=timings.seconds,
    )
    return reconstruct(request, out, TrainingHooks(hooks.on_progress, hooks.should_stop))


def _once(event: threading.Event) -> Callable[[int, FrameType | None], None]:
    """A signal handler that sets the event at the first signal and raises KeyboardInterrupt at the second."""

    def handle(number: int, frame: FrameType | None) -> None:
        event.set()
        signal.signal(number, signal.default_int_handler)

    return handle


def _print_report(report: Report, out: Path) -> None:
    quality = report.psnr_tissue_db
    shown = "not measured (no frames were held out)" if quality is None else f"{quality:.2f} dB on held-out frames"
    print(f"scene: {out}\npsnr_tissue: {shown}")
    if report.psnr_right_db is not None:
        warped = f" (the left eye's picture, warped by its depth: {report.baseline_warp_db:.2f} dB)"
        known = warped if report.baseline_warp_db is not None else ""
        print(f"psnr_right: {report.psnr_right_db:.2f} dB on held-out frames of the right eye{known}")
    for notice in report.assumptions:
        if notice.code == NoticeCode.POSES:
            print(notice.text)
    if report.masks is not None and report.masks.sure is not None:
        masks = report.masks
        print(f"instruments: in {masks.share:.1%} of the picture; {masks.sure:.0%} of what may be one is clear")
    if (kept := report.recorded) is not None:
        eyes = " and ".join(kept.eyes)
        print(f"recorded: {len(kept.frames)} frames ({eyes} eye) kept with the scene, {kept.size_bytes / 1e6:.1f} MB")
    for notice in report.warnings:
        print(f"{notice.severity}: {notice.text}")
