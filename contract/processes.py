"""Ending a child process: politely first."""

from __future__ import annotations

import subprocess


def end_process(process: subprocess.Popen[bytes], timeout_s: float) -> None:
    """Ask the process to end, insist after timeout_s, and wait for it."""
    process.terminate()
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
