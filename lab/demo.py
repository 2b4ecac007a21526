"""`make demo`: send a synthetic clip through the real service, and draw what comes back into ./demo/."""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import intrasplat_client
from client.connected import connected
from client.remote import progress_of
from intrasplat.commands.exits import EXIT_CODES_HELP, ExitCode, exit_code_of
from intrasplat.commands.progress_bar import ProgressBar
from intrasplat.errors import IntrasplatError, UnavailableError
from intrasplat_client import Client, JobState, JobView, Report
from lab.pictures import Panel, draw_curve, draw_sheet, draw_strip

FRAMES = 48
WIDTH, HEIGHT = 480, 384
SEED = 3
TRAINING = "train"
"""The name of the training stage in JobView.stage."""
BUDGET_S = 45.0
"""With this size and budget the demo takes two minutes on two quiet cores, and less than four on slow ones."""

HOLDOUT = "blocks8"
"""Eight held-out frames in a row, as behind an instrument: copying neighbours cannot fill such a stretch."""
READY_TIMEOUT_S = 180.0
READY_PERIOD_S = 1.0
STOP_TIMEOUT_S = 40.0
LOG_LINES_SHOWN = 20

SHOWN_FRAMES = (0, 12, 30, 42)
"""Frame 12 is held out; in frame 30 the instrument covers most."""
VIEWED_FRAME = 30
VIEWS = {"from the right": "orbit:12,0,1", "from the left": "orbit:-12,0,1", "from above": "orbit:0,12,1"}
NEAR = "orbit:0,0,1.6"
DEPTH_SHARE = (2, 98)
"""Percentiles of depth at the two ends of the colour scale."""


def main() -> int:
    """Run the demo and return an exit code of the command line."""
    options = _parser().parse_args()
    signal.signal(signal.SIGTERM, _interrupt)  # so that the service ends with the demo
    started_s = time.monotonic()
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="intrasplat-demo-") as folder:
            written = run(Path(folder), options.out, options.picture)
    except IntrasplatError as error:
        print(f"demo: {error}", file=sys.stderr)
        return exit_code_of(error)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    print(f"\nThe demo took {time.monotonic() - started_s:.0f} s, without what was installed before. Its pictures:")
    for path, what in written.items():
        print(f"  {path}  {what}")
    print("Send your own clip: .venv/bin/intrasplat up, then http://127.0.0.1:8765/ in a browser.")
    return ExitCode.OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m lab.demo", description=__doc__, epilog=EXIT_CODES_HELP)
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder for the pictures (default: demo)")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="also draw the README's picture into this file")
    return parser


