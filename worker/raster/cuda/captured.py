"""A CUDA graph of what a step launches: replayed, its two dozen launches cost the host one call."""

from __future__ import annotations

from collections.abc import Callable

import torch


class Captured:
    """A routine that only launches, by key: run as it is at first, captured at its second run, replayed from then on.

    The first run compiles its kernels, which a capture must not. Whatever the launches depend on beside the contents of
    memory on the device has to be in the key, or be followed by forget(). Where there is no GPU the routine is run.
    """

    def __init__(self, routine: Callable[[int], None], device: torch.device) -> None:
        self._routine, self._device = routine, device
        self._was_run: set[int] = set()
        self._graphs: dict[int, torch.cuda.CUDAGraph] = {}

    def run(self, key: int) -> None:
        """Launch the routine without waiting for it."""
        if key in self._graphs:
            self._graphs[key].replay()
        elif self._device.type == "cuda" and key in self._was_run:
            self._graphs[key] = self._capture(key)
            self._graphs[key].replay()
        else:
            self._routine(key)
            self._was_run.add(key)

    def _capture(self, key: int) -> torch.cuda.CUDAGraph:
        """The launches, recorded and not made. Other threads may use the device meanwhile."""
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._routine(key)
        return graph

    def forget(self) -> None:
        """Addresses or sizes have changed. Waits: a graph must not be destroyed while it runs."""
        if self._graphs:
            torch.cuda.synchronize(self._device)
        self._graphs.clear()
        self._was_run.clear()
