"""Whether an installation leaks memory, files or threads in an hour of clips, views, listeners, cancels and purges.

    python -m lab.benchmarks.bm_soak [--minutes 60] [--csv lab/rows/soak.csv]

Starts `intrasplat up` on a data directory of its own. Round after round a small synthetic clip is uploaded (in turn in
one request, resumable, and broken off in the middle), watched over SSE while it trains, viewed all the while by two
viewers over HTTP and one over the WebSocket, now and then cancelled, and purged. Every ten seconds resident memory,
open files and threads of service, supervisor, device child and Valkey are noted. At the end: the median of the three
minutes after the tenth against that of the last three, and the slope of the straight line through all samples after the
tenth minute. Of files and threads, which come and go with callers, the fewest in those minutes. A rise of memory by
more than 2 %, or of files or threads by more than two, is marked.
"""

from __future__ import annotations

import argparse
import csv
import random
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import linear_regression, median
from typing import Any
from urllib.parse import urlsplit

from intrasplat_client import Client, Conflict, IntrasplatError
from intrasplat_client.models import JobState
from lab.benchmarks.bm_service import PhantomClip, make_clip
from lab.demo import started_service
from lab.evaluate.rows import commit, machine

WIDTH, HEIGHT, FRAMES = 160, 128, 16
ROUND_ITERATIONS = 100
SAMPLE_PERIOD_S = 10.0
SETTLED_AFTER_MIN = 10.0
WINDOW_MIN = 3.0
ALLOWED_RISE = 0.02
ALLOWED_MORE = 2
VIEW_PAUSE_S = 0.1
MEASURES = ("rss_mib", "files", "threads")

Row = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--csv", type=Path, help="file that gets the samples")
    arguments = parser.parse_args()
    print(f"{machine()}, commit {commit()}, {arguments.minutes:g} minutes")
    with tempfile.TemporaryDirectory(prefix="intrasplat-soak-") as name:
        folder = Path(name)
        clip = make_clip(folder, WIDTH, HEIGHT, FRAMES)
        with started_service(folder / "data", folder / "service.log") as client:
            rows, rounds, counts = _soak(client.url, clip, folder / "data", arguments.minutes)
    print(f"{rounds} rounds, {len(rows)} samples; " + ", ".join(f"{each} {counts[each]}" for each in sorted(counts)))
    if arguments.csv:
        _write(arguments.csv, rows)
    return _judge(rows, arguments.minutes)


def _soak(url: str, clip: PhantomClip, data_dir: Path, minutes: float) -> tuple[list[Row], int, Counter[str]]:
    end = threading.Event()
    shown: list[str] = []  # the scene that is viewed now, if any
    counts: Counter[str] = Counter()
    rows: list[Row] = []
    rounds = 0
    deadline_s = time.monotonic() + 60 * minutes
    with ThreadPoolExecutor() as threads:
        beside = [threads.submit(_look, url, shown, end, counts) for _ in range(2)]
        beside.append(threads.submit(_look_through_socket, url, shown, end, counts))
        beside.append(threads.submit(_sample, data_dir, end, rows))
        try:
            while time.monotonic() < deadline_s and not any(each.done() for each in beside):
                _round(url, clip, rounds, shown)
                rounds += 1
        finally:
            end.set()
    for each in beside:
        each.result()  # raises the error that ended it too early
    return rows, rounds, counts


def _round(url: str, clip: PhantomClip, number: int, shown: list[str]) -> None:
    with Client(url) as client:
        if number % 3 == 2:
            _break_off(url, clip)
        job = client.reconstruct(
            clip.video,
            calibration=clip.calibration,
            iterations=ROUND_ITERATIONS,
            in_pieces=number % 3 == 1,
        )
        shown[:] = [job.id]
        is_cancelled = number % 5 != 4
        for last in client.watch(job.id):
            if not is_cancelled and last.stage == "train":
                is_cancelled = True
                with suppress(Conflict):  # it was done already
                    client.cancel(job.id)
        if last.state is JobState.DONE:
            client.render_array(t=0.5, scene=job.id)
        elif last.state is not JobState.CANCELLED:
            raise RuntimeError(f"job {job.id} ended as {last.state}: {last.error}")
        shown.clear()
        client.delete(job.id)


def _look(url: str, shown: list[str], end: threading.Event, counts: Counter[str]) -> None:
    with Client(url, patience_s=0.0) as client:
        while not end.wait(VIEW_PAUSE_S):
            with _counting("views", counts):
                client.render(t=random.random(), scene=shown[0], pose=_pose(), format="jpeg")


