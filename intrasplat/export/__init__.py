"""Export a stored scene as a file for other programs.

In: a scene, the name of a format and its options. Out: the file's bytes, part by part. Verb: export_parts.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from typing import TypeAlias

from intrasplat.errors import InputError
from intrasplat.export import mesh
from intrasplat.export.depth import depth_parts
from intrasplat.export.gltf import export_gltf
from intrasplat.export.mesh import mesh_parts
from intrasplat.export.ply import export_ply, ply_zip_parts
from intrasplat.export.points import export_points
from intrasplat.export.splat import export_splat
from intrasplat.export.target import ExportTarget
from intrasplat.export.tracks import tracks_parts
from intrasplat.export.tum import export_tum
from intrasplat.export.video import video_parts
from intrasplat.formats import ExportOptions, check_extra, missing_extras
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device

Writer: TypeAlias = Callable[[ExportTarget], Iterator[bytes]]

PART_BYTES = 1 << 20


def _moment(encode: Callable[[TrainedScene, float], bytes]) -> Writer:
    """The writer for a function that encodes a scene at a model time as a whole file."""
    return lambda target: iter((encode(target.scene, target.t),))


EXPORTS: dict[str, Writer] = {
    "ply": _moment(export_ply),
    "ply-zip": ply_zip_parts,
    "splat": _moment(export_splat),
    "gltf": _moment(export_gltf),
    "points": _moment(export_points),
    "mesh-stl": mesh_parts(mesh.stl),
    "mesh-ply": mesh_parts(mesh.ply),
    "mesh-glb": mesh_parts(mesh.glb),
    "depth": depth_parts,
    "tracks": tracks_parts,
    "webm": video_parts("webm"),
    "mp4": video_parts("mp4"),
    "tum": lambda target: iter((export_tum(target.scene),)),
}
"""The writers by the names of EXPORT_FORMATS (intrasplat/formats.py)."""

DRAWN = frozenset({"depth", "webm", "mp4", "mesh-stl", "mesh-ply", "mesh-glb"})
"""Formats that need renders of the clip's size."""


def export_parts(scene: TrainedScene, name: str, options: ExportOptions, device: Device = CPU) -> Generator[bytes]:
    """The file in parts of at most PART_BYTES bytes. An empty part means that the next one is not ready yet.

    Raises, at the first part:
        InputError: there is no such format, or the scene cannot be written in it with these options.
        MissingExtraError: the format needs an extra that is not installed.
        LimitError: the file would be larger than MAX_EXPORT_BYTES.
    """
    writer = EXPORTS.get(name)
    if writer is None:
        raise InputError("format", f"{name} is not an export format.", f"Use one of: {', '.join(EXPORTS)}.")
    check_extra(name, missing_extras())
    return _cut(writer(ExportTarget(scene, options, device)))


def _cut(pieces: Iterator[bytes]) -> Generator[bytes]:
    """Parts from pieces of any size: large pieces are cut, small ones joined; empty if nothing is ready."""
    ready = bytearray()
    for piece in pieces:
        ready += piece
        if not piece:
            yield b""
        for first in range(0, len(ready) - PART_BYTES + 1, PART_BYTES):
            yield bytes(ready[first : first + PART_BYTES])
        del ready[: len(ready) // PART_BYTES * PART_BYTES]
    if ready:
        yield bytes(ready)