def _interrupt(*_: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not stop the clean-up of the service
    raise KeyboardInterrupt


def run(folder: Path, out: Path, picture: Path | None = None) -> dict[Path, str]:
    """Run every step of the demo; `folder` is for temporary files.

    Returns:
        the files written, each with what it shows.
    """
    clip = make_clip(folder / "clip")
    say("starting queue, service and worker (the first time, its kernels are compiled: up to a minute)")
    with started_service(folder / "data", out / "service.log") as client:
        say(f"sending the clip: POST {client.url}/reconstruct")
        job = client.reconstruct(zipped(clip), holdout=HOLDOUT, budget_s=BUDGET_S)
        preview = Preview(client.url, out / "preview.png")
        with ProgressBar(sys.stderr) as bar:
            for now in client.watch(job.id):
                bar.show(progress_of(now))
                preview.look(now)
        client.wait(job.id)  # raises the reason if there is no scene
        report = client.report(job.id)
        say(f"asking for views: GET {client.url}/render?t=...&pose=...")
        written = preview.written() | save_renders(client, job.id, out)
        written |= save_sheet(client, job.id, clip, report, out)
        if picture is not None:
            draw_strip(strip_of(client, job.id, clip), picture)
            written[picture] = "the README's picture"
        written |= save_curve(client.curve(job.id), report, out)
    say(summary_of(report))
    return written


class Preview:
    """The first render of the job while it trains."""

    def __init__(self, url: str, path: Path) -> None:
        self._client = Client(url, patience_s=0.0)
        self._path = path
        self._began_s: float | None = None
        self._seconds: float | None = None

    def look(self, job: JobView) -> None:
        """Ask for the render if the job trains and there is none yet; ignore a refusal."""
        if job.state is not JobState.RUNNING or job.stage != TRAINING or self._seconds is not None:
            return
        self._began_s = self._began_s or time.monotonic()
        try:
            image = self._client.render(time_of(VIEWED_FRAME), scene=job.id)
        except intrasplat_client.IntrasplatError:
            return
        if image.iteration:
            self._path.write_bytes(image.content)
            self._seconds = time.monotonic() - self._began_s

    def written(self) -> dict[Path, str]:
        """The file and what it shows; empty if no render came."""
        self._client.close()
        if self._seconds is None:
            return {}
        return {self._path: f"the model {self._seconds:.0f} s after training began, while it went on"}


def make_clip(clip: Path) -> Path:
    """A folder in StereoMIS layout: synthetic breathing tissue with an instrument in front."""
    say(f"making a stereo clip of synthetic tissue: {FRAMES} frames of {WIDTH} x {HEIGHT}, an instrument in front")
    size = ("--frames", str(FRAMES), "--width", str(WIDTH), "--height", str(HEIGHT), "--seed", str(SEED))
    command = [sys.executable, "-m", "lab", "phantom", *size, "--format", "stereomis", "--out", str(clip)]
    if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode != 0:
        raise UnavailableError("The synthetic clip could not be made.", "Try `intrasplat doctor`.")
    return clip


def zipped(clip: Path) -> Path:
    """The folder as one zip file, stored, because PNGs are compressed already."""
    archive = clip.with_suffix(".zip")
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted(clip.rglob("*")):
            file.write(path, path.relative_to(clip))
    return archive


def recorded(clip: Path, frame: int) -> bytes:
    """The PNG of one frame of the left eye."""
    return (clip / f"{frame:06d}l.png").read_bytes()


def time_of(frame: int) -> float:
    """Model time of a frame (docs/conventions.md)."""
    return frame / FRAMES


def save_renders(client: Client, scene: str, out: Path) -> dict[Path, str]:
    """Write one PNG per shown frame from the endoscope's pose, and one per other view at VIEWED_FRAME."""
    folder = out / "renders"
    folder.mkdir(exist_ok=True)
    asked: list[tuple[str, float, str | None]] = [
        (f"endoscope_{frame:06d}.png", time_of(frame), None) for frame in SHOWN_FRAMES
    ]
    asked += [
        (f"{name.replace(' ', '_')}_{VIEWED_FRAME:06d}.png", time_of(VIEWED_FRAME), pose)
        for name, pose in {**VIEWS, "near": NEAR}.items()
    ]
    for name, t, pose in asked:
        (folder / name).write_bytes(client.render(t, scene=scene, pose=pose).content)
    return {folder: f"{len(asked)} rendered frames, one file each"}


def save_sheet(client: Client, scene: str, clip: Path, report: Report, out: Path) -> dict[Path, str]:
    """Draw a sheet with four rows: recorded frames, the same rendered, other views, geometry."""
    held_out = {each.frame for each in report.frames}
    captions = [
        f"t = {time_of(frame):.3g}" + (", not trained on" if frame in held_out else "") for frame in SHOWN_FRAMES
    ]
    t = time_of(VIEWED_FRAME)
    shown = [(captions[i], frame) for i, frame in enumerate(SHOWN_FRAMES)]
    poses = {**VIEWS, "nearer": NEAR}
    rows = [
        ("recorded", [Panel(caption, recorded(clip, frame)) for caption, frame in shown]),
        ("rendered", [Panel(caption, client.render(time_of(f), scene=scene).content) for caption, f in shown]),
        (
            f"other views, t = {t:.3g}",
            [
                Panel(f"{name}: pose={pose}", client.render(t, scene=scene, pose=pose).content)
                for name, pose in poses.items()
            ],
        ),
        (f"geometry, t = {t:.3g}", geometry_of(client, scene, t)),
    ]
    path = out / "contact_sheet.png"
    draw_sheet("Synthetic tissue: recorded with an instrument, rendered by the model without it", rows, path)
    return {path: "recorded | without the instrument | other views | depth and confidence"}


def geometry_of(client: Client, scene: str, t: float) -> list[Panel]:
    """Depth in mm and confidence, from the endoscope's pose and from the first of VIEWS."""
    name, pose = next(iter(VIEWS.items()))
    panels = [depth_panel(client, scene, t, None, "depth"), depth_panel(client, scene, t, pose, f"depth {name}")]
    for where, caption in ((None, "confidence"), (pose, f"confidence {name}")):
        values = client.render(t, scene=scene, pose=where, layer="confidence", format="npy").array()
        panels.append(Panel(f"{caption}: 0 dark, 1 bright", values=values))
    return panels


def depth_panel(client: Client, scene: str, t: float, pose: str | None, caption: str) -> Panel:
    """Depth in mm; no colour where depth is invalid."""
    import numpy as np  # only here, to keep the command line light

    depth_mm = client.render(t, scene=scene, pose=pose, layer="depth", format="npy").array()
    valid = np.where(depth_mm > 0, depth_mm, np.nan)
    low, high = (float(value) for value in np.nanpercentile(valid, DEPTH_SHARE))
    caption = f"{caption}: {low:.0f} mm bright, {high:.0f} mm dark"
    return Panel(caption, values=valid, colours="magma_r", limits=(low, high))


def strip_of(client: Client, scene: str, clip: Path) -> list[Panel]:
    """Panels of the README's picture: one moment recorded, rendered, from another side, and its depth."""
    t, (name, pose) = time_of(VIEWED_FRAME), next(iter(VIEWS.items()))
    return [
        Panel("recorded, left eye", recorded(clip, VIEWED_FRAME)),
        Panel("rendered: the instrument is gone", client.render(t, scene=scene).content),
        Panel(f"rendered 12 degrees {name}", client.render(t, scene=scene, pose=pose).content),
        depth_panel(client, scene, t, None, "its depth"),
    ]


def save_curve(curve_csv: str, report: Report, out: Path) -> dict[Path, str]:
    """Draw accuracy over seconds of training, and write its numbers."""
    table, chart = out / "curve.csv", out / "curve.png"
    table.write_text(curve_csv)
    title = f"{len(report.frames)} of {FRAMES} frames held out, eight at a time; synthetic tissue, two eyes in"
    draw_curve(curve_csv, baselines_of(report), title, chart)
    return {chart: "accuracy over seconds of training, compared with plain copying", table: "the same as numbers"}


def baselines_of(report: Report) -> dict[str, float]:
    """Scores of the copy baselines in dB, by their labels in the chart."""
    stated = {
        "copying: neighbours blended": report.baseline_blend_db,
        "copying: neighbours warped by optical flow": report.baseline_flow_db,
    }
    return {name: value_db for name, value_db in stated.items() if value_db is not None}


def summary_of(report: Report) -> str:
    """One line with the scene's quality."""
    copies = ", ".join(
        f"{name.removeprefix('copying: ')} {value:.1f} dB" for name, value in baselines_of(report).items()
    )
    right = f", {report.psnr_right_db:.1f} dB in the right eye" if report.psnr_right_db is not None else ""
    return (
        f"{report.gaussians:,} Gaussians after {report.seconds['t_train_s']:.0f} s of training; "
        f"psnr_tissue {report.psnr_tissue_db:.1f} dB on {len(report.frames)} frames it never saw "
        f"(copying: {copies}){right}; depth {report.depth_agreement_mm:.2f} mm from stereo"
    )


@contextmanager
def started_service(data_dir: Path, log: Path) -> Iterator[Client]:
    """A client of an `intrasplat up` that runs on a free port until the context ends and writes to `log`.

    Raises:
        UnavailableError: it does not become ready.
    """
    port = free_port()
    command = [sys.executable, "-m", "client.cli", "up", "--port", str(port), "--data-dir", str(data_dir)]
    environment = {name: value for name, value in os.environ.items() if name != "REDIS_URL"}
    with log.open("wb") as messages:
        process = subprocess.Popen(
            command, env=environment, start_new_session=True, stdout=messages, stderr=subprocess.STDOUT
        )
    try:
        with connected(f"http://127.0.0.1:{port}") as client:
            deadline_s = time.monotonic() + READY_TIMEOUT_S
            while not client.is_ready():
                if process.poll() is not None or time.monotonic() > deadline_s:
                    print("\n".join(log.read_text().splitlines()[-LOG_LINES_SHOWN:]), file=sys.stderr)
                    raise UnavailableError("The service did not become ready.", "Try `intrasplat doctor`.")
                time.sleep(READY_PERIOD_S)
            yield client
    finally:
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def free_port() -> int:
    """A free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def say(text: str) -> None:
    """Print a line of progress."""
    print(f"demo: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
