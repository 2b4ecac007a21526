"""`intrasplat live`: follow a live source on this machine, and print its state every second."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from intrasplat.commands.arguments import count, positive
from intrasplat.commands.device import add_device
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError, IntrasplatError

if TYPE_CHECKING:
    from intrasplat.live.followed import LiveScene
    from intrasplat.live.state import LiveReport

PERIOD_S = 1.0
CUT = "cut.mp4"
LAYOUTS = ("auto", "sbs", "tb", "two")


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `live`; run_cli reads them."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="rtsp://, tcp://HOST:PORT, udp://ADDRESS:PORT, http://, a file, which plays in real time, or a device",
    )
    parser.add_argument("--calibration", type=Path, required=True, metavar="F", help="of both eyes, as for reconstruct")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="record and store the past there, and continue what is there"
    )
    parser.add_argument("--layout", choices=LAYOUTS, default="auto", help="how both eyes lie in the pictures")
    parser.add_argument("--width", type=count, metavar="PX", help="of the model's pictures (default: what keeps up)")
    parser.add_argument("--keep", type=positive, default=120.0, metavar="S", help="seconds of the past (default: 120)")
    parser.add_argument("--camera", choices=("fixed", "moving"), default="fixed", help="whether the endoscope moves")
    parser.add_argument("--seconds", type=positive, metavar="S", help="end after so long (default: with Ctrl-C)")
    parser.add_argument(
        "--cut", type=positive, metavar="S", help=f"at the end, write the last S seconds to FOLDER/{CUT}"
    )
    parser.add_argument("--json", action="store_true", help="print each report as a line of JSON")
    add_device(parser, "auto")


def run_cli(options: argparse.Namespace) -> int:
    """Follow until SIGINT, SIGTERM, the source's end or --seconds, and return the exit code.

    Raises:
        InputError: the source, the calibration or an option cannot be used, or nothing is recorded for the cut.
        UnavailableError: the device is missing, or nothing came from the source.
    """
    if options.cut and options.out is None:
        raise InputError("--cut", "nothing is recorded.", "Name a folder with --out.")
    ended = threading.Event()
    before = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        from intrasplat.live.followed import follow

        with follow(
            options.source, options.calibration, out=options.out, layout=options.layout, width=options.width,
            keep_s=options.keep, camera=options.camera, device=options.device,
        ) as live:  # fmt: skip
            trouble = _print_reports(live, ended, options.seconds, is_json=options.json)
            if trouble is not None:
                raise trouble
            if options.cut:
                _cut(live, options.cut, options.out / CUT)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return ExitCode.OK


def _print_reports(
    live: LiveScene, ended: threading.Event, seconds: float | None, *, is_json: bool
) -> IntrasplatError | None:
    """Print until the end. Returns why nothing was learnt; None: something was, or it has just begun."""
    from intrasplat.live.state import FeedReason, FeedState

    passed_s, report = 0.0, live.report()
    trouble, has_learnt = live.why_unknown(), report.model is not None
    while not ended.wait(PERIOD_S) and (seconds is None or passed_s < seconds):
        passed_s, report = passed_s + PERIOD_S, live.report()
        print(json.dumps(asdict(report)) if is_json else line_of(report), flush=True)
        if trouble is None or report.reason is not FeedReason.END_OF_FILE:  # the end hides why nothing was learnt
            trouble = live.why_unknown()
        has_learnt = has_learnt or report.model is not None
        if report.state is FeedState.ENDED:
            break
    return None if has_learnt else trouble


def line_of(report: LiveReport) -> str:
    """A report as a line for people."""
    numbers, model, past = report.numbers, report.model, report.past
    parts = [report.state.value + (f" ({report.text})" if report.text else "")]
    parts.append(f"{numbers.received_fps:.1f} in, {numbers.used_fps:.1f} used a second")
    if numbers.model_age_s is not None:
        parts.append(f"{numbers.model_age_s:.1f} s old")
    if model is not None:
        parts.append(f"{model.width}x{model.height}, {model.gaussians} Gaussians, {model.pair_steps:.0f} steps a pair")
    if past is not None:
        parts.append(f"{past.ends_s - past.begins_s:.0f} s of past")
    if numbers.stored_bytes:
        parts.append(f"{numbers.stored_bytes / 1e6:.0f} MB kept")
    if report.recording is not None:
        parts.append(f"not recorded: {report.recording.value}")
    return "  ".join(parts)


def _cut(live: LiveScene, seconds: float, path: Path) -> None:
    """Write the last seconds as a clip."""
    live.pause()  # it completes the part that is being written
    recorded = live.feed.recorded()
    ends_s = recorded[-1].to_s if recorded else 0.0
    cut = live.cut(ends_s - seconds, ends_s, path)
    print(f"{cut.path}: {cut.frames} frames, {cut.from_s:.1f} to {cut.to_s:.1f} s of the source", file=sys.stderr)
