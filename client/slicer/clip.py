"""What the bridge knows of a scene besides its pictures: its camera, path and times, and its surface.

Symbols: T frames, V vertices, F faces.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from client.slicer.frames import Camera, Matrix
from contract.wire.errors import SceneError

DEFAULT_PERIOD_S = 0.1
"""How long a clip's only frame is shown."""

VERTEX = np.dtype([("place", "<f4", 3), ("colour", "u1", 3)])
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
PLY_START = ("ply", "format binary_little_endian 1.0")
PLY_PROPERTIES = (
    *(f"property float {axis}" for axis in "xyz"),
    *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
    "property list uchar int vertex_indices",
)


class _Manifest(BaseModel):
    """The part of a scene's manifest.json that matters here (docs/scene-file.md)."""

    intrinsics: Camera
    world_from_camera: list[list[list[float]]] = Field(min_length=1)
    frame_times_s: list[float] = Field(min_length=1)


@dataclass(frozen=True)
class Clip:
    """The endoscope's camera, its world_from_camera [T, 4, 4] in mm, and the T seconds of the frames."""

    camera: Camera
    path: Matrix
    times_s: tuple[float, ...]

    @classmethod
    def of_manifest(cls, content: bytes) -> Clip:
        """What a manifest.json says.

        Raises:
            SceneError: it is damaged.
        """
        try:
            manifest = _Manifest.model_validate_json(content)
            path = np.array(manifest.world_from_camera, np.float64)
            if path.shape != (len(manifest.frame_times_s), 4, 4):
                raise ValueError(f"{path.shape} poses for {len(manifest.frame_times_s)} frames")
        except (ValidationError, ValueError) as error:
            raise SceneError(f"The manifest of the scene is damaged ({type(error).__name__}).") from error
        return cls(manifest.intrinsics, path, tuple(manifest.frame_times_s))

    @property
    def frame_count(self) -> int:
        """T."""
        return len(self.times_s)

    @property
    def duration_s(self) -> float:
        """Of the clip, its last frame included."""
        if self.frame_count == 1:
            return DEFAULT_PERIOD_S
        return self.times_s[-1] * self.frame_count / (self.frame_count - 1)

    def t_of(self, frame: int) -> float:
        """Model time of a frame."""
        return frame / self.frame_count

    def frame_at_t(self, t: float) -> int:
        """The frame nearest to a model time."""
        return min(max(round(t * self.frame_count), 0), self.frame_count - 1)

    def frame_at(self, seconds: float) -> int:
        """The frame that is shown so many seconds after the clip's start; the clip begins again after its end."""
        return max(0, bisect.bisect_right(self.times_s, seconds % self.duration_s) - 1)


@dataclass(frozen=True)
class Surface:
    """vertices_mm [V, 3] in the world, colours [V, 3] of 0 to 255, faces [F, 3] counter-clockwise from outside."""

    vertices_mm: NDArray[np.float32]
    colours: NDArray[np.uint8]
    faces: NDArray[np.int32]

    @classmethod
    def of_ply(cls, content: bytes) -> Surface:
        """What an export of the format mesh-ply holds.

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
