"""Kernels of several callers at once: right results, and nobody waits for ever."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from contract.wire.errors import InputError
from tests.worker.raster.test_cpu import NORMALISED, RATES, moving_gaussians, random_frame
from worker.machine.parts import whole
from worker.raster.cpu import update
from worker.raster.cpu.model import CpuModel
from worker.raster.cpu.threads import THREADS_VARIABLE, alone, beside, cpu_time_s, flushing, run, thread_count
from worker.raster.cpu.vectors import LANES
from worker.raster.step import camera_vector

PATIENCE_S = 120.0
"""Longer than any of this takes on a busy machine: only a deadlock lasts so long."""


def all_at_once(*works: Callable[[], None]) -> None:
    """Runs each in a thread of its own; fails where one fails or does not end."""
    errors: list[BaseException] = []

    def guarded(work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=guarded, args=(work,), daemon=True) for work in works]
    for each in threads:
        each.start()
    deadline = time.monotonic() + PATIENCE_S
    for each in threads:
        each.join(max(0.0, deadline - time.monotonic()))
    assert not any(each.is_alive() for each in threads), "a caller waits for ever"
    if errors:
        raise errors[0]


def train(kind: str, steps: int) -> list[NDArray[np.float32]]:
    """Everything a model holds after some steps."""
    gaussians, deformation, camera = moving_gaussians(kind, 0)
    frame = random_frame(camera, np.zeros((camera.height, camera.width), bool))
    model = CpuModel(gaussians, deformation, camera.width, camera.height)
    seen = frame.seen_from(camera, 0.4, model.rasterizer)
    for iteration in range(1, steps + 1):
        model.step([seen], NORMALISED, RATES, iteration)
    return [np.array(each) for each in model.arrays().values()]


def test_what_is_done_beside_counts_as_the_callers_and_its_error_is_the_callers() -> None:
    go_on, before_s = threading.Event(), cpu_time_s()

    def work() -> int:
        assert go_on.wait(PATIENCE_S)
        start_s = time.thread_time()
        while time.thread_time() - start_s < 0.05:
            pass
        return threading.get_ident()

    parts = beside(work)
    next(parts)  # comes back although the work goes on
    go_on.set()
    assert whole(parts) != threading.get_ident()
    assert cpu_time_s() - before_s >= 0.05
    with pytest.raises(ZeroDivisionError):
        whole(beside(lambda: 1 // 0))


def render(kind: str, frames: int) -> list[NDArray[np.float32]]:
    gaussians, deformation, camera = moving_gaussians(kind, 0)
    model = CpuModel(gaussians, deformation, camera.width, camera.height)
    return [model.render(camera_vector(camera), t).copy() for t in np.linspace(0, 1, frames)]


def test_training_and_rendering_at_once_give_what_each_gives_alone() -> None:
    steps, frames = 40, 60
    works: list[tuple[Callable[[str, int], list[NDArray[np.float32]]], str, int]] = [
        (train, "shared with colour", steps),
        (train, "fdm-gaussian", steps),
        (render, "shared with colour", frames),
        (render, "fdm-gaussian", frames),
    ]
    alone = [work(kind, count) for work, kind, count in works]
    together: dict[int, list[NDArray[np.float32]]] = {}

    def caller(place: int) -> Callable[[], None]:
        work, kind, count = works[place]
        return lambda: together.__setitem__(place, work(kind, count))

    all_at_once(*(caller(place) for place in range(len(works))))
    for place, expected in enumerate(alone):
        for got, wanted in zip(together[place], expected, strict=True):
            assert np.array_equal(got, wanted)


def test_a_caller_that_is_alone_uses_no_other_thread_and_comes_to_the_same_bits() -> None:
    expected = render("shared with colour", 5)
    users: set[int] = set()
    with alone():
        run(lambda thread, threads: users.add(threading.get_ident()))
        with alone(is_alone=False):
            pass
        found = render("shared with colour", 5)
    assert users == {threading.get_ident()}
    assert all(np.array_equal(got, wanted) for got, wanted in zip(found, expected, strict=True))
    elsewhere_s = cpu_time_s() - time.thread_time()
    run(lambda thread, threads: sum(range(10**5)))
    assert thread_count() == 1 or cpu_time_s() - time.thread_time() > elsewhere_s


def test_more_callers_than_threads_all_come_to_an_end() -> None:
    counts = np.zeros((16, thread_count()), np.int64)

    def kernel(thread: int, threads: int, row: NDArray[np.int64]) -> None:
        assert threads == thread_count()
        time.sleep(1e-4)
        row[thread] += 1

    def caller(row: NDArray[np.int64]) -> Callable[[], None]:
        def call_often() -> None:
            for _ in range(50):
                run(kernel, row)

        return call_often

    all_at_once(*(caller(row) for row in counts))
    assert bool((counts == 50).all())


@pytest.mark.parametrize("given", ["-1", "0", "two", "1.5", " "])
def test_a_number_of_threads_that_is_none_is_refused_with_its_name_and_remedy(
    given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, given)
    with pytest.raises(InputError, match=f"INTRASPLAT_THREADS: {given!r} is no .* above 0, or leave it unset"):
        thread_count.__wrapped__()  # past the cache: this process has chosen already


def test_threads_are_as_many_as_the_variable_says_or_this_process_has_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, "3")
    assert thread_count.__wrapped__() == 3
    monkeypatch.setenv(THREADS_VARIABLE, "")
    cores = thread_count.__wrapped__()
    monkeypatch.delenv(THREADS_VARIABLE)
    assert thread_count.__wrapped__() == cores >= 1


@pytest.mark.parametrize("failing", [0, thread_count() - 1])
def test_an_error_in_one_share_is_raised_when_all_shares_are_done(failing: int) -> None:
    done = np.zeros(thread_count(), np.int64)

    def kernel(thread: int, threads: int) -> None:
        if thread == failing:
            raise ZeroDivisionError(f"share {thread}")
        time.sleep(0.02)
        done[thread] = 1

    with pytest.raises(ZeroDivisionError, match=f"share {failing}"):
        run(kernel)
    assert done.sum() == thread_count() - 1
    run(lambda thread, threads: None)  # and the pool works on


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked on this system")
def test_a_forked_process_has_threads_of_its_own() -> None:
    run(lambda thread, threads: None)  # the parent's pool is there before the fork
    child = os.fork()
    if child == 0:
        done = np.zeros(thread_count(), np.int64)
        run(lambda thread, threads: done.__setitem__(thread, 1))
        os._exit(0 if done.all() else 1)
    deadline = time.monotonic() + PATIENCE_S
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0) and time.monotonic() < deadline:
        time.sleep(0.01)
    if ended == (0, 0):
        os.kill(child, 9)
        os.waitpid(child, 0)
        pytest.fail("the forked process waits for threads that only its parent has")
    assert os.waitstatus_to_exitcode(ended[1]) == 0


@pytest.mark.parametrize("is_alone", [False, True])
def test_subnormal_numbers_count_as_zero_in_flushing_kernels_alone(*, is_alone: bool) -> None:
    first = np.full(LANES * thread_count(), 1e-40, np.float32)
    value = np.zeros_like(first)
    decay = value, value, first, value.copy(), np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(0.0)
    with alone(is_alone=is_alone):
        run(update.adam, *decay)
        assert first.all()
        run(flushing(update.adam), *decay)
    assert not first.any()
    assert bool((torch.full((1,), 1e-40) * 0.5 > 0).all()), "on the caller's thread, afterwards"
