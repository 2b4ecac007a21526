"""The tissue's surface at one moment, from an export of the service.

Symbols: V vertices, F faces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import SceneError

VERTEX = np.dtype([("place", "<f4", 3), ("colour", "u1", 3)])
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
PLY_START = ("ply", "format binary_little_endian 1.0")
PLY_PROPERTIES = (
    *(f"property float {axis}" for axis in "xyz"),
    *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
    "property list uchar int vertex_indices",
)


@dataclass(frozen=True)
class SurfaceMesh:
    """vertices_mm [V, 3] in the world, colours [V, 3] of 0 to 255, faces [F, 3] counter-clockwise from outside."""

    vertices_mm: NDArray[np.float32]
    colours: NDArray[np.uint8]
    faces: NDArray[np.int32]

    @classmethod
    def of_ply(cls, content: bytes) -> SurfaceMesh:
        """Parse an export of the format mesh-ply.

        Raises:
            SceneError: it is cut off, or another version wrote it.
        """
        head, _, rest = content.partition(b"end_header\n")
        lines = [line for line in head.decode("ascii", "replace").splitlines() if not line.startswith("comment ")]
        counts = [int(line.split()[-1]) for line in lines if line.startswith("element ") and line[-1].isdigit()]
        properties = tuple(line for line in lines if line.startswith("property "))
        if tuple(lines[:2]) != PLY_START or properties != PLY_PROPERTIES or len(counts) != 2:
            raise SceneError(
                "The surface is not the PLY that this program reads; service and bridge differ in version."
            )
        size = counts[0] * VERTEX.itemsize
        if len(rest) != size + counts[1] * FACE.itemsize:
            raise SceneError("The surface was cut off on its way.")
        vertices, faces = np.frombuffer(rest[:size], VERTEX), np.frombuffer(rest[size:], FACE)
        return cls(vertices["place"], vertices["colour"], faces["vertices"])
