"""Shared by all parts of check.py: folders, deadline, rows, and a clock of the device.

Each part is a process, so that an error in one, even of the device's memory, does not break another. A part writes each
row when it is measured, with the machine, the versions and the commit.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import median

import torch
import triton

from lab.evaluate.rows import commit, machine

ORIGIN = ("believed", "machine", "gpu", "driver", "torch", "triton", "commit")
CLIP, CLIP_READY, KERNELS_READY = "clip.npz", "clip.json", "kernels.json"
"""In the folder of work: the clip, and that it and the CPU's kernels are there (prepare.py)."""


@dataclass
class Part:
    """A part of the check.

    out, work    folders of its CSV file, and of what the parts hand on
    deadline     Unix time at which check.py ends it; it starts nothing that it cannot finish by then
    doubt        why its figures are unreliable; empty if they are reliable
    interpret    on tiny sizes in Triton's interpreter, where no duration means anything
    seed         of all that is random
    """

    name: str
    fields: tuple[str, ...]
    out: Path
    work: Path
    deadline: float
    doubt: str
    interpret: bool
    seed: int
    clip: str
    _begun: bool = field(default=False)

    @classmethod
    def begin(cls, name: str, fields: tuple[str, ...]) -> Part:
        """The part that the command line describes (check.py writes it)."""
        parser = argparse.ArgumentParser()
        parser.add_argument("--out", type=Path, required=True)
        parser.add_argument("--work", type=Path, required=True)
        parser.add_argument("--deadline", type=float, required=True)
        parser.add_argument("--seed", type=int, required=True)
        parser.add_argument("--doubt", default="")
        parser.add_argument("--clip", default="")
        parser.add_argument("--interpret", action="store_true")
        given = parser.parse_args()
        return cls(
            name, fields, given.out, given.work, given.deadline, given.doubt, given.interpret, given.seed, given.clip
        )

    @property
    def left_s(self) -> float:
        """Seconds until its end."""
        return self.deadline - time.time()

    def has(self, seconds: float, what: str) -> bool:
        """Whether so many seconds are left for this work; prints a line if not."""
        if self.left_s >= seconds:
            return True
        print(f"  {what}: skipped, only {max(self.left_s, 0):.0f} s are left", flush=True)
        return False

    @property
    def device(self) -> str:
        return "cpu" if self.interpret else "cuda"

    @cached_property
    def origin(self) -> dict[str, str]:
        """What the rows were measured on."""
        believed = f"no: {self.doubt}" if self.doubt else "yes"
        if self.interpret:
            gpu, driver = "none: Triton's interpreter", ""
            believed = "yes, but for durations" if believed == "yes" else believed
        else:
            gpu, driver = torch.cuda.get_device_name(0), _driver()
        values = (believed, machine(), gpu, driver, torch.__version__, triton.__version__, commit())
        return dict(zip(ORIGIN, values, strict=True))

    def add(self, **row: object) -> None:
        """Keep a row."""
        unknown = row.keys() - set(self.fields)
        if unknown:
            raise ValueError(f"rows of {self.name} have no {unknown}")
        path = self.out / f"gpu-{self.name}.csv"
        with path.open("a" if self._begun else "w", newline="") as file:
            writer = csv.DictWriter(file, (*self.fields, *ORIGIN), restval="", lineterminator="\n")
            if not self._begun:
                writer.writeheader()
            writer.writerow({name: _text(value) for name, value in {**row, **self.origin}.items()})
        self._begun = True

    def wait_for(self, name: str) -> dict[str, object]:
        """Wait for what prepare.py writes under this name, and return it.

        Raises:
            RuntimeError: prepare.py failed, or is not done in time.
        """
        path = self.work / name
        while not path.exists():
            if self.left_s < 1:
                raise RuntimeError(f"{name} was not prepared in time")
            time.sleep(0.2)
        told: dict[str, object] = json.loads(path.read_text())
        if "error" in told:
            raise RuntimeError(str(told["error"]))
        return told


def _text(value: object) -> str:
    if value is None or value != value:  # NaN alone differs from itself
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _driver() -> str:
    """Version of the NVIDIA driver, as nvidia-smi says; empty without it."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""


def synchronize(device: str) -> None:
    """Wait for the device."""
    if device == "cuda":
        torch.cuda.synchronize()


class Stamp:
    """A moment on the device's own clock; the host's where there is no device."""

    def __init__(self, device: str) -> None:
        self._event = (
            torch.cuda.Event(enable_timing=True) if device == "cuda" else None  # type: ignore[no-untyped-call]
        )
        self._at = time.perf_counter()
        if self._event is not None:
            self._event.record()

    def ms_until(self, later: Stamp) -> float:
        """Milliseconds; the device has to be done with both."""
        if self._event is None or later._event is None:
            return 1e3 * (later._at - self._at)
        elapsed: float = self._event.elapsed_time(later._event)
        return elapsed


def device_ms(call: Callable[[], object], device: str, *, calls: int, rounds: int) -> float:
    """Median ms of a call on the device, of rounds of so many calls one after the other, after one round untimed."""
    found = []
    for _ in range(rounds + 1):
        first = Stamp(device)
        for _ in range(calls):
            call()
        last = Stamp(device)
        synchronize(device)
        found.append(first.ms_until(last) / calls)
    return median(found[1:])


def wall_ms(call: Callable[[], object], device: str, *, calls: int, rounds: int) -> float:
    """Likewise on the host's clock, from the first call until the device is done."""
    found = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        for _ in range(calls):
            call()
        synchronize(device)
        found.append(1e3 * (time.perf_counter() - start) / calls)
    return median(found[1:])
