"""A device child without torch: `python standin.py` does to each attempt what its clip says.

The clip's text is a list of words, one for each attempt; the last stands for all further ones.

    publish    advance, write a scene, finish, score it  wait     advance until told to stop, keep the state
    unscored   as publish, but die while scoring         scoring  as publish, but score until told to stop
    fail       fail with an InputError's fields          deaf     advance for ever
    noise      print what is no report, then publish     hang     advance once, then say nothing for ever
    slow       advance for two seconds, then publish     exit     end with status 3
    full       fail because the disk is full
    SIGKILL, SIGSEGV, ...   die of that signal

The words "unable" and "dies", as arguments of the program, spoil its start.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

STATE = "resume.safetensors"
UNKNOWN = (
    "psnr_paper_db", "ssim", "baseline_blend_db", "baseline_flow_db", "depth_agreement_mm", "coverage",
    "train_psnr_tissue_db",
)  # fmt: skip
REPORT: dict[str, Any] = {
    **dict.fromkeys(UNKNOWN), "psnr_tissue_db": 30.0, "warnings": [], "assumptions": [], "preset": "fast", "seed": 0,
    "device": "cpu", "iterations": 1000, "seconds": {}, "gaussians": 1, "bases": 1, "scene_bytes": 1,
    "units_per_mm": 1.0, "width": 8, "height": 8, "frame_count": 2, "train_count": 1, "held_out": [1], "repeated": [],
    "frame_times_s": [0.0, 0.1],
}  # fmt: skip


def tell(kind: str, **fields: object) -> None:
    """One report; a supervisor that was killed just now hears none."""
    try:
        print(json.dumps({"kind": kind, **fields}), flush=True)
    except BrokenPipeError:
        os._exit(0)


def advance(step: int, **fields: object) -> None:
    """Say that training has come to this step of 1000."""
    progress = {"stage": "train", "fraction": step % 1000 / 1000, "iteration": step, "iterations": 1000}
    tell("advanced", progress=progress | fields)


def publish(out: Path, resume_dir: Path) -> None:
    """A scene that went on from what an earlier attempt kept."""
    advance(500, psnr_db=30.0, psnr_right_db=28.0, seconds_left=1.0)
    steps = (resume_dir / STATE).read_text() if (resume_dir / STATE).exists() else ""
    (out / "manifest.json").write_text(json.dumps({"went_on_from": steps, "files": {}}))
    (out / "curve.csv").write_text("psnr_tissue_db,psnr_right_db\n30,\n")
    (out / "report.json").write_text(json.dumps(REPORT | {"scored": False}))
    tell("finished")


def score(word: str, stop: threading.Event) -> None:
    """What follows a finished scene."""
    tell("advanced", progress={"stage": "score", "fraction": 0.5})
    if word == "unscored":
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "scoring":
        stop.wait()
        tell("stopped", checkpointed=False)
    else:
        tell("scored", report=REPORT)


def wait(out: Path, resume_dir: Path, stop: threading.Event) -> None:
    """Work that never ends by itself; each attempt leaves a mark in the state it keeps."""
    (out / "half").write_text("written")
    step = 0
    while not stop.wait(0.01):
        step += 1
        advance(step)
    with (resume_dir / STATE).open("a") as file:
        file.write("x")
    tell("stopped", checkpointed=True)


def run(word: str, out: Path, resume_dir: Path, stop: threading.Event) -> None:
    """One attempt."""
    if word in ("publish", "noise", "slow", "unscored", "scoring"):
        if word == "noise":
            print("a library's chatter\n{}", flush=True)
        for step in range(1, 21 if word == "slow" else 1):
            advance(step)
            time.sleep(0.1)
        publish(out, resume_dir)
        score(word, stop)
    elif word == "wait":
        wait(out, resume_dir, stop)
    elif word == "fail":
        (out / "half").write_text("written")
        error = {"problem": "they cover everything.", "field": "masks", "remedy": "Invert them."}
        tell("failed", error=error, fault="InputError")
    elif word == "full":
        error = {"code": "store_full", "problem": "The disk is full.", "remedy": "Make room."}
        tell("failed", error=error, fault="StoreFullError")
    elif word == "exit":
        os._exit(3)
    elif word.startswith("SIG"):
        advance(1)
        os.kill(os.getpid(), signal.Signals[word])
    for step in range(1, sys.maxsize) if word == "deaf" else (1,) if word == "hang" else ():
        advance(step)
        time.sleep(0.01)
    if word == "hang":
        time.sleep(3600)


def main() -> None:
    """Obey orders until they end."""
    if "dies" in sys.argv:
        sys.exit(7)
    if "unable" in sys.argv:
        lack = {"problem": "There is no such device.", "remedy": "Set INTRASPLAT_DEVICE."}
        Path(os.environ["INTRASPLAT_LAST_WORDS"]).write_text(json.dumps(lack))
        sys.exit(5)
    tell("ready", endpoint="ipc:///nowhere", device="cpu")
    tell("cached_scenes", scenes=["a" * 32])
    stop = threading.Event()
    for line in sys.stdin:
        order: dict[str, Any] = json.loads(line)
        if order["kind"] == "stop":
            stop.set()
            continue
        stop = threading.Event()
        record = order["record"]
        if order["kind"] == "score":
            threading.Thread(target=score, args=("publish", stop), daemon=True).start()
            continue
        words = (Path(order["spool"]) / record["files"]["clip"]).read_text().split()
        word = words[min(record["attempt"], len(words)) - 1]
        threading.Thread(
            target=run, args=(word, Path(order["out"]), Path(order["resume_dir"]), stop), daemon=True
        ).start()
    os._exit(0)


if __name__ == "__main__":
    main()
