"""A scene at one moment as a file for other programs.

In: a Scene and a model time t. Out: the bytes of a file. Verb: EXPORTS[name].encode(scene, t).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from worker.scene.export.ply import export_ply
from worker.scene.export.tum import export_tum
from worker.scene.scene import Scene


@dataclass(frozen=True)
class ExportFormat:
    """One file format: the media type of its files, and the function from a scene and a model time to the bytes."""

    media_type: str
    encode: Callable[[Scene, float], bytes]


EXPORTS = {
    "ply": ExportFormat("application/octet-stream", export_ply),
    "tum": ExportFormat("text/plain", export_tum),
}
"""The formats by name, which is also the ending of their files. contract/wire/rendering.py lists the public names."""
