"""The binary container of glTF 2.0: one buffer of arrays, described by JSON."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

FLOAT, UNSIGNED_BYTE, UNSIGNED_INT = 5126, 5121, 5125
COMPONENTS = {"f": FLOAT, "u": UNSIGNED_INT}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
VERTICES, INDICES = 34962, 34963
"""glTF's targets of a buffer view: vertex attributes or vertex indices."""
GENERATOR = "intrasplat"


def to_gltf(points_mm: NDArray[np.float32]) -> NDArray[np.float32]:
    """[N, 3] points, from mm and OpenCV axes to glTF's: metres, +Y up, the camera looks along -Z."""
    return np.asarray(points_mm * np.array([1e-3, -1e-3, -1e-3], np.float32), np.float32)


@dataclass
class Glb:
    """A GLB file with one mesh of one primitive: add() its arrays, then call file()."""

    _buffer: bytearray = field(default_factory=bytearray)
    _views: list[dict[str, Any]] = field(default_factory=list)
    _accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(self, values: NDArray[Any], target: int = VERTICES, *, bounds: bool = False, unit: bool = False) -> int:
        """Add an array [N] or [N, 3 or 4] of float32, uint32 or uint8; return the index of its accessor.

        bounds: write its minimum and maximum. unit: uint8 means 0 to 1.
        """
        kind = values.dtype.kind
        view = {"buffer": 0, "byteOffset": len(self._buffer), "byteLength": values.nbytes, "target": target}
        component = UNSIGNED_BYTE if values.dtype == np.uint8 else COMPONENTS[kind]
        columns = 1 if values.ndim == 1 else values.shape[1]
        accessor = {
            "bufferView": len(self._views),
            "componentType": component,
            "count": len(values),
            "type": TYPES[columns],
        }
        if bounds:
            each = values.reshape(len(values), -1)
            accessor |= {"min": each.min(axis=0).tolist(), "max": each.max(axis=0).tolist()}
        if unit:
            accessor["normalized"] = True
        self._buffer += values.astype(values.dtype.newbyteorder("<")).tobytes()
        self._buffer += bytes(-len(self._buffer) % 4)
        self._views.append(view)
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def file(self, primitive: dict[str, Any], extensions: tuple[str, ...] = (), **more: Any) -> bytes:
        """The file: a scene with one node, whose mesh has this primitive; `more` is added to its JSON."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": GENERATOR},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            "buffers": [{"byteLength": len(self._buffer)}],
            "bufferViews": self._views,
            "accessors": self._accessors,
            **more,
        }
        if extensions:
            document["extensionsUsed"] = list(extensions)
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self._buffer)
        head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self._buffer), b"BIN\0") + self._buffer
