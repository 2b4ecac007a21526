"""Check and time the GPU kernels: one command that ends within seven minutes and needs no network.

    make gpu-check [PYTHON=python3] [ARGS="--clip FOLDER --out lab/rows"]
    python -m lab.gpu.check --interpret --out FOLDER     the same on tiny sizes, in Triton's interpreter

Three parts run in this order: correct.py checks the kernels, speed.py times steps and pictures, train.py measures how
soon training reaches a given quality. Each part is a process with a deadline and writes OUT/gpu-*.csv row by row. If a
kernel is wrong, the other parts still run, every row of theirs says so, and the exit code is 1. Without a GPU there is
nothing to check: exit code 5. make prints the code and ends with 2 itself.

--clip names a recording in the EndoNeRF layout, which brings its depth; without it the check makes synthetic tissue.
An option that cannot be used ends the check before it begins: exit code 2.
This file imports only the standard library, so that it can say what is missing.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent.parent
ROWS = REPOSITORY / "lab" / "rows"
UNAVAILABLE = 5
"""As intrasplat/commands/exits.py has it."""
CLIP_HAS = ("images", "depth", "poses_bounds.npy")
"""In the folder of a recording in the EndoNeRF layout."""
GRACE_S = 5.0
"""After its deadline a part may write what it holds; then it is killed."""
LOOK = (
    "import json, cv2, numba, pydantic, scipy, intrasplat.machine.gpu; gpu = intrasplat.machine.gpu.find_gpu(); "
    "print(json.dumps([gpu.missing, gpu.remedy]))"
)


@dataclass(frozen=True)
class CheckPart:
    """A part: its program, and its seconds, to which those are added that earlier parts did not use."""

    name: str
    seconds: float
    folder: Path = HERE

    @property
    def program(self) -> Path:
        return self.folder / f"{self.name}.py"

    def files(self, out: Path) -> list[Path]:
        """What it writes."""
        names = [self.name, "curves"] if self.name == "train" else [self.name]
        return [out / f"gpu-{name}.csv" for name in names]


PARTS = (CheckPart("correct", 140), CheckPart("speed", 115), CheckPart("train", 160))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clip", type=Path, help="folder of a recording in the EndoNeRF layout")
    parser.add_argument("--out", type=Path, help="folder of the CSV files (default: lab/rows)")
    parser.add_argument("--only", nargs="*", choices=[part.name for part in PARTS], help="these parts alone")
    parser.add_argument("--seed", type=int, help="of all that is random (default: another every time; it is printed)")
    parser.add_argument("--interpret", action="store_true", help="tiny sizes in Triton's interpreter; needs --out")
    arguments = parser.parse_args()
    if arguments.interpret and (arguments.out or ROWS).resolve() == ROWS:
        parser.error("--interpret measures nothing: name a folder for its files with --out, other than lab/rows")
    if arguments.clip and (problem := clip_problem(arguments.clip)):
        parser.error(problem)
    missing, remedy = ("", "") if arguments.interpret else what_is_missing()
    if missing:
        print(f"gpu-check: {missing}, as {sys.executable} has it. {remedy}.", file=sys.stderr)
        print("gpu-check: nothing was checked and nothing was written.", file=sys.stderr)
        return UNAVAILABLE
    seed = int(time.time()) if arguments.seed is None else arguments.seed
    out = (arguments.out or ROWS).resolve()
    out.mkdir(parents=True, exist_ok=True)
    chosen = [part for part in PARTS if arguments.only is None or part.name in arguments.only]
    print(f"gpu-check: seed {seed}, rows in {out}", flush=True)
    with tempfile.TemporaryDirectory(prefix="gpu-check-") as work:
        options = ["--out", str(out), "--work", work, "--seed", str(seed)]
        options += ["--clip", str(arguments.clip.resolve())] if arguments.clip else []
        options += ["--interpret"] if arguments.interpret else []
        for path in [path for part in chosen for path in part.files(out)]:
            path.unlink(missing_ok=True)  # an earlier run's rows must not pass for this one's
        failures = run_parts(chosen, options, environment(Path(work), arguments.interpret))
    print_table(out, [part.name for part in chosen])
    for failure in failures:
        print(f"gpu-check: part {failure}; see above.", file=sys.stderr)
    return 1 if failures else 0


def clip_problem(path: Path) -> str:
    """Why this --clip cannot be used, and what to do; empty if it looks right."""
    lacking = [name for name in CLIP_HAS if not (path / name).exists()]
    if not lacking:
        return ""
    problem = "does not exist" if not path.exists() else f"has no {', no '.join(lacking)}"
    problem = "is not a folder" if path.is_file() else problem
    return (
        f"--clip: {path.resolve()} {problem}. Name the folder that holds {', '.join(CLIP_HAS)} of a recording "
        "in the EndoNeRF layout, or leave --clip out to train on synthetic tissue."
    )


def what_is_missing() -> tuple[str, str]:
    """Why nothing can be checked here, and what to do about it; empty if everything is there."""
    command = [sys.executable, "-c", LOOK]
    look = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if look.returncode != 0:
        last = look.stderr.strip().splitlines()[-1:] or ["it ended without a word"]
        return (
            f"something it needs cannot be imported ({last[0]})",
            "Name a Python that has it: make gpu-check PYTHON=/path/to/python3",
        )
    missing, remedy = json.loads(look.stdout)
    return missing, remedy


def environment(work: Path, interpret: bool) -> dict[str, str]:
    """Variables of the parts: this checkout's modules, and caches that are empty at first and removed at the end."""
    own = {
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
        "PYTHONUNBUFFERED": "1",
        "TRITON_CACHE_DIR": str(work / "triton"),
    }
    if interpret:
        own["TRITON_INTERPRET"] = "1"  # and the CPU's kernels stay where they are kept: tests need not compile them
    else:
        own["INTRASPLAT_CACHE"] = str(work / "kernels")
    return {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"} | own


def run_parts(parts: list[CheckPart], options: list[str], variables: dict[str, str]) -> list[str]:
    """Run the parts one after the other while prepare.py runs; returns what failed, in words."""
    failures, doubt, deadline = [], "", time.time()
    prepare = [
        sys.executable,
        str(HERE / "prepare.py"),
        *options,
        "--deadline",
        str(deadline + sum(part.seconds for part in parts)),
    ]
    with subprocess.Popen(prepare, env=variables, stdout=subprocess.DEVNULL) as prepared:
        try:
            for part in parts:
                deadline += part.seconds
                print(f"== {part.name}: until {time.strftime('%H:%M:%S', time.localtime(deadline))}", flush=True)
                command = [sys.executable, str(part.program), *options, "--deadline", str(deadline), "--doubt", doubt]
                own = dict(variables)
                if part.name == "correct":  # what it compiles must not make the time of compilation look short
                    own["TRITON_CACHE_DIR"] += "-of-checks"
                problem = _failure(command, own, deadline)
                if problem:
                    failures.append(f"{part.name} {problem}")
                if problem and part.name == "correct":
                    doubt = f"the checks of the kernels {problem}"
        finally:
            prepared.kill()
    return failures


def _failure(command: list[str], variables: dict[str, str], deadline: float) -> str:
    """Run a part to its end or its deadline; returns how it failed in words, or an empty text."""
    try:
        limit_s = max(deadline - time.time(), 0) + GRACE_S
        status = subprocess.run(command, env=variables, timeout=limit_s, check=False).returncode
    except subprocess.TimeoutExpired:
        return "did not end in time and was killed"
    if status == 1:
        return "found something wrong, or broke off"
    return "" if status == 0 else f"ended with status {status}"


def print_table(out: Path, names: list[str]) -> None:
    """Print what the parts wrote; only the files have details and single kernels."""
    origin = ("believed", "machine", "gpu", "driver", "torch", "triton", "commit")
    for name in names:
        path = out / f"gpu-{name}.csv"
        if not path.exists():
            print(f"{name}: no rows")
            continue
        with path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if not row.get("what", "").startswith("kernel: ")]
        print(f"\n{name}: " + ", ".join(f"{key} {rows[0][key]}" for key in origin if rows[0][key]))
        columns = [key for key in rows[0] if key not in (*origin, "detail") and any(row[key] for row in rows)]
        widths = {key: max(len(key), *(len(row[key]) for row in rows)) for key in columns}
        for row in [dict(zip(columns, columns, strict=True)), *rows]:
            print("  " + "  ".join(f"{row[key]:<{widths[key]}}" for key in columns).rstrip())


if __name__ == "__main__":
    sys.exit(main())
