"""A decoder that the machine gives no core starves and does not hang."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from intrasplat.decode.contained import Patience
from tests.intrasplat.decode.stand_in import run_stand_in


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the system does not count it")
def test_a_decoder_that_has_no_core_has_more_time(tmp_path: Path) -> None:
    pinned = "import os, time; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])\n"
    hog = [sys.executable, "-c", f"{pinned}while time.process_time() < 10: pass"]
    hogs = [subprocess.Popen(hog, start_new_session=True) for _ in range(3)]
    try:
        work = "import time\nend_s = time.process_time() + 0.5\nwhile time.process_time() < end_s: pass"
        run_stand_in(tmp_path, work, before=pinned, patience=Patience(max_silence_s=1.0))
    finally:
        for each in hogs:
            each.kill()
            each.wait()
