"""CUDA graphs of the launches of a step or a picture: a replay of two dozen launches costs the host one call."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from threading import Lock

import torch

one_at_a_time = Lock()
"""Lock for first launches of kernels and for captures, because scenes are rendered while another is trained. Without it
Triton would give a thread a kernel that another has not yet loaded onto the device, and torch captures on one stream
for the whole process."""


def can_capture(device: torch.device) -> bool:
    """Whether the device has CUDA graphs."""
    return device.type == "cuda"


class Captured:
    """Routines that only launch kernels, by key: the first run is direct, the second is captured, others are replayed.

    The first run compiles the kernels, which a capture must not do. A routine's launches may depend on its key and on
    memory on the device; if anything else changes, call forget(). Without a GPU every run is direct. Only a replay does
    not wait for other threads' first runs and captures.
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
        """Drop all graphs after addresses or sizes have changed. It waits: a running graph must not be destroyed."""
        if self._graphs:
            torch.cuda.current_stream(self._device).synchronize()
        self._graphs.clear()
        self._was_run.clear()


def _capture(routine: Callable[[], None]) -> torch.cuda.CUDAGraph:
    """Record the launches without running them. Other threads may use the device meanwhile."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        routine()
    return graph
