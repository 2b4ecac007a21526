"""Whether this tree trains the same scenes, bit for bit, as another commit.

    python benchmarks/same_bits.py [--commit 58d8859] [--cache FOLDER] [--only fast ...]

Trains two small phantom clips with each of PRESETS in both trees. Then it interrupts a run of each preset in this tree
and resumes it, which must give the bits of the commit's uninterrupted run. Prints SHA-256 of every scene.safetensors,
and exits with 1 if one differs. FOLDER keeps the clips and the commit's results for the next check.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
CLIPS = {
    "breathing": ("--motion", "breathing", "--format", "endonerf"),
    "cut": ("--motion", "cut", "--format", "video"),
}
SIZE = ("--width", "128", "--height", "96", "--frames", "12")
INTERRUPT_AFTER_S = 0.5
PRESETS = ("instant", "fast", "paper")


@dataclass(frozen=True)
class Case:
    """One scene: a clip, a preset, a length, and whether this tree interrupts and resumes its run."""

    clip: str
    preset: str
    iterations: int
    interrupted: bool = False

    @property
    def key(self) -> str:
        return f"{self.clip} {self.preset} {self.iterations}"


CASES = (
    *(Case(clip, preset, 200) for preset in PRESETS for clip in CLIPS),
    Case("breathing", "fast", 700, interrupted=True),  # with a warm restart
    Case("breathing", "paper", 700, interrupted=True),  # with densification
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commit", default="58d8859", help="what to compare with (default: %(default)s)")
    parser.add_argument("--cache", type=Path, help="keep the commit's clips and results here")
    parser.add_argument("--only", nargs="*", default=[case.preset for case in CASES], help="presets to check")
    options = parser.parse_args()
    cases = [case for case in CASES if case.preset in options.only]
    commit = _git("rev-parse", "--short=12", f"{options.commit}^{{commit}}")
    differing = 0
    with tempfile.TemporaryDirectory() as folder:
        kept = (options.cache or Path(folder)).resolve() / commit
        expected = baseline(commit, kept, cases)
        for case in cases:
            found = scene_digest(REPOSITORY, case, kept, interrupt=case.interrupted)
            same = found == expected[case.key]
            differing += not same
            how = "resumed" if case.interrupted else ""
            print(
                f"{case.key:<24}{how:<9}{expected[case.key][:12]}  {found[:12]}  {'same' if same else 'DIFFERS'}",
                flush=True,
            )
    return int(differing > 0)


def baseline(commit: str, kept: Path, cases: Sequence[Case]) -> dict[str, str]:
    """Digests of the commit's scenes by case; what `kept` lacks is trained in a temporary worktree."""
    results = kept / "results.json"
    digests: dict[str, str] = json.loads(results.read_text()) if results.exists() else {}
    missing = [case for case in cases if case.key not in digests]
    if not missing:
        return digests
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        _git("worktree", "add", "--detach", str(tree), commit)
        try:
            for name, options in CLIPS.items():
                if not (kept / name).exists():
                    _worker(tree, "phantom", *options, *SIZE, "--out", str(kept / name))
            for case in missing:
                digests.setdefault(case.key, scene_digest(tree, case, kept))
                results.write_text(json.dumps(digests, indent=1))
        finally:
            _git("worktree", "remove", "--force", str(tree))
    return digests


def scene_digest(tree: Path, case: Case, clips: Path, *, interrupt: bool = False) -> str:
    """SHA-256 of the scene.safetensors that the tree trains, interrupted and resumed on the way if asked."""
    clip = clips / case.clip
    stereo = [clip / "stereo.webm", "--calibration", clip / "calibration.json", "--masks", clip / "masks.zip"]
    files = map(str, stereo if (clip / "stereo.webm").exists() else [clip])
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "scene"
        length = ["--preset", case.preset, "--iterations", str(case.iterations), "--seed", "0"]
        arguments = ["reconstruct", *files, *length, "--out", str(out)]
        if interrupt:
            _interrupt(tree, arguments)
            assert (out / "resume.safetensors").exists(), "the run ended before it was interrupted"
        _worker(tree, *arguments)
        return hashlib.sha256((out / "scene.safetensors").read_bytes()).hexdigest()


def _start(tree: Path, arguments: Sequence[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "worker", *arguments],
        cwd=tree,
        env=os.environ | {"PYTHONPATH": str(tree)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def _worker(tree: Path, *arguments: str) -> None:
    process = _start(tree, arguments)
    _, errors = process.communicate()
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(arguments)} in {tree} ended with {process.returncode}:\n{errors}")


def _interrupt(tree: Path, arguments: Sequence[str]) -> None:
    """Start the command and send SIGINT soon after training has begun."""
    process = _start(tree, arguments)
    assert process.stderr is not None
    while (line := process.stderr.readline()) and line.strip() != "train":  # it writes a line a stage
        pass
    time.sleep(INTERRUPT_AFTER_S)
    process.send_signal(signal.SIGINT)
    process.communicate()


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=REPOSITORY, check=True, capture_output=True, text=True)
    return done.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