def _look_through_socket(url: str, shown: list[str], end: threading.Event, counts: Counter[str]) -> None:
    with Client(url, patience_s=0.0) as client:
        while not end.wait(VIEW_PAUSE_S):
            with _counting("streams", counts), client.stream(scene := shown[0]) as viewer:
                while shown == [scene] and not end.wait(VIEW_PAUSE_S):
                    with _counting("streamed views", counts):
                        viewer.render(t=random.random(), pose=_pose())


@contextmanager
def _counting(what: str, counts: Counter[str]) -> Iterator[None]:
    """Count answers, and refusals by type: the scene may not exist yet, or no longer."""
    try:
        yield
        counts[what] += 1
    except IndexError:
        pass
    except IntrasplatError as error:
        counts[type(error).__name__] += 1


def _break_off(url: str, clip: PhantomClip) -> None:
    """Start an upload and break it off in the middle."""
    address = urlsplit(url)
    body = clip.video.read_bytes()
    head = (
        f"POST /reconstruct HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Type: multipart/form-data; boundary=x\r\n"
        f"Content-Length: {len(body) + 500}\r\n\r\n--x\r\n"
        'Content-Disposition: form-data; name="clip"; filename="clip.webm"\r\n\r\n'
    )
    with socket.create_connection((address.hostname, address.port)) as connection:
        connection.sendall(head.encode() + body[: len(body) // 2])


def _pose() -> str:
    return f"orbit:{random.uniform(-15, 15):.1f},{random.uniform(-15, 15):.1f},1"


def _sample(data_dir: Path, end: threading.Event, rows: list[Row]) -> None:
    start_s = time.monotonic()
    while not end.wait(SAMPLE_PERIOD_S):
        for name, process_id in _processes(data_dir).items():
            with suppress(OSError):  # it has just ended
                rows.append({"minute": round((time.monotonic() - start_s) / 60, 2), "process": name,
                             **_figures(process_id)})  # fmt: skip


def _processes(data_dir: Path) -> dict[str, int]:
    """The installation's processes by role, found by their command lines and environments."""
    kinds = {"-m service": "service", "-m worker consume": "supervisor", "-m worker device": "device child"}
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with suppress(OSError):
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            ours = str(data_dir).encode() in (entry / "environ").read_bytes() or str(data_dir) in command
            for sign, kind in {**kinds, "queue.sock": "Valkey"}.items():
                if ours and sign in command:
                    found[kind] = int(entry.name)
    return found


def _figures(process_id: int) -> Row:
    folder = Path(f"/proc/{process_id}")
    status = dict(line.split(":\t", 1) for line in (folder / "status").read_text().splitlines() if ":\t" in line)
    return {
        "rss_mib": round(int(status["VmRSS"].split()[0]) / 1024, 1),
        "files": len(list((folder / "fd").iterdir())),
        "threads": int(status["Threads"]),
    }


def _judge(rows: list[Row], minutes: float) -> int:
    """Print before, after and slope for every process and measure. Returns 1 if one has grown too much."""
    grown = 0
    for process in dict.fromkeys(row["process"] for row in rows):
        for measure in MEASURES:
            settled = [
                (row["minute"], row[measure])
                for row in rows
                if row["process"] == process and row["minute"] >= SETTLED_AFTER_MIN
            ]
            first = [value for minute, value in settled if minute <= SETTLED_AFTER_MIN + WINDOW_MIN]
            last = [value for minute, value in settled if minute >= minutes - WINDOW_MIN]
            if not first or not last or minutes < SETTLED_AFTER_MIN + 2 * WINDOW_MIN:
                print(f"{process:13} {measure:8} too short a run to judge")
                continue
            is_memory = measure == "rss_mib"
            before, after = (median(values) if is_memory else min(values) for values in (first, last))
            allowed = before * ALLOWED_RISE if is_memory else ALLOWED_MORE
            mark = "GREW" if after - before > allowed else "ok"
            grown += mark != "ok"
            slope_per_hour = 60 * linear_regression(*zip(*settled, strict=True)).slope
            rise = 100 * (after / before - 1) if before else 0.0
            print(f"{process:13} {measure:8} {before:9.1f} -> {after:9.1f}  {rise:+6.2f} %  "
                  f"{slope_per_hour:+7.2f} an hour  {mark}")  # fmt: skip
    return 1 if grown else 0


def _write(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["minute", "process", *MEASURES])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(main())
