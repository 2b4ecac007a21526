"""Launches that are run, captured and replayed while other threads launch, too."""

from __future__ import annotations

import threading
import time

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from intrasplat.splat.cuda.captured import Captured, one_at_a_time
from tests.intrasplat.splat import replays

CPU = torch.device("cpu")


def test_what_may_compile_or_load_kernels_is_run_by_one_thread_at_a_time() -> None:
    inside, most = 0, 0

    def routine() -> None:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        time.sleep(0.01)  # lets the other threads come as far as they may
        inside -= 1

    threads = [threading.Thread(target=Captured(CPU).run, args=("step", routine)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1


def test_a_replay_waits_for_no_other_threads_first_run(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, made = replays.emulate(monkeypatch), torch.zeros(1)

    def routine() -> None:
        made.add_(1.0)

    launches = Captured(CPU)
    for _ in range(2):
        launches.run("picture", routine)
    with one_at_a_time:  # as another thread holds it
        launches.run("picture", routine)
    assert float(made) == 3.0
    assert (graph.made, graph.replayed) == (1, 2)


def test_a_routine_that_breaks_off_keeps_nobody_else_from_launching() -> None:
    def routine() -> None:
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        Captured(CPU).run("step", routine)
    assert not one_at_a_time.locked()
