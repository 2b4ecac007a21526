"""CUDA graphs where there is no GPU: a capture records launches with their very tensors, and a replay makes them.

So a graph that was kept although a buffer had moved writes into the old one here too, and a test sees it. What torch
only looks at another way (views) is done at once; what it computes or writes is a node, like a kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from triton.runtime.interpreter import InterpretedFunction

from intrasplat.splat.cuda import captured

Node = Callable[[], Any]


class Graph:
    """In the place of torch.cuda.CUDAGraph."""

    made: int = 0
    replayed: int = 0
    recording: Graph | None = None

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        Graph.made += 1

    def replay(self) -> None:
        Graph.replayed += 1
        for node in self.nodes:
            node()


class _Recorder(TorchDispatchMode):
    """Makes nodes of torch's operations."""

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self._graph = graph

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        named = kwargs or {}
        places = enumerate(operation._schema.arguments)
        written = [(i, a.name) for i, a in places if a.alias_info is not None and a.alias_info.is_write]
        if written:
            self._graph.nodes.append(lambda: operation(*args, **named))
            targets = tuple(named[name] if name in named else args[i] for i, name in written)
            return targets[0] if len(operation._schema.returns) == 1 else targets
        result = operation(*args, **named)
        if isinstance(result, Tensor) and operation._schema.returns[0].alias_info is None:
            self._graph.nodes.append(lambda: result.copy_(operation(*args, **named)))
        return result


@contextmanager
def _capture(graph: Graph, **_: Any) -> Iterator[None]:
    """In the place of torch.cuda.graph."""
    Graph.recording = graph
    try:
        with _Recorder(graph):
            yield
    finally:
        Graph.recording = None


class _Stream:
    def synchronize(self) -> None:
        """Everything has been done already."""


def emulate(monkeypatch: pytest.MonkeyPatch) -> type[Graph]:
    """Have graphs captured on the CPU from here to the test's end; the class counts them."""
    launch = InterpretedFunction.run

    def record(kernel: InterpretedFunction, *args: Any, **named: Any) -> None:
        if Graph.recording is None:
            launch(kernel, *args, **named)
        else:
            Graph.recording.nodes.append(lambda: launch(kernel, *args, **named))

    Graph.made = Graph.replayed = 0
    monkeypatch.setattr(InterpretedFunction, "run", record)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", _capture)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: _Stream())
    monkeypatch.setattr(captured, "can_capture", lambda device: True)
    return Graph
