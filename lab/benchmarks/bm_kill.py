"""How much work a kill -9 costs: seconds until a killed job is again where it was.

    python -m lab.benchmarks.bm_kill CLIP [--calibration F] [--masks F] [--preset fast] [--budget-s 60] [--kills 20]

A queue and a worker as `intrasplat up` runs them, on the clip's job of --budget-s. The kills are spread evenly over
--length-s of the job; in turn they end the device process and the whole worker, which is started again at once. Prints
for each the place of the job, when it was claimed again (counted from the kill), when training was reported again
(counted from the claim), and the work lost: from the claim until the job is where it was when it was killed. Linux
only.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from contract.queue.embedded import EmbeddedServer
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.job import JobFiles, JobOptions, JobRecord, JobState

STAGES = ("fetch", "decode", "stereo", "compile", "motion", "fusion", "start", "calibrate", "train", "finish")
"""In their order; what comes later counts as farther."""
POLL_S = 0.02
MAX_WAIT_S = 300.0
Place = tuple[int, int, float]


@dataclass(frozen=True)
class Kill:
    """What became of one kill.

    place         of the job when it was killed
    claimed_s     until it was claimed again
    trains_s      from the claim to training; None where the job had not come so far before
    went_on_from  the iteration then
    lost_s        from the claim until the job was at its place again
    """

    place: Place
    claimed_s: float
    trains_s: float | None
    went_on_from: str
    lost_s: float


class Worker:
    """`python -m worker consume`, started again whenever it has ended."""

    def __init__(self, settings: Settings) -> None:
        self._environment = {**os.environ, **settings.to_environment()}
        self._process: subprocess.Popen[bytes] | None = None

    def keep(self) -> None:
        """Start it unless it runs."""
        if self._process is None or self._process.poll() is not None:
            command = [sys.executable, "-m", "worker", "consume"]
            self._process = subprocess.Popen(command, env=self._environment, stderr=subprocess.DEVNULL)

    def kill(self, *, child_alone: bool) -> None:
        """kill -9 of the device process, or of the worker, with which its child dies."""
        assert self._process is not None
        victim = self._process.pid
        if child_alone:
            victim = int(Path(f"/proc/{victim}/task/{victim}/children").read_text().split()[0])
        os.kill(victim, signal.SIGKILL)

    def end(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--masks", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--budget-s", type=float, default=60.0)
    parser.add_argument("--length-s", type=float, default=66.0, help="of the job from its claim, here")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the kills to make, from 0")
    options = parser.parse_args()
    lost_s, claimed_s = [], []
    print("kill  victim  after s  at              from  claimed s  trains s  lost s", flush=True)
    with _installation() as (queue, store, worker):
        for number in options.only or range(options.kills):
            after_s = (number + 0.5) * options.length_s / options.kills
            child_alone = number % 2 == 0
            record = _submit(queue, store, options)
            row = _one(queue, worker, record.job_id, after_s, child_alone=child_alone)
            queue.cancel(record.job_id)
            _wait(worker, lambda job_id=record.job_id: _ended(queue, job_id))  # type: ignore[misc]
            if row is None:
                print(f"{number:4}  the job had ended after {after_s:.1f} s", flush=True)
                continue
            lost_s.append(row.lost_s)
            claimed_s.append(row.claimed_s)
            victim = "child" if child_alone else "worker"
            at = f"{STAGES[row.place[0]]} {row.place[1]}"
            trains = "" if row.trains_s is None else f"{row.trains_s:.1f}"
            times = f"{row.claimed_s:9.1f}  {trains:>8}  {row.lost_s:6.1f}"
            print(f"{number:4}  {victim:6}  {after_s:7.1f}  {at:13}  {row.went_on_from:>5}  {times}", flush=True)
    print(f"work lost: median {median(lost_s):.1f} s, worst {max(lost_s):.1f} s of {len(lost_s)} kills")
    print(f"claimed again: median {median(claimed_s):.1f} s, worst {max(claimed_s):.1f} s")


@contextmanager
def _installation() -> Iterator[tuple[RedisQueue, Store, Worker]]:
    with tempfile.TemporaryDirectory(prefix="intrasplat-kill-") as folder:
        server = EmbeddedServer(Path(folder))
        server.start()
        queue, store = RedisQueue(server.url), Store(Path(folder))
        worker = Worker(Settings(data_dir=store.data_dir, redis_url=server.url))
        try:
            _wait(worker, lambda: bool(queue.workers()))
            yield queue, store, worker
        finally:
            worker.end()
            queue.close()
            server.stop()


def _submit(queue: RedisQueue, store: Store, options: argparse.Namespace) -> JobRecord:
    """The clip's job, accepted and queued."""
    job_id, names = new_job_id(), {}
    folder = store.open_incoming(job_id)
    for name in ("clip", "calibration", "masks"):
        path = getattr(options, name)
        if path is not None:
            names[name] = f"{name}{path.suffix}"
            shutil.copyfile(path, folder / names[name])
    chosen = JobOptions.model_validate({"preset": options.preset, "budget_s": options.budget_s})
    record = JobRecord(job_id=job_id, files=JobFiles(**names), options=chosen, created_at_s=time.time())
    store.accept(record)
    return queue.submit(record)


def _one(queue: RedisQueue, worker: Worker, job_id: str, after_s: float, *, child_alone: bool) -> Kill | None:
    """Kill once and watch; None if the job had ended before."""
    _wait(worker, lambda: _attempt(queue, job_id) == 1)
    time.sleep(after_s)
    place, first = _place(queue, job_id), _attempt(queue, job_id)
    if _ended(queue, job_id):
        return None
    worker.kill(child_alone=child_alone)
    killed_s = time.monotonic()
    _wait(worker, lambda: _attempt(queue, job_id) > first)
    claimed_s = time.monotonic()
    trains_s: float | None = None
    went_on_from = ""
    while not _ended(queue, job_id):
        worker.keep()
        now = _place(queue, job_id)
        if trains_s is None and now[0] >= STAGES.index("train"):
            trains_s, went_on_from = time.monotonic() - claimed_s, str(now[1])
        if now >= place and (trains_s is not None or place[0] < STAGES.index("train")):
            break
        time.sleep(POLL_S)
    return Kill(place, claimed_s - killed_s, trains_s, went_on_from, time.monotonic() - claimed_s)


def _attempt(queue: RedisQueue, job_id: str) -> int:
    record = queue.get(job_id)
    return record.attempt if record is not None and record.state is not JobState.QUEUED else 0


def _ended(queue: RedisQueue, job_id: str) -> bool:
    record = queue.get(job_id)
    return record is None or record.state not in (JobState.QUEUED, JobState.RUNNING)


def _place(queue: RedisQueue, job_id: str) -> Place:
    """How far the job has come, by its last report."""
    record = queue.get(job_id)
    told = record.progress if record is not None else None
    if told is None:
        return 0, 0, 0.0
    stage = STAGES.index(told.stage) if told.stage in STAGES else len(STAGES) - 1
    return stage, told.iteration, told.fraction


def _wait(worker: Worker, holds: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + MAX_WAIT_S
    while not holds():
        if time.monotonic() > deadline_s:
            raise TimeoutError("the worker does not come so far")
        worker.keep()
        time.sleep(POLL_S)


if __name__ == "__main__":
    main()
