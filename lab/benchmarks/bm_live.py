"""How soon and how old a feed is shown: a clip is played to and fro by another process, and a Feed follows it.

    python -m lab.benchmarks.bm_live [--clips d4d_stereo phantom:breathing:72frames:stereo] [--width 320]
        [--seconds 60] [--fps 30] [--views-hz 5] [--detail off] [--kill 0] [--feeds 1] [--out lab/rows/live.csv]

The clip is encoded once (H.264, both eyes side by side in the recorded size) and sent as MPEG-TS over TCP in real time.
The feed records it, and keeps its past on disk. A thread asks for the newest moment views-hz times a second and renders
it. Measured are seconds from the start of the feed to the first picture (`first_s`); the age of what is shown, from the
arrival of the newest pair in the model to the rendered picture, p50 and p95 after SETTLED_S, and p50 of the first and
the last third (`age_early_s`, `age_late_s`); rates and steps of training a pair; cores that this process and the one
that reads were busy on, with the views; lag of decoding; the memory of both; bytes on disk. --kill N: kill the reading
process N times, and measure the longest time until something newer is shown (`back_s`).
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from intrasplat.live.feed import Feed, FeedSettings
from intrasplat.live.spec import RecordingSpec, SourceSpec
from intrasplat.live.state import LiveReport
from intrasplat.splat.backend import Device, choose_device
from intrasplat.splat.cpu import compile_kernels
from intrasplat.view.render import render_frame
from lab.benchmarks.bm_follow import Played, played_of
from lab.benchmarks.send_stream import sending
from lab.evaluate.rows import adding_alone, commit, machine, read_rows, replace_row, texts_of
from lab.evaluate.sources import DATA_VARIABLE, source_of

CLIPS = ("d4d_stereo", "phantom:breathing:72frames:stereo")
SETTLED_S = 10.0
"""After the start; a shorter run counts from its first quarter."""
REPORT_PERIOD_S = 1.0
KILL_PERIOD_S = 8.0
OPTIONS = {"preset": "veryfast", "tune": "zerolatency", "crf": "18", "x264-params": "scenecut=0"}
KEY = ("clip", "width", "fps", "seconds", "detail", "kills", "feeds", "device")
FIELDS = (
    *KEY, "height", "received_fps", "used_fps", "steps", "age_p50_s", "age_p95_s", "age_early_s", "age_late_s",
    "first_s", "cores", "decode_lag_s", "rss_mib", "child_mib", "disk_mb", "past_s", "behind_share", "back_s", "load",
    "machine", "commit",
)  # fmt: skip


FEWEST, SUMMED = ("used_fps", "received_fps", "steps", "past_s"), ("cores", "rss_mib", "child_mib", "disk_mb")
"""Of several feeds: the least, and the sum, in a row; of the other numbers the largest."""


@dataclass(eq=False)
class Found:
    """What was seen: (seconds since the start, age in s) of each shown picture; reports; seconds until back."""

    shown: list[tuple[float, float]] = field(default_factory=list)
    reports: list[tuple[float, LiveReport]] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    child_kib: int = 0


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    os.environ.setdefault(DATA_VARIABLE, "../shared/data")
    compile_kernels(lambda _: None)
    device = choose_device(options.device)
    with adding_alone(options.out.parent):
        for name in options.clips:
            played = played_of(source_of(name), options.fps)
            with TemporaryDirectory() as folder:
                stream = Path(folder) / "clip.ts"
                encode(played, stream)
                row = {"clip": name, "width": options.width, "fps": options.fps, "seconds": options.seconds}
                row |= {"detail": options.detail, "kills": options.kill, "device": device.kind}
                row["feeds"] = options.feeds
                others = [_other(name, options, Path(folder) / f"{i}.csv") for i in range(options.feeds - 1)]
                row |= followed(played, stream, options, device)
                row |= together([row, *(_row_of(*other) for other in others)])
            row |= {"load": os.getloadavg()[0], "machine": machine(device.kind), "commit": commit()}
            text = texts_of(row, FIELDS)
            replace_row(options.out, FIELDS, KEY, text)
            print("  ".join(f"{field} {text[field]}" for field in FIELDS[:-2] if text[field]), flush=True)


def together(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The measured numbers of feeds that were followed at the same time."""
    measured = [field for field in FIELDS[len(KEY) : -3] if field in rows[0] and rows[0][field] is not None]
    return {field: _over(field, [float(row[field]) for row in rows]) for field in measured}


def _over(field: str, values: Sequence[float]) -> float:
    return min(values) if field in FEWEST else sum(values) if field in SUMMED else max(values)


def _other(clip: str, options: argparse.Namespace, path: Path) -> tuple[subprocess.Popen[bytes], Path]:
    """A process that follows a feed of its own."""
    command = [sys.executable, "-m", "lab.benchmarks.bm_live", "--clips", clip, "--out", str(path)]
    for name in ("fps", "seconds", "views_hz", "detail", "camera", "keep_s", "device"):
        command += [f"--{name.replace('_', '-')}", str(getattr(options, name))]
    if options.width is not None:
        command += ["--width", str(options.width)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL), path


def _row_of(process: subprocess.Popen[bytes], path: Path) -> dict[str, str]:
    """What it measured."""
    if process.wait():
        raise RuntimeError("Another feed failed; see above.")
    return read_rows(path)[-1]


