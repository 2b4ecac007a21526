"""Programs that compile kernels for a GPU that need not be there (cuda_probe.py, stereo_probe.py), run from a test."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.conftest import REPOSITORY


def kernels_compiled_by(module: str, cache: Path) -> list[dict[str, Any]]:
    """What the program prints of every kernel; in a process of its own, without the interpreter."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment |= {"PYTHONPATH": str(REPOSITORY), "TRITON_CACHE_DIR": str(cache)}
    answer = subprocess.run(
        [sys.executable, "-m", module],
        cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    found: list[dict[str, Any]] = json.loads(answer.stdout)
    return found
