"""The masks that were found, as a file that users can correct and send with the clip again.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.clip.recorded_masks import as_recorded
from intrasplat.machine.mapped import let_go

MAX_BYTES = 32 << 20
"""Maximum size of the file. Larger masks are not stored; a frame of 1920 x 1080 takes some 5 kB."""


def zipped_masks(clip: DepthClip) -> bytes | None:
    """A zip with a PNG for each frame of the clip, if masks were found.

    000000.png and so on are [H, W] in the pixels of the recorded left eye, 255 on instruments. A skipped frame
    (skipped) gets the mask of the nearest searched one. None if nothing was found, or if the file would exceed
    MAX_BYTES. The same masks give the same bytes, because ZipInfo's time is fixed.
    """
    if clip.masks is None or not clip.masks.are_found or clip.masks.share == 0:
        return None
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for index, tool in enumerate(_recorded_tools(clip)):
            png = cv2.imencode(".png", tool.view(np.uint8) * np.uint8(255), [cv2.IMWRITE_PNG_BILEVEL, 1])[1]
            archive.writestr(zipfile.ZipInfo(f"{index:06d}.png"), png.tobytes())
            if content.tell() > MAX_BYTES:
                return None
    return content.getvalue()


def _recorded_tools(clip: DepthClip) -> Iterator[NDArray[np.bool_]]:
    """Masks of instruments [H, W] in the pixels of the recorded left eye, frame by frame."""
    maps = None if clip.rectification is None else clip.rectification.maps(*clip.tissue.shape[1:])
    looked_at = np.array(clip.used)
    for index in range(clip.frame_count):
        nearest = int(looked_at[np.abs(looked_at - index).argmin()])
        tool = ~clip.tissue[nearest] if clip.field_of_view is None else ~clip.tissue[nearest] & clip.field_of_view
        let_go(clip.tissue[nearest])
        yield tool if maps is None else as_recorded(tool, maps)
