"""CUDA graphs of what a step or a picture launches: replayed, two dozen launches cost the host one call."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from threading import Lock

import torch

one_at_a_time = Lock()
"""Held while kernels may be launched for the first time, and while launches are captured: scenes are rendered while
another is trained. Triton would hand one thread a kernel that another has not yet loaded onto the device, and torch
captures on one stream for the whole process."""


def can_capture(device: torch.device) -> bool:
    """Whether there are CUDA graphs there."""
    return device.type == "cuda"


class Captured:
    """Routines that only launch, by a key: run as they are at first, captured at the second run, replayed from then on.

    The first run compiles the kernels, which a capture must not. What a routine's launches depend on, beside the
    contents of memory on the device, is in the key, or is followed by forget(). Where there is no GPU a routine is just
    run. Only a replay does not wait for other threads' first runs and captures.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._was_run: set[Hashable] = set()
        self._graphs: dict[Hashable, torch.cuda.CUDAGraph] = {}

    def run(self, key: Hashable, routine: Callable[[], None]) -> None:
        """Launch a routine without waiting for it."""
        if key not in self._graphs:
            with one_at_a_time:
                if key not in self._was_run or not can_capture(self._device):
                    routine()
                    self._was_run.add(key)
                    return
                self._graphs[key] = _capture(routine)
        self._graphs[key].replay()

    def forget(self) -> None:
        """Addresses or sizes have changed. Waits: a graph must not be destroyed while it runs."""
        if self._graphs:
            torch.cuda.current_stream(self._device).synchronize()
        self._graphs.clear()
        self._was_run.clear()


def _capture(routine: Callable[[], None]) -> torch.cuda.CUDAGraph:
    """The launches, recorded and not made. Other threads may use the device meanwhile."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        routine()
    return graph
