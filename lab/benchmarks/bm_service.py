"""Latency and throughput of a whole installation under load, idle and while a job trains, in one run.

    python -m lab.benchmarks.bm_service [--seconds 10] [--queue-stop-s 60] [--upload-gib 1] [--job-only]
        [--csv lab/rows/service.csv]

Starts `intrasplat up` on a data directory of its own, trains a synthetic clip of 640x512 and then measures:
- GET /render as JPEG at 640x512, times and poses at random, by 1, 4 and 16 viewers that ask again when they are
  answered; ms at the viewer, all viewers' frames a second, and those of the viewer who got fewest. Idle, beside a job
  that trains another clip, and of that job itself, there also by 16 who all ask for its first view;
- GET /jobs/{id}, 200 a second whether answered or not, idle and beside training; ms from when each was due;
- six renders of 4096x2160 at once, and meanwhile views of 320x256 of another scene, one after the other;
- iterations a second of training, without viewers before and after each measurement of viewers, and with them; `slower`
  is by how much longer one takes with them, *_cpu how many cores worker, service and viewers use;
- views of a scene shown before and of one that was not, while the queue's server is stopped for --queue-stop-s.
Then uploads of --upload-gib GiB, in one request and resumable, with the service's memory before and at its peak.
Viewers, service, queue and worker share the machine's cores.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from intrasplat_client import Client
from lab.demo import started_service
from lab.evaluate.rows import commit, machine

WIDTH, HEIGHT, FRAMES = 640, 512, 48
SCENE_ITERATIONS = 300
VIEWERS = (1, 4, 16)
LARGE = {"width": "4096", "height": "2160", "format": "jpeg"}
SMALL = {"width": "320", "height": "256", "format": "jpeg"}
LARGE_AT_ONCE = 6
JOB_REQUESTS_A_SECOND = 200
SETTLED = 3
ENDLESS = 1_000_000  # iterations; the job is cancelled at the end
CHUNK_BYTES = 1 << 20
VIDEO = Path(__file__).parents[2] / "tests" / "data" / "stereo_sbs_h264.mp4"

PARTS = ("worker", "service", "viewers")
"""Processes whose CPU seconds per second are measured while a job trains."""

Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement")
    parser.add_argument("--upload-gib", type=float, default=1.0, help="0: no uploads")
    parser.add_argument("--queue-stop-s", type=float, default=60.0, help="0: the queue is not stopped")
    parser.add_argument("--job-only", action="store_true", help="only viewers of the job that trains")
    parser.add_argument("--csv", type=Path, help="file that gets a row a figure")
    arguments = parser.parse_args()
    origin = {"machine": machine(), "commit": commit()}
    print(f"{origin['machine']}, commit {origin['commit']}")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="intrasplat-load-") as name:
        folder = Path(name)
        clip = make_clip(folder)
        with started_service(folder / "data", folder / "service.log") as client:
            if arguments.job_only:
                busy = client.reconstruct(clip.video, calibration=clip.calibration, iterations=ENDLESS)
                wait_for_stage(client, busy.id, "train")
                _watched(client.url, busy.id, arguments.seconds)
                client.cancel(busy.id)
                return
            scene = trained(client, clip, iterations=SCENE_ITERATIONS)
            rows += asyncio.run(_under_load(client.url, scene, "idle", arguments.seconds))
            other, unseen = (trained(client, clip, iterations=1) for _ in range(2))
            rows += asyncio.run(_beside_large(client.url, scene, other, "idle"))
            if arguments.queue_stop_s:
                rows += _without_queue(client.url, folder / "data", scene, unseen, arguments.queue_stop_s)
            busy = client.reconstruct(clip.video, calibration=clip.calibration, iterations=ENDLESS)
            wait_for_stage(client, busy.id, "train")
            rows += asyncio.run(_under_load(client.url, scene, "training", arguments.seconds))
            rows += _watched(client.url, busy.id, arguments.seconds)
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
    command = [sys.executable, "-m", "lab", "phantom", *size, "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return PhantomClip(out / "stereo.webm", out / "calibration.json")


def trained(client: Client, clip: PhantomClip, **options: Any) -> str:
    """The id of a finished scene of the clip."""
    job = client.reconstruct(clip.video, calibration=clip.calibration, **options)
    return client.wait(job.id).id


def wait_for_stage(client: Client, job_id: str, stage: str) -> None:
    """Wait until the job has reached the stage."""
    for job in client.watch(job_id):
        if job.stage == stage:
            return
    raise RuntimeError(f"job {job_id} ended before stage {stage}")


async def _under_load(url: str, scene: str, worker: str, seconds: float) -> list[Row]:
    rows = []
    limits = httpx.Limits(max_connections=256, max_keepalive_connections=256)
    async with httpx.AsyncClient(base_url=url, timeout=60, limits=limits) as http:
        for viewers in VIEWERS:
            rows.append(await _viewing(http, _random_view(scene), viewers, worker, seconds))
        spent_ms = await _open_loop(lambda: http.get(f"/jobs/{scene}"), JOB_REQUESTS_A_SECOND, seconds)
        rows.append(_row(f"GET /jobs/{{id}}, {JOB_REQUESTS_A_SECOND}/s", worker, spent_ms, len(spent_ms) / seconds))
    return rows


Query = Callable[[], dict[str, str]]


def _random_view(scene: str) -> Query:
    def query() -> dict[str, str]:
        pose = f"orbit:{random.uniform(-15, 15):.2f},{random.uniform(-15, 15):.2f},1"
        return {"scene": scene, "t": f"{random.random():.3f}", "pose": pose, "format": "jpeg"}

    return query


def _first_view(scene: str) -> Query:
    return lambda: {"scene": scene, "format": "jpeg"}


async def _viewing(
    http: httpx.AsyncClient, query: Query, viewers: int, worker: str, seconds: float, what: str = ""
) -> Row:
    """Run viewers, each of which sends its next request as soon as it is answered."""
    end_s = time.perf_counter() + seconds
    spent_ms: list[list[float]] = [[] for _ in range(viewers)]

    async def view(own_ms: list[float]) -> None:
        while (start_s := time.perf_counter()) < end_s:
            answer = await http.get("/render", params=query())
            if answer.status_code == httpx.codes.SERVICE_UNAVAILABLE:
                await asyncio.sleep(float(answer.headers["Retry-After"]))
                continue
            answer.raise_for_status()
            own_ms.append(1e3 * (time.perf_counter() - start_s))

    await asyncio.gather(*(view(each) for each in spent_ms))
    name = f"GET /render, {viewers} viewer{'s' if viewers > 1 else ''}{what}"
    every_ms = [ms for each in spent_ms for ms in each]
    row = _row(name, worker, every_ms, len(every_ms) / seconds)
    row["least_per_s"] = round(min(len(each) for each in spent_ms) / seconds, 2)
    print(f"{'':28} the viewer who got fewest: {row['least_per_s']}/s")
    return row


async def _beside_large(url: str, scene: str, other: str, worker: str) -> list[Row]:
    """Time small views of another scene during six simultaneous large renders."""
    async with httpx.AsyncClient(base_url=url, timeout=60) as http:

        async def view(of: str, size: dict[str, str]) -> tuple[int, float]:
            start_s = time.perf_counter()
            pose = f"orbit:{random.uniform(-15, 15):.2f},0,1"
            answer = await http.get("/render", params={"scene": of, "pose": pose, **size})
            return answer.status_code, 1e3 * (time.perf_counter() - start_s)

        await view(other, SMALL)  # loads it
        large = [asyncio.create_task(view(scene, LARGE)) for _ in range(LARGE_AT_ONCE)]
        small_ms: list[float] = []
        while not all(task.done() for task in large):
            status, ms = await view(other, SMALL)
            if status != httpx.codes.OK:
                raise RuntimeError(f"a small view was answered {status}")
            small_ms.append(ms)
        answers = [task.result() for task in large]
    statuses = [status for status, _ in answers]
    print(f"{LARGE_AT_ONCE} renders of 4096x2160 at once: {statuses}, {max(ms for _, ms in answers):.0f} ms in all")
    row = _row("GET /render, 320x256 beside 6 of 4096x2160", worker, small_ms, 1e3 * len(small_ms) / sum(small_ms))
    row["max_ms"] = round(max(small_ms), 1)
    print(f"{'':28} at most {row['max_ms']} ms")
    return [row]


def _without_queue(url: str, data_dir: Path, seen: str, unseen: str, seconds: float) -> list[Row]:
    """Time views while the queue's server is stopped: it accepts connections and does not answer."""
    server = process(lambda command, _: str(data_dir / "valkey").encode() in command)
    spent_ms: list[float] = []
    os.kill(server, signal.SIGSTOP)
    try:
        end_s = time.perf_counter() + seconds
        with httpx.Client(base_url=url, timeout=60) as http:
            while time.perf_counter() < end_s:
                for scene in (seen, unseen):
                    start_s = time.perf_counter()
                    http.get("/render", params={"scene": scene, **SMALL}).raise_for_status()
                    spent_ms.append(1e3 * (time.perf_counter() - start_s))
                time.sleep(0.2)
    finally:
        os.kill(server, signal.SIGCONT)
    row = _row(f"GET /render, queue stopped for {seconds:g} s", "idle", spent_ms, len(spent_ms) / seconds)
    row["max_ms"] = round(max(spent_ms), 1)
    print(f"{'':28} at most {row['max_ms']} ms")
    return [row]


