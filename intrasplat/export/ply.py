"""Export the Gaussians as PLY files that splat viewers open: one moment, or all frames in a zip.

Symbols: N Gaussians, K = (degree + 1)^2 coefficients a colour channel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from intrasplat.export.target import ExportTarget, splats_at
from intrasplat.files.zipped import zip_parts
from intrasplat.scene.scene import TrainedScene


def export_ply(scene: TrainedScene, t: float) -> bytes:
    """Binary PLY of the Gaussians deformed to model time t, in the property order that splat viewers read.

    x y z in mm of the world (the endoscope's camera of frame 0, OpenCV axes); nx ny nz 0; f_dc and f_rest (all
    coefficients of red, then green, then blue); opacity as a logit; scale as natural logarithms of mm; rot a unit wxyz
    quaternion. Viewers apply exp, sigmoid and the harmonics themselves.

    Raises:
        ValueError: t is not a finite number.
    """
    splats = splats_at(scene, t)
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(len(splats.sh), -1)
    columns = [
        splats.mean_mm,
        np.zeros_like(splats.mean_mm),
        splats.sh[:, 0],
        rest,
        splats.opacity_logit[:, None],
        splats.log_scale_mm,
        splats.quaternion,
    ]
    table = np.concatenate(columns, axis=1, dtype="<f4")
    names = [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{channel}" for channel in range(3)),
        *(f"f_rest_{index}" for index in range(rest.shape[1])),
        "opacity",
        *(f"scale_{axis}" for axis in range(3)),
        *(f"rot_{part}" for part in range(4)),
    ]
    comment = f"intrasplat t={t:g}, millimetres, OpenCV axes of the first frame's camera"
    return ply_head(comment, len(table), [("float", name) for name in names]) + table.tobytes()


def ply_head(comment: str, vertices: int, properties: Sequence[tuple[str, str]], faces: int | None = None) -> bytes:
    """The header of a little-endian PLY: vertices with (type, name) properties and, if given, triangles."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {comment}",
        f"element vertex {vertices}",
        *(f"property {kind} {name}" for kind, name in properties),
    ]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def structured(columns: Sequence[tuple[str, NDArray[np.generic]]]) -> NDArray[np.void]:
    """Columns [N] of several types as the rows of a binary file."""
    rows = np.empty(len(columns[0][1]), [(name, column.dtype.newbyteorder("<")) for name, column in columns])
    for name, column in columns:
        rows[name] = column
    return rows


def ply_zip_parts(target: ExportTarget) -> Iterator[bytes]:
    """A zip with a file for each frame, 000000.ply and so on, and times.csv with frame, t and seconds.

    Raises:
        LimitError: the files would have more than MAX_EXPORT_BYTES.
    """
    scene = target.scene
    numbers_each = 17 + 3 * (scene.gaussians.sh.shape[1] - 1)
    target.check_size(4 * numbers_each * len(scene.gaussians))

    def members() -> Iterator[tuple[str, Iterator[bytes]]]:
        rows = [f"{each},{target.time_of(each):.6f},{scene.frame_times_s[each]:.6f}\n" for each in target.frames]
        yield "times.csv", iter(("".join(["frame,t,time_s\n", *rows]).encode(),))
        for frame in target.frames:
            yield f"{frame:06d}.ply", iter((export_ply(scene, target.time_of(frame)),))

    yield from zip_parts(members())
