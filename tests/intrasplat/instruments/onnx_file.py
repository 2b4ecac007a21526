"""A network of one convolution and a sigmoid as an ONNX file, written byte by byte: a test needs no package for that.

Field numbers are those of onnx.proto, ModelProto and below it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FLOAT = 1
Size = int | str
"""Of a dimension: a number, or a name where any number will do."""


def colour_network(weights: Sequence[float], bias: float, size: Sequence[Size] = ("h", "w"), planes: int = 3) -> bytes:
    """probability[1, 1, h, w] = sigmoid(weights . rgb + bias)."""
    kernel = np.array(weights, np.float32).reshape(1, planes, 1, 1)
    graph = b"".join(
        [
            _bytes(1, _node("Conv", ["rgb", "kernel", "bias"], "score")),
            _bytes(1, _node("Sigmoid", ["score"], "probability")),
            _bytes(2, b"colour"),
            _bytes(5, _tensor("kernel", kernel)),
            _bytes(5, _tensor("bias", np.array([bias], np.float32))),
            _bytes(11, _value("rgb", (1, planes, *size))),
            _bytes(12, _value("probability", (1, 1, *size))),
        ]
    )
    return _number(1, 8) + _bytes(7, graph) + _bytes(8, _bytes(1, b"") + _number(2, 13))


def _node(kind: str, inputs: Sequence[str], output: str) -> bytes:
    return b"".join(_bytes(1, each.encode()) for each in inputs) + _bytes(2, output.encode()) + _bytes(4, kind.encode())


def _tensor(name: str, values: np.ndarray) -> bytes:
    dims = b"".join(_number(1, each) for each in values.shape)
    return dims + _number(2, FLOAT) + _bytes(8, name.encode()) + _bytes(9, values.tobytes())


def _value(name: str, shape: Sequence[Size]) -> bytes:
    dims = (_number(1, each) if isinstance(each, int) else _bytes(2, each.encode()) for each in shape)
    tensor = _number(1, FLOAT) + _bytes(2, b"".join(_bytes(1, each) for each in dims))
    return _bytes(1, name.encode()) + _bytes(2, _bytes(1, tensor))


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    found = b""
    while value > 127:
        found += bytes([value & 127 | 128])
        value >>= 7
    return found + bytes([value])
