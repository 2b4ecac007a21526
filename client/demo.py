"""`make demo`: a synthetic clip goes through the real service, and pictures of what came back go into ./demo/."""

from __future__ import annotations

import csv
import io
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from client.api import Client, Image
from client.cli import progress_of
from contract.errors import IntrasplatError, UnavailableError
from contract.exits import ExitCode, exit_code_of
from contract.progress_bar import ProgressBar

OUT = Path("demo")
CLIP_OPTIONS = ("--frames", "48", "--width", "320", "--height", "256", "--seed", "3")
"""Small enough that clip, training and pictures take two or three minutes on two cores."""

BUDGET_S = 45.0
READY_TIMEOUT_S = 180.0
STOP_TIMEOUT_S = 40.0
TIMES = (0.0, 0.25, 0.5, 0.75)
VIEWS = {"endoscope": None, "right": "orbit:12,0,1", "above": "orbit:0,12,1", "near": "orbit:0,0,1.4"}


def main() -> int:
    """Run the demo; its exit codes are the command line's."""
    started_s = time.monotonic()
    OUT.mkdir(exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix="intrasplat-demo-") as folder:
            run(Path(folder), OUT)
    except IntrasplatError as error:
        print(f"demo: {error}", file=sys.stderr)
        return exit_code_of(error)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    print(f"\nThe demo took {time.monotonic() - started_s:.0f} s. Its pictures are in {OUT.resolve()}:")
    for path in sorted(OUT.iterdir()):
        print(f"  {OUT / path.name}")
    return ExitCode.OK


def run(folder: Path, out: Path) -> None:
    """Everything the demo does; `folder` is for what may be thrown away afterwards."""
    clip = folder / "clip"
    say("making a synthetic stereo clip of tissue with an instrument")
    made = subprocess.run([sys.executable, "-m", "worker", "phantom", *CLIP_OPTIONS, "--out", str(clip)], check=False)
    if made.returncode != 0:
        raise UnavailableError("The synthetic clip could not be made.", "Try `intrasplat doctor`.")
    with started_service(folder / "data") as client:
        say(f"sending it to POST {client.url}/reconstruct")
        job = client.reconstruct(
            clip / "stereo.webm",
            calibration=clip / "calibration.json",
            masks=clip / "masks.zip",
            budget_s=BUDGET_S,
        )
        with ProgressBar(sys.stderr) as bar:
            client.wait(job.id, on_progress=lambda now: bar.show(progress_of(now)))
        report = client.report(job.id)
        say(f"held-out psnr_tissue: {report['psnr_tissue_db']} dB; asking GET {client.url}/render for pictures")
        save_pictures(client, job.id, out)
        draw_curve(client.curve(job.id), baselines_of(report), out / "curve.png")
        (out / "curve.csv").write_text(client.curve(job.id))


def save_pictures(client: Client, scene: str, out: Path) -> None:
    """Several times and poses as PNG, and all of them on one sheet with the depth and the confidence."""
    sheet: list[tuple[str, Image]] = []
    for t in TIMES:
        image = client.render(t, scene=scene)
        (out / f"endoscope_t{t:.2f}.png").write_bytes(image.content)
        sheet.append((f"endoscope, t = {t:g}", image))
    for name, pose in VIEWS.items():
        if pose is not None:
            image = client.render(0.5, scene=scene, pose=pose)
            (out / f"{name}_t0.50.png").write_bytes(image.content)
            sheet.append((f"{name} ({pose}), t = 0.5", image))
    for layer in ("depth", "confidence"):
        image = client.render(0.5, scene=scene, layer=layer, format="jpeg")
        sheet.append((f"{layer}, t = 0.5", image))
    draw_sheet(sheet, out / "contact_sheet.png")


def draw_sheet(images: list[tuple[str, Image]], path: Path) -> None:
    """All images with their captions, three in a row."""
    figure, axes = _figure(columns=3, rows=-(-len(images) // 3), size=(4.0, 3.5))
    from matplotlib import image as reading

    for axis in axes:
        axis.axis("off")
    for axis, (caption, image) in zip(axes, images, strict=False):
        kind = image.media_type.removeprefix("image/")
        axis.imshow(reading.imread(io.BytesIO(image.content), format=kind))
        axis.set_title(caption, fontsize=10)
    figure.suptitle("Rendered by intrasplat from a synthetic clip; the instrument is not modelled", fontsize=12)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def draw_curve(curve_csv: str, baselines: dict[str, float], path: Path) -> None:
    """Speed against accuracy: held-out psnr_tissue over seconds of training, the copy baselines dashed."""
    points = [(float(row[0]), float(row[1])) for row in list(csv.reader(io.StringIO(curve_csv)))[1:]]
    figure, (axis,) = _figure(columns=1, rows=1, size=(7.5, 4.5))
    axis.plot([point[0] for point in points], [point[1] for point in points], marker="o", markersize=3)
    for number, (name, value_db) in enumerate(baselines.items()):
        axis.axhline(value_db, linestyle="--", color=f"C{number + 1}", label=name)
    axis.set_xlabel("seconds of training")
    axis.set_ylabel("psnr_tissue on held-out frames, dB")
    axis.grid(alpha=0.3)
    if baselines:
        axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def baselines_of(report: dict[str, Any]) -> dict[str, float]:
    """What copying neighbouring frames scores, by what the chart calls it."""
    stated = {
        "copying: neighbours blended": report["baseline_blend_db"],
        "copying: neighbours warped by optical flow": report["baseline_flow_db"],
    }
    return {name: value_db for name, value_db in stated.items() if value_db is not None}


def _figure(columns: int, rows: int, size: tuple[float, float]) -> tuple[Any, list[Any]]:
    """A figure that needs no display, and its axes in reading order."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # here: only the demo draws
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] * columns, size[1] * rows))
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


@contextmanager
def started_service(data_dir: Path) -> Iterator[Client]:
    """`intrasplat up` on a free port until the context ends."""
    port = free_port()
    command = [sys.executable, "-m", "client.cli", "up", "--port", str(port), "--data-dir", str(data_dir)]
    environment = {name: value for name, value in os.environ.items() if name != "REDIS_URL"}
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        with Client(f"http://127.0.0.1:{port}") as client:
            deadline_s = time.monotonic() + READY_TIMEOUT_S
            while not client.is_ready():
                if process.poll() is not None or time.monotonic() > deadline_s:
                    raise UnavailableError("The service did not become ready.", "Try `intrasplat doctor`.")
                time.sleep(0.2)
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