def _watched(url: str, job_id: str, seconds: float) -> list[Row]:
    """Measure viewers of a training job, and its iterations per second with them and without."""
    rows: list[Row] = []
    parts = (
        process(lambda command, _: command.endswith(b"\0-m\0worker\0device\0")),
        _service_process(url),
        os.getpid(),
    )
    cases = [(1, "", _random_view), (16, "", _random_view), (16, " of one view", _first_view)]
    with _followed(url, job_id) as rate:
        alone = [rate(lambda: time.sleep(seconds))]
        for viewers, what, query in cases:
            viewing = _view_for(url, query(job_id), viewers, seconds, what)
            start_s, before = time.perf_counter(), [_cpu_s(each) for each in parts]
            per_s = rate(lambda viewing=viewing: rows.append(asyncio.run(viewing)))  # type: ignore[misc]
            passed_s = time.perf_counter() - start_s
            cpu = [(_cpu_s(each) - used_s) / passed_s for each, used_s in zip(parts, before, strict=True)]
            alone.append(rate(lambda: time.sleep(seconds)))
            slower = (alone[-2] + alone[-1]) / 2 / per_s - 1
            used = {f"{name}_cpu": round(each, 2) for name, each in zip(PARTS, cpu, strict=True)}
            print(f"{'':28} training: {per_s:.2f} iterations/s, {alone[-2]:.2f} before, {alone[-1]:.2f} after:"
                  f" each takes {slower:.0%} longer; cores used: {used}")  # fmt: skip
            rows[-1] |= {"iterations_per_s": round(per_s, 2), "slower": round(slower, 3), **used}
    return rows


