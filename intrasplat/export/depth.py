"""Depth of each frame of the clip, instruments removed, as one array.

Symbols: F frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from intrasplat.export.npy import npy_head
from intrasplat.export.target import ExportTarget
from intrasplat.view.render import render_frame


def depth_parts(target: ExportTarget) -> Iterator[bytes]:
    """NPY [F, H, W] float32: the camera's z in mm, from the endoscope's own poses; 0 where nothing is solid, and where
    no training frame saw what is shown.

    Raises:
        LimitError: the file would have more than MAX_EXPORT_BYTES.
    """
    camera = target.scene.intrinsics
    target.check_size(4 * camera.width * camera.height)
    yield npy_head((len(target.frames), camera.height, camera.width))
    for frame in target.frames:
        shown = render_frame(target.scene, target.time_of(frame), device=target.device, detail="off")
        yield np.where(shown.unseen, np.float32(0), shown.depth_mm).astype("<f4").tobytes()
        yield b""
