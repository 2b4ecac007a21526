"""Export the Gaussians' positions over time as an NPZ.

Symbols: F frames, N Gaussians.
"""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from intrasplat.export.npy import npy_head
from intrasplat.export.target import ExportTarget, as_bytes, splats_at
from intrasplat.files.zipped import zip_parts


def tracks_parts(target: ExportTarget) -> Iterator[bytes]:
    """NPZ of positions_mm [F, N, 3] (the world, OpenCV axes), frame [F], t [F], time_s [F], world_from_camera [F, 4, 4]
    (mm), trust [N] (`seen`), and colour [N, 3] uint8 and opacity [N] of the first of these frames.

    Raises:
        LimitError: the file would have more than MAX_EXPORT_BYTES.
    """
    scene, frames = target.scene, target.frames
    count = len(scene.gaussians)
    target.check_size(12 * count)

    def positions() -> Iterator[bytes]:
        yield npy_head((len(frames), count, 3))
        for frame in frames:
            yield splats_at(scene, target.time_of(frame)).mean_mm.astype("<f4").tobytes()

    def members() -> Iterator[tuple[str, Iterator[bytes]]]:
        first = splats_at(scene, 0.0)
        arrays: dict[str, NDArray[np.generic]] = {
            "frame": np.array(frames),
            "t": np.array([target.time_of(each) for each in frames]),
            "time_s": scene.frame_times_s[list(frames)],
            "world_from_camera": scene.world_from_camera[list(frames)],
            "trust": scene.seen.numpy(),
            "colour": as_bytes(first.colour),
            "opacity": first.opacity,
        }
        for name, values in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, values, allow_pickle=False)
            yield f"{name}.npy", iter((buffer.getvalue(),))
        yield "positions_mm.npy", positions()

    yield from zip_parts(members())
