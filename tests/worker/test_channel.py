"""The device process's channel: it carries only reports, and the process ends with its orders."""

from __future__ import annotations

import subprocess
import sys

import pytest

from worker.orders import CachedScenes, StopJob, line_of, read_report

DEAF = "import time; from worker.channel import Orders; Orders.from_stdin(); time.sleep(60)"
CHATTY = """
import os
from worker.channel import Channel
from worker.orders import CachedScenes
channel = Channel.instead_of_stdout()
print("from Python", flush=True)
os.write(1, b"from a library")
for scenes in (("a",), ("a",), ("b",)):
    channel.send_if_new(CachedScenes(scenes=scenes))
"""


def run(program: str, orders: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([sys.executable, "-c", program], input=orders, capture_output=True, timeout=30, check=False)


@pytest.mark.parametrize(("orders", "status"), [(b"", 0), (line_of(StopJob()), 0), (b'{"kind": "dance"}\n', 1)])
def test_a_process_ends_with_its_orders_or_at_one_that_it_cannot_read(orders: bytes, status: int) -> None:
    assert run(DEAF, orders).returncode == status


def test_only_reports_leave_by_stdout_and_none_twice() -> None:
    said = run(CHATTY)
    assert [read_report(line) for line in said.stdout.splitlines()] == [
        CachedScenes(scenes=("a",)),
        CachedScenes(scenes=("b",)),
    ]
    assert b"from Python" in said.stderr
    assert b"from a library" in said.stderr
