"""`make demo`: a synthetic clip goes through the real service, and pictures of what came back go into ./demo/."""

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
from client.pictures import Panel, draw_curve, draw_sheet, draw_strip
from client.remote import progress_of
from contract.runtime.exits import EXIT_CODES_HELP, ExitCode, exit_code_of
from contract.runtime.progress_bar import ProgressBar
from contract.wire.errors import IntrasplatError, UnavailableError
from intrasplat_client import Client, JobState, JobView, Report

FRAMES = 48
WIDTH, HEIGHT = 480, 384
SEED = 3
TRAINING = "train"
"""The stage as a job's view names it."""
BUDGET_S = 45.0
"""With these the demo takes two minutes on two quiet cores, and less than four on slow ones."""

HOLDOUT = "blocks8"
"""Eight frames hidden at a time, as behind an instrument: the stretch that copying neighbours cannot fill."""
READY_TIMEOUT_S = 180.0
READY_PERIOD_S = 1.0
STOP_TIMEOUT_S = 40.0
LOG_LINES_SHOWN = 20

SHOWN_FRAMES = (0, 12, 30, 42)
"""Of these 12 is held out; in 30 the instrument covers most."""
VIEWED_FRAME = 30
VIEWS = {"from the right": "orbit:12,0,1", "from the left": "orbit:-12,0,1", "from above": "orbit:0,12,1"}
NEAR = "orbit:0,0,1.6"
DEPTH_SHARE = (2, 98)
"""Percentiles of the depth that the colours span."""


def main() -> int:
    """Run the demo; its exit codes are the command line's."""
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
    parser = argparse.ArgumentParser(prog="python -m client.demo", description=__doc__, epilog=EXIT_CODES_HELP)
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder for the pictures (default: demo)")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="also draw the README's picture into this file")
    return parser


def _interrupt(*_: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not keep the service from being ended in order
    raise KeyboardInterrupt


def run(folder: Path, out: Path, picture: Path | None = None) -> dict[Path, str]:
    """Everything the demo does; `folder` is for what may be thrown away afterwards.

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
        client.wait(job.id)  # says why, if there is no scene
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
    """The first picture of a scene that training has changed, and still does, if there is one."""

    def __init__(self, url: str, path: Path) -> None:
        self._client = Client(url, patience_s=0.0)
        self._path = path
        self._began_s: float | None = None
        self._seconds: float | None = None

    def look(self, job: JobView) -> None:
        """Ask for it, now that the job is there; one that does not come is asked for next time."""
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
        """The file, and what it shows."""
        self._client.close()
        if self._seconds is None:
            return {}
        return {self._path: f"the model {self._seconds:.0f} s after training began, while it went on"}


def make_clip(clip: Path) -> Path:
    """A folder in StereoMIS layout: synthetic tissue that breathes, and an instrument in front of it."""
    say(f"making a stereo clip of synthetic tissue: {FRAMES} frames of {WIDTH} x {HEIGHT}, an instrument in front")
    size = ("--frames", str(FRAMES), "--width", str(WIDTH), "--height", str(HEIGHT), "--seed", str(SEED))
    command = [sys.executable, "-m", "worker", "phantom", *size, "--format", "stereomis", "--out", str(clip)]
    if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode != 0:
        raise UnavailableError("The synthetic clip could not be made.", "Try `intrasplat doctor`.")
    return clip


def zipped(clip: Path) -> Path:
    """The folder as one file that can be sent; PNGs are compressed already."""
    archive = clip.with_suffix(".zip")
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted(clip.rglob("*")):
            file.write(path, path.relative_to(clip))
    return archive


def recorded(clip: Path, frame: int) -> bytes:
    """The left eye's PNG."""
    return (clip / f"{frame:06d}l.png").read_bytes()


def time_of(frame: int) -> float:
    """Model time of a frame, as docs/conventions.md has it."""
    return frame / FRAMES


def save_renders(client: Client, scene: str, out: Path) -> dict[Path, str]:
    """Each shown time from the endoscope, and each view at one time, as PNG files of their own."""
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
    """All on one sheet: what was recorded, the same moments without the instrument, other views, geometry."""
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
    """Depth in mm and confidence, from the endoscope and from the first of the other views."""
    name, pose = next(iter(VIEWS.items()))
    panels = [depth_panel(client, scene, t, None, "depth"), depth_panel(client, scene, t, pose, f"depth {name}")]
    for where, caption in ((None, "confidence"), (pose, f"confidence {name}")):
        values = client.render(t, scene=scene, pose=where, layer="confidence", format="npy").array()
        panels.append(Panel(f"{caption}: 0 dark, 1 bright", values=values))
    return panels


def depth_panel(client: Client, scene: str, t: float, pose: str | None, caption: str) -> Panel:
    """Depth in mm; where nothing solid is, no colour."""
    import numpy as np  # the client needs it for arrays only

    depth_mm = client.render(t, scene=scene, pose=pose, layer="depth", format="npy").array()
    valid = np.where(depth_mm > 0, depth_mm, np.nan)
    low, high = (float(value) for value in np.nanpercentile(valid, DEPTH_SHARE))
    caption = f"{caption}: {low:.0f} mm bright, {high:.0f} mm dark"
    return Panel(caption, values=valid, colours="magma_r", limits=(low, high))


def strip_of(client: Client, scene: str, clip: Path) -> list[Panel]:
    """The README's picture: one moment recorded, without the instrument, from another side, and its depth."""
    t, (name, pose) = time_of(VIEWED_FRAME), next(iter(VIEWS.items()))
    return [
        Panel("recorded, left eye", recorded(clip, VIEWED_FRAME)),
        Panel("rendered: the instrument is gone", client.render(t, scene=scene).content),
        Panel(f"rendered 12 degrees {name}", client.render(t, scene=scene, pose=pose).content),
        depth_panel(client, scene, t, None, "its depth"),
    ]


def save_curve(curve_csv: str, report: Report, out: Path) -> dict[Path, str]:
    """The chart of speed against accuracy, and its numbers."""
    table, chart = out / "curve.csv", out / "curve.png"
    table.write_text(curve_csv)
    title = f"{len(report.frames)} of {FRAMES} frames held out, eight at a time; synthetic tissue, two eyes in"
    draw_curve(curve_csv, baselines_of(report), title, chart)
    return {chart: "accuracy over seconds of training, beside plain copying", table: "the same as numbers"}


def baselines_of(report: Report) -> dict[str, float]:
    """What copying neighbouring frames scores, by what the chart calls it."""
    stated = {
        "copying: neighbours blended": report.baseline_blend_db,
        "copying: neighbours warped by optical flow": report.baseline_flow_db,
    }
    return {name: value_db for name, value_db in stated.items() if value_db is not None}


def summary_of(report: Report) -> str:
    """The figures that tell how good the scene is."""
    copies = ", ".join(
        f"{name.removeprefix('copying: ')} {value:.1f} dB" for name, value in baselines_of(report).items()
    )
    return (
        f"{report.gaussians:,} Gaussians after {report.seconds['t_train_s']:.0f} s of training; "
        f"psnr_tissue {report.psnr_tissue_db:.1f} dB on {len(report.frames)} frames it never saw "
        f"(copying: {copies}); depth {report.depth_agreement_mm:.2f} mm from stereo"
    )


@contextmanager
def started_service(data_dir: Path, log: Path) -> Iterator[Client]:
    """`intrasplat up` on a free port until the context ends; its messages go into log.

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
    """A port of the loopback interface that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def say(text: str) -> None:
    """A line for whoever watches."""
    print(f"demo: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
