"""A supervised process comes back after a crash, ends when it is told to, and says what it lacks."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from contract.runtime import supervised
from contract.runtime.supervised import ProcessEnd, Supervised, cause_of
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import UnavailableError

SLEEP = "import time; time.sleep(60)"
LACKS = """
from intrasplat.errors import UnavailableError
from intrasplat.commands.exits import end_by
raise SystemExit(end_by(UnavailableError("There is no such device.", "Set INTRASPLAT_DEVICE.")))
"""


def running(program: str, **options: Any) -> Supervised:
    return Supervised("child", [sys.executable, "-c", program], **options)


def watch_until_ended(child: Supervised) -> ProcessEnd:
    """Start the child, wait for its end, and watch once more."""
    child.watch()
    return next_end(child)


def next_end(child: Supervised) -> ProcessEnd:
    """Wait for the end of the child that runs."""
    assert child.process_id is not None
    os.waitid(os.P_PID, child.process_id, os.WEXITED | os.WNOWAIT)
    ended = child.watch()
    assert ended is not None
    return ended


def test_a_killed_child_is_started_again_after_a_pause() -> None:
    child = running(SLEEP)
    assert child.watch() is None
    first = child.process_id
    assert first is not None
    os.kill(first, signal.SIGTERM)
    deadline_s = time.monotonic() + 10.0
    while child.process_id in (first, None):
        assert time.monotonic() < deadline_s
        child.watch()
        time.sleep(0.02)
    child.stop()
    assert child.process_id is None


def test_the_pause_doubles_up_to_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervised, "MAX_PAUSE_S", 0.03)
    monkeypatch.setattr(supervised, "FIRST_PAUSE_S", 0.01)
    child = running("raise SystemExit(1)")
    pauses_s = []
    for _ in range(4):
        pauses_s.append(watch_until_ended(child).pause_s)
        time.sleep(pauses_s[-1])
    assert pauses_s == [0.01, 0.02, 0.03, 0.03]
    child.stop()


def test_a_healthy_child_is_replaced_at_once() -> None:
    child = running(SLEEP)
    child.watch()
    child.mark_healthy()
    child.kill()
    assert child.watch() == ProcessEnd(-signal.SIGKILL, "was killed by its supervisor", 0.0)
    assert child.process_id is not None
    child.stop()


def test_a_child_that_has_run_long_enough_is_healthy() -> None:
    child = running("raise SystemExit(1)", healthy_after_s=0.0)
    assert watch_until_ended(child) == ProcessEnd(1, "ended with status 1", 0.0)
    child.stop()


@pytest.mark.parametrize("status", [code for code in ExitCode if code != ExitCode.UNAVAILABLE])
def test_every_end_but_one_is_followed_by_another_start(status: int, tmp_path: Path) -> None:
    child = running(f"raise SystemExit({int(status)})", last_words=tmp_path / "words")
    assert watch_until_ended(child).status == status


def test_a_child_that_lacks_something_raises_its_last_words(tmp_path: Path) -> None:
    child = running(LACKS, last_words=tmp_path / "words")
    with pytest.raises(UnavailableError, match=r"^There is no such device\. Set INTRASPLAT_DEVICE\.$"):
        watch_until_ended(child)
    assert child.process_id is None
    assert list(tmp_path.iterdir()) == []


def test_words_that_an_earlier_child_left_are_not_those_of_the_next(tmp_path: Path) -> None:
    (tmp_path / "words").write_text('{"problem": "There was no queue.", "remedy": "Start one."}')
    with pytest.raises(UnavailableError, match=r"child ended with status 5.*messages are above"):
        watch_until_ended(running("raise SystemExit(5)", last_words=tmp_path / "words"))


def test_a_child_whose_queue_may_come_back_is_started_again(tmp_path: Path) -> None:
    away = LACKS.replace('"Set INTRASPLAT_DEVICE."', '"Start it.", may_return=True')
    assert watch_until_ended(running(away, last_words=tmp_path / "words")).pause_s > 0


def test_a_child_that_was_healthy_once_is_started_again_whatever_it_lacks(tmp_path: Path) -> None:
    child = running(LACKS, last_words=tmp_path / "words")
    child.watch()
    child.mark_healthy()
    assert next_end(child).pause_s == 0.0
    assert next_end(child).pause_s > 0.0


def test_a_child_with_pipes_ends_when_its_stdin_closes() -> None:
    child = running("import sys; sys.stdout.write(sys.stdin.read())", pipes=True)
    child.watch()
    process = child.process
    assert process is not None
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(b"heard")
    child.stop()
    assert process.stdout.read() == b"heard"
    assert process.returncode == 0
    process.stdout.close()


def test_a_child_that_does_not_end_in_time_is_killed() -> None:
    child = running(
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(60)",
        grace_s=0.1,
    )
    child.watch()
    process = child.process
    child.stop()
    assert process is not None
    assert process.returncode in (-signal.SIGKILL, -signal.SIGTERM)


def test_what_a_child_says_goes_to_its_log(tmp_path: Path) -> None:
    child = running("import sys; print('out', flush=True); print('err', file=sys.stderr)", log=tmp_path / "log")
    watch_until_ended(child)
    assert (tmp_path / "log").read_text() == "out\nerr\n"


def test_a_program_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Supervised("child", [str(tmp_path / "no-such-program")]).watch()


def test_a_child_dies_with_a_parent_that_was_killed() -> None:
    program = (
        "import sys, time\n"
        "from contract.runtime.supervised import Supervised\n"
        "child = Supervised('child', [sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "child.watch()\n"
        "print(child.process_id, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child_id = int(parent.stdout.readline())
        assert is_running(child_id)
        parent.kill()
    deadline_s = time.monotonic() + 10.0
    while is_running(child_id):
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def is_running(process_id: int) -> bool:
    """Whether the process is there and has not ended; an ended one may wait for its parent."""
    try:
        state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@pytest.mark.parametrize(
    ("status", "cause"),
    [
        (1, "ended with status 1"),
        (-15, "was killed by SIGTERM"),
        (143, "was killed by SIGTERM"),
        (-9, "was killed by SIGKILL (was there not enough memory?)"),
    ],
)
def test_a_status_is_told_in_words(status: int, cause: str) -> None:
    assert cause_of(status) == cause