def _cpu_s(process_id: int) -> float:
    """CPU seconds that a process has used (Linux)."""
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def _view_for(url: str, query: Query, viewers: int, seconds: float, what: str) -> Row:
    async with httpx.AsyncClient(base_url=url, timeout=60) as http:
        return await _viewing(http, query, viewers, "the job", seconds, what)


@contextmanager
def _followed(url: str, job_id: str) -> Iterator[Callable[[Callable[[], None]], float]]:
    """Yield a function that returns the job's iterations per second while another function runs."""
    points: list[tuple[float, int]] = []

    def follow() -> None:
        with Client(url) as client, suppress(Exception):
            for job in client.watch(job_id):
                if job.iteration is not None and (not points or job.iteration > points[-1][1]):
                    points.append((time.perf_counter(), job.iteration))

    def rate(work: Callable[[], None]) -> float:
        start_s = time.perf_counter()
        work()
        (first_s, first), *_, (last_s, last) = [each for each in points if each[0] >= start_s]
        return (last - first) / (last_s - first_s)

    threading.Thread(target=follow, daemon=True).start()
    while len(points) < SETTLED:  # the first may be of some time ago
        time.sleep(0.1)
    yield rate


async def _open_loop(ask: Callable[[], Awaitable[httpx.Response]], a_second: int, seconds: float) -> list[float]:
    """Send a fixed number of requests per second, answered or not. Measures ms from when each was due."""
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
    """Upload a video with `gib` GiB of padding, which is received, hashed and stored like any other."""
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
    """The process id of the service at this address, found by its environment (Linux)."""
    sign = f"INTRASPLAT_PORT={httpx.URL(url).port}\0".encode()
    return process(lambda command, entry: command.endswith(b"\0-m\0service\0") and sign in _environment(entry))


def _environment(entry: Path) -> bytes:
    return (entry / "environ").read_bytes()


def process(is_it: Callable[[bytes, Path], bool]) -> int:
    """The id of the process whose command line and /proc folder satisfy `is_it` (Linux)."""
    for entry in Path("/proc").iterdir():
        with suppress(OSError):  # the process has just ended, or belongs to another user
            command = (entry / "cmdline").read_bytes() if entry.name.isdigit() else b""
            if command and is_it(command, entry):
                return int(entry.name)
    raise RuntimeError("there is no such process")


def memory_mib(process_id: int, field: str = "VmRSS") -> float:
    """Resident memory of a process in MiB; with field VmHWM its peak (Linux)."""
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
