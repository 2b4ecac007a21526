"""A process that does not read its orders holds nobody up."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from contract.runtime.supervised import Supervised
from tests.contract.queues import job
from worker.child import DeviceChild
from worker.order_writer import OrderWriter
from worker.orders import ScoreScene, StopJob, line_of

DEAF = (sys.executable, "-c", "import time; time.sleep(60)")
READER = (sys.executable, "-c", "import sys; print(len(sys.stdin.buffer.readline()), flush=True)")


def large_order() -> ScoreScene:
    """More than a pipe takes."""
    record = job().model_copy(update={"trace": "0" * (1 << 20)})
    return ScoreScene(record=record, spool=Path("a"), scene=Path("b"))


def test_an_order_that_is_not_read_is_given_at_once_and_the_process_can_be_stopped() -> None:
    supervised = Supervised("deaf process", DEAF, pipes=True, grace_s=0.2)
    supervised.watch()
    assert supervised.process is not None
    began_s = time.monotonic()
    child = DeviceChild(supervised.process, supervised.kill)
    child.send(large_order())
    child.send(StopJob())
    time.sleep(0.2)  # the thread waits for the process
    supervised.stop()
    assert time.monotonic() - began_s < 5.0


def test_a_large_order_is_whole() -> None:
    with subprocess.Popen(READER, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        OrderWriter(process.stdin).send(large_order())
        assert int(process.stdout.readline()) == len(line_of(large_order()))
