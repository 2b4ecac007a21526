"""A process that is told to end hears it, wherever the signal finds it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from intrasplat.machine.processes import heeding_signals, set_niceness, starved_s

PROGRAM = """
import os, signal, sys, time
from intrasplat.machine.processes import shutdown_event
end = shutdown_event()
with end._cond:  # as end.wait() does for a moment
    os.kill(os.getpid(), int(sys.argv[1]))
    time.sleep(0.05)
end.wait()
print("ended")
"""


@pytest.mark.parametrize("number", [2, 15])
def test_a_signal_that_finds_the_main_thread_inside_the_event_is_heard_all_the_same(number: int) -> None:
    command = [sys.executable, "-c", PROGRAM, str(number)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    assert ended.stdout == "ended\n"


def test_after_the_with_statement_signals_do_what_they_did_before() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with heeding_signals() as end:
        signal.raise_signal(signal.SIGTERM)
        assert end.wait(10)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_process_and_its_session_become_nicer() -> None:
    with subprocess.Popen(["sleep", "60"], start_new_session=True) as process:
        niceness = max(7, os.nice(0))
        set_niceness(process.pid, niceness)
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == niceness
        group = Path(f"/proc/{process.pid}/autogroup")
        assert not group.exists() or group.read_text().split()[-1] == str(niceness)
        process.kill()
    set_niceness(process.pid, niceness)  # it is gone


STARVING = """
import os, time
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
while os.fork() and os.fork():
    time.sleep(60)
while time.process_time() < 10:
    pass
"""


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the system does not count it")
def test_children_that_share_a_core_starve() -> None:
    assert starved_s(os.getpid()) >= 0
    with subprocess.Popen([sys.executable, "-c", STARVING], start_new_session=True) as process:
        try:
            deadline_s = time.monotonic() + 30
            while starved_s(process.pid) < 0.3:
                assert time.monotonic() < deadline_s
                time.sleep(0.05)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
    assert starved_s(process.pid) == 0  # it is gone
