"""Export the tissue's surface at one moment as a mesh: STL, PLY and GLB.

Symbols: V vertices, F faces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from intrasplat.export.glb import INDICES, Glb, to_gltf
from intrasplat.export.ply import ply_head, structured
from intrasplat.export.surface import Mesh, surface
from intrasplat.export.target import ExportTarget, as_bytes

TRIANGLES = 4
UNLIT = "KHR_materials_unlit"
FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])


def mesh_parts(encode: Callable[[Mesh, float], bytes]) -> Callable[[ExportTarget], Iterator[bytes]]:
    """The writer for a function that encodes a mesh at a model time as a whole file."""

    def parts(target: ExportTarget) -> Iterator[bytes]:
        mesh = yield from surface(target)
        yield encode(mesh, target.t)

    return parts


def _about(t: float) -> str:
    return f"intrasplat t={t:g}, millimetres, OpenCV axes of the first frame's camera"


def stl(mesh: Mesh, t: float) -> bytes:
    """Binary STL in mm, OpenCV axes, without colours. The header of 80 bytes names its content."""
    rows = np.zeros(len(mesh.faces), FACE)
    corners = mesh.vertices_mm[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows["normal"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    rows["corners"] = corners
    return _about(t).encode()[:80].ljust(80) + np.array(len(rows), "<u4").tobytes() + rows.tobytes()


def ply(mesh: Mesh, t: float) -> bytes:
    """Binary PLY in mm, OpenCV axes, with a colour (0 to 255) at each vertex."""
    colour = as_bytes(mesh.colour)
    vertices = structured(
        [
            *((axis, mesh.vertices_mm[:, index]) for index, axis in enumerate("xyz")),
            *((name, colour[:, index]) for index, name in enumerate(("red", "green", "blue"))),
        ]
    )
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.faces
    properties = [*(("float", axis) for axis in "xyz"), *(("uchar", name) for name in ("red", "green", "blue"))]
    return ply_head(_about(t), len(vertices), properties, len(faces)) + vertices.tobytes() + faces.tobytes()


def glb(mesh: Mesh, t: float) -> bytes:
    """Binary glTF in metres, +Y up, seen along -Z, with linear colours at the vertices and an unlit material."""
    del t
    made = Glb()
    attributes = {
        "POSITION": made.add(to_gltf(mesh.vertices_mm), bounds=True),
        "COLOR_0": made.add(_linear(mesh.colour)),
    }
    indices = made.add(mesh.faces.ravel(), INDICES)
    primitive = {"attributes": attributes, "indices": indices, "mode": TRIANGLES, "material": 0}
    material = {"extensions": {UNLIT: {}}, "doubleSided": True}
    return made.file(primitive, (UNLIT,), materials=[material])


def _linear(shown: NDArray[np.float32]) -> NDArray[np.float32]:
    """sRGB numbers in [0, 1] as linear ones (IEC 61966-2-1), which glTF expects at vertices."""
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4).astype(np.float32)