def encode(played: Played, path: Path) -> None:
    """The clip to and fro, once, as MPEG-TS."""
    with av.open(str(path), "w", format="mpegts") as container:
        left = played.pairs[0][0]
        height, width = left.shape[0] // 2 * 2, left.shape[1] // 2 * 2
        stream: Any = container.add_stream("libx264", rate=Fraction(played.fps).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt, stream.options = 2 * width, height, "yuv420p", OPTIONS
        stream.codec_context.gop_size = round(played.fps)
        for number in range(2 * (len(played.pairs) - 1)):
            eyes: list[NDArray[np.uint8]] = [eye[:height, :width] for eye in played.pairs[played.place(number)]]
            frame = av.VideoFrame.from_ndarray(np.concatenate(eyes, axis=1), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def followed(played: Played, stream: Path, options: argparse.Namespace, device: Device) -> dict[str, object]:
    """Follow the sent clip for some seconds; what was measured."""
    sender = subprocess.Popen(sending(stream, options.fps), stdout=subprocess.PIPE, text=True)
    try:
        assert sender.stdout is not None
        url = f"tcp://127.0.0.1:{int(sender.stdout.readline())}"
        recording = RecordingSpec(stream.parent / "recording", keep_s=options.keep_s)
        spec = SourceSpec(url, layout="sbs", recording=recording)
        settings = FeedSettings(options.width, options.camera, options.keep_s, stream.parent / "segments")
        found, ended, began_s, cpu_s = Found(), threading.Event(), time.monotonic(), _cpu_s()
        with Feed(spec, played.calibration, settings, device) as feed:
            looking = (feed, found, ended, began_s, options.views_hz, options.detail, device)
            viewer = threading.Thread(target=_look, args=looking)
            viewer.start()
            kills = 0
            while (now_s := time.monotonic() - began_s) < options.seconds:
                found.reports.append((now_s, feed.report()))
                found.child_kib = max(found.child_kib, _resident_kib(_reading_pid(feed)))
                if kills < options.kill and now_s > SETTLED_S + kills * KILL_PERIOD_S:
                    kills += 1
                    found.back_s.append(_killed(feed))
                time.sleep(REPORT_PERIOD_S)
            ended.set()
            viewer.join()
        return _summary(found, options.seconds) | {"cores": (_cpu_s() - cpu_s) / options.seconds}
    finally:
        sender.kill()
        sender.wait()


def _cpu_s() -> float:
    """Seconds of a core that this process has used, and those of its processes that have ended."""
    used = [resource.getrusage(each) for each in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def _look(
    feed: Feed, found: Found, ended: threading.Event, began_s: float, views_hz: float, detail: Any, device: Device
) -> None:
    while not ended.wait(1 / views_hz if found.shown else 0.02):
        view = feed.moment()
        if view is not None:
            render_frame(view.scene, view.t, device=device, detail=detail)
            found.shown.append((time.monotonic() - began_s, time.time() - view.captured_at))


def _killed(feed: Feed) -> float:
    """Kill the reading process; seconds until a pair that came in later is known."""
    killed_at = time.time()
    if (pid := _reading_pid(feed)) is not None:
        os.kill(pid, signal.SIGKILL)
    while (view := feed.moment()) is None or view.captured_at <= killed_at:
        time.sleep(0.02)
    return time.time() - killed_at


def _reading_pid(feed: Feed) -> int | None:
    process = feed._source._process
    return None if process is None else process.pid


def _resident_kib(pid: int | None) -> int:
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmRSS"):
                return int(line.split()[1])
    return 0


def _summary(found: Found, seconds: float) -> dict[str, object]:
    settled_s = min(SETTLED_S, seconds / 4)
    shown = [each for each in found.shown if each[0] > settled_s]
    reports = [report for now_s, report in found.reports if now_s > settled_s]
    ages, third = [age_s for _, age_s in shown], len(shown) // 3
    last = reports[-1]
    assert last.model is not None
    assert last.past is not None
    return {
        "width": last.model.width,
        "height": last.model.height,
        "received_fps": median(each.numbers.received_fps for each in reports),
        "used_fps": float(np.mean([each.numbers.used_fps for each in reports])),
        "steps": median(each.model.pair_steps for each in reports if each.model is not None),
        "age_p50_s": float(np.percentile(ages, 50)),
        "age_p95_s": float(np.percentile(ages, 95)),
        "age_early_s": median(ages[:third]),
        "age_late_s": median(ages[-third:]),
        "first_s": found.shown[0][0],
        "decode_lag_s": median(each.numbers.decode_lag_s or 0.0 for each in reports),
        "rss_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "child_mib": round(found.child_kib / 1024),
        "disk_mb": last.numbers.stored_bytes / 1e6,
        "past_s": last.past.ends_s - last.past.begins_s,
        "behind_share": sum(each.state.value == "behind" for each in reports) / len(reports),
        "back_s": max(found.back_s) if found.back_s else None,
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=list(CLIPS))
    parser.add_argument("--width", type=int, help="default: what the machine keeps up with")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--views-hz", type=float, default=5.0)
    parser.add_argument("--detail", choices=("on", "off"), default="off")
    parser.add_argument("--camera", choices=("fixed", "moving"), default="fixed")
    parser.add_argument("--keep-s", type=float, default=600.0)
    parser.add_argument("--kill", type=int, default=0)
    parser.add_argument("--feeds", type=int, default=1)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="cpu")
    parser.add_argument("--out", type=Path, default=Path("lab/rows/live.csv"))
    return parser


if __name__ == "__main__":
    main()
