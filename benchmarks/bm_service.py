"""What a whole installation answers under load, idle and while a job trains, side by side in one run.

    python benchmarks/bm_service.py [--seconds 10] [--upload-gib 1] [--csv docs/results/service.csv]

Starts `intrasplat up` on a data directory of its own, trains a synthetic clip of 640x512 and then measures, each once
idle and once while another clip trains:
- GET /render as JPEG at 640x512, times and poses at random, by 1, 4 and 16 viewers that ask again when they are
  answered; ms at the viewer, and all viewers' frames a second;
- GET /jobs/{id}, 200 a second whether answered or not; ms from when each was due.
Then uploads of --upload-gib GiB, in one request and resumable, with the service's memory before and at its peak.
Viewers, service, queue and worker share the machine's cores.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import os
import random
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from client.demo import started_service
from intrasplat_client import Client
from worker.evaluate.rows import commit, machine

WIDTH, HEIGHT, FRAMES = 640, 512, 48
SCENE_ITERATIONS = 300
VIEWERS = (1, 4, 16)
JOB_REQUESTS_A_SECOND = 200
TRAINING_BUDGET_S = 1800  # longer than any of this takes; it is cancelled at the end
CHUNK_BYTES = 1 << 20
VIDEO = Path(__file__).parents[1] / "tests" / "data" / "stereo_sbs_h264.mp4"

Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement")
    parser.add_argument("--upload-gib", type=float, default=1.0, help="0: no uploads")
    parser.add_argument("--csv", type=Path, help="file that gets a row a figure")
    arguments = parser.parse_args()
    origin = {"machine": machine(), "commit": commit()}
    print(f"{origin['machine']}, commit {origin['commit']}")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="intrasplat-load-") as name:
        folder = Path(name)
        clip = make_clip(folder)
        with started_service(folder / "data", folder / "service.log") as client:
            scene = trained(client, clip, iterations=SCENE_ITERATIONS)
            rows += asyncio.run(_under_load(client.url, scene, "idle", arguments.seconds))
            busy = client.reconstruct(clip.video, calibration=clip.calibration, budget_s=TRAINING_BUDGET_S)
            wait_for_stage(client, busy.id, "train")
            rows += asyncio.run(_under_load(client.url, scene, "training", arguments.seconds))
            client.cancel(busy.id)
            if arguments.upload_gib:
                rows += _uploads(client.url, folder, arguments.upload_gib)
    if arguments.csv:
        _write(arguments.csv, [{**origin, **row} for row in rows])


@dataclass(frozen=True)
class PhantomClip:
    """A stereo video with its calibration, as the phantom wrote them."""

    video: Path
    calibration: Path


def make_clip(folder: Path, width: int = WIDTH, height: int = HEIGHT, frames: int = FRAMES) -> PhantomClip:
    """A synthetic stereo clip of width x height an eye."""
    size = ("--frames", str(frames), "--width", str(width), "--height", str(height))
    out = folder / "clip"
    command = [sys.executable, "-m", "worker", "phantom", *size, "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return PhantomClip(out / "stereo.webm", out / "calibration.json")


def trained(client: Client, clip: PhantomClip, **options: Any) -> str:
    """The id of a finished scene of the clip."""
    job = client.reconstruct(clip.video, calibration=clip.calibration, **options)
    return client.wait(job.id).id


def wait_for_stage(client: Client, job_id: str, stage: str) -> None:
    """Until the job has come to the stage."""
    for job in client.watch(job_id):
        if job.stage == stage:
            return
    raise RuntimeError(f"job {job_id} ended before stage {stage}")


async def _under_load(url: str, scene: str, worker: str, seconds: float) -> list[Row]:
    rows = []
    limits = httpx.Limits(max_connections=256, max_keepalive_connections=256)
    async with httpx.AsyncClient(base_url=url, timeout=60, limits=limits) as http:
        for viewers in VIEWERS:
            spent_ms = await _closed_loop(lambda: _view(http, scene), viewers, seconds)
            name = f"GET /render, {viewers} viewer{'s' if viewers > 1 else ''}"
            rows.append(_row(name, worker, spent_ms, len(spent_ms) / seconds))
        spent_ms = await _open_loop(lambda: http.get(f"/jobs/{scene}"), JOB_REQUESTS_A_SECOND, seconds)
        rows.append(_row(f"GET /jobs/{{id}}, {JOB_REQUESTS_A_SECOND}/s", worker, spent_ms, len(spent_ms) / seconds))
    return rows


async def _view(http: httpx.AsyncClient, scene: str) -> httpx.Response:
    pose = f"orbit:{random.uniform(-15, 15):.2f},{random.uniform(-15, 15):.2f},1"
    query = {"scene": scene, "t": f"{random.random():.3f}", "pose": pose, "format": "jpeg"}
    return await http.get("/render", params=query)


async def _closed_loop(ask: Callable[[], Awaitable[httpx.Response]], callers: int, seconds: float) -> list[float]:
    """Each caller asks again as soon as it is answered; ms of all answers."""
    end_s = time.perf_counter() + seconds
    spent_ms: list[float] = []

    async def call() -> None:
        while (start_s := time.perf_counter()) < end_s:
            (await ask()).raise_for_status()
            spent_ms.append(1e3 * (time.perf_counter() - start_s))

    await asyncio.gather(*(call() for _ in range(callers)))
    return spent_ms


async def _open_loop(ask: Callable[[], Awaitable[httpx.Response]], a_second: int, seconds: float) -> list[float]:
    """As many requests a second as said, whether answered or not; ms from when each was due."""
    start_s = time.perf_counter()
    spent_ms: list[float] = []

    async def call(due_s: float) -> None:
        (await ask()).raise_for_status()
        spent_ms.append(1e3 * (time.perf_counter() - due_s))

    async with asyncio.TaskGroup() as group:
        for number in range(round(a_second * seconds)):
            due_s = start_s + number / a_second
            await asyncio.sleep(max(0.0, due_s - time.perf_counter()))
            group.create_task(call(due_s))
    return spent_ms


def _row(work: str, worker: str, spent_ms: list[float], a_second: float) -> Row:
    p50, p99 = np.percentile(spent_ms, (50, 99))
    print(f"{work:28} worker {worker:9} p50 {p50:8.1f} ms  p99 {p99:8.1f} ms  {a_second:7.1f}/s")
    return {"work": work, "worker": worker, "p50_ms": round(p50, 1), "p99_ms": round(p99, 1),
            "per_s": round(a_second, 1), "answers": len(spent_ms)}  # fmt: skip


def _uploads(url: str, folder: Path, gib: float) -> list[Row]:
    """A video with so much padding behind it: received, hashed and stored like any other."""
    video = folder / "large.mp4"
    padding = round(gib * 2**30)
    with video.open("wb") as file:
        file.write(VIDEO.read_bytes() + struct.pack(">I4sQ", 1, b"free", 16 + padding))
        for _ in range(padding // CHUNK_BYTES):
            file.write(os.urandom(CHUNK_BYTES))
    service = _service_process(url)
    rows = []
    with Client(url) as client:
        for name, in_pieces in (("multipart", False), ("tus", True)):
            before_mib = memory_mib(service)
            _reset_peak(service)
            start_s = time.perf_counter()
            job = client.reconstruct(video, layout="sbs", in_pieces=in_pieces)
            seconds = time.perf_counter() - start_s
            peak_mib = memory_mib(service, "VmHWM")
            client.cancel(job.id)
            print(
                f"upload of {gib:g} GiB, {name}: {seconds:.1f} s, service {before_mib:.0f} MiB, peak {peak_mib:.0f} MiB"
            )
            rows.append({"work": f"upload {gib:g} GiB, {name}", "seconds": round(seconds, 1),
                         "before_mib": round(before_mib), "peak_mib": round(peak_mib)})  # fmt: skip
    return rows


def _service_process(url: str) -> int:
    """The process id of the service at this address, told by its environment (Linux)."""
    sign = f"INTRASPLAT_PORT={httpx.URL(url).port}\0".encode()
    for entry in Path("/proc").iterdir():
        with suppress(OSError):  # it has just ended, or is another user's
            command = (entry / "cmdline").read_bytes() if entry.name.isdigit() else b""
            if command.endswith(b"\0-m\0service\0") and sign in (entry / "environ").read_bytes():
                return int(entry.name)
    raise RuntimeError(f"no process serves {url}")


def memory_mib(process_id: int, field: str = "VmRSS") -> float:
    """Resident memory of a process now, or with field VmHWM at its peak (Linux)."""
    for line in Path(f"/proc/{process_id}/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) / 1024
    raise ValueError(f"process {process_id} has no {field}")


def _reset_peak(process_id: int) -> None:
    Path(f"/proc/{process_id}/clear_refs").write_text("5")


def _write(path: Path, rows: list[Row]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
