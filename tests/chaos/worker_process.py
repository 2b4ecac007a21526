"""The supervisor as it is, with the points of tests/chaos/points.py and a stand-in for its device child."""

from __future__ import annotations

import os
import signal
import sys
import threading

from contract.runtime.settings import Settings
from tests.chaos.points import install_worker_points
from worker.supervisor import run_supervisor

REAL_CHILD = "INTRASPLAT_CHAOS_REAL_CHILD"
"""Set: the device child is the real one, too."""

if __name__ == "__main__":
    install_worker_points()
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    stand_in = [sys.executable, "-m", "tests.chaos.trainer"]
    run_supervisor(Settings.from_environment(), end, None if REAL_CHILD in os.environ else stand_in)
