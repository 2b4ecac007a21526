"""Recorded frames in which the masked parts are marked: what a user judges masks by.

A scene whose masks were found keeps MAX_KEPT of them in one file. Symbols: T frames, h w pixels of a picture.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.errors import SceneError
from worker.input.clip import DepthClip
from worker.input.clip.split import spread
from worker.machine.mapped import let_go

MAX_KEPT = 24
MAX_WIDTH = 400
"""Px of a picture. 24 of them take some 600 kB."""
QUALITY = 70
MARK, MARK_SHARE = (0, 220, 255), 0.45
"""RGB that no tissue has, and how much of it the masked parts get; their outline gets all of it."""


def marked_frame(clip: DepthClip, t: float) -> tuple[int, bytes]:
    """The frame nearest to model time t that has masks, and its picture as JPEG."""
    index = _nearest(clip.used, t, clip.frame_count)
    return index, _marked(clip, index)


def marked_frames(clip: DepthClip) -> bytes | None:
    """A zip of JPEGs named by their frames, such as 000012.jpg, for stored_frame; None if masks were not found."""
    if clip.masks is None or not clip.masks.are_found:
        return None
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for index in spread(clip.used, MAX_KEPT):
            archive.writestr(zipfile.ZipInfo(f"{index:06d}.jpg"), _marked(clip, index))
    return content.getvalue()


def stored_frame(path: Path, t: float, frame_count: int) -> tuple[int, bytes]:
    """As marked_frame, of those that marked_frames kept in a file.

    Raises:
        SceneError: there is no such file, or it is damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = {int(Path(name).stem): name for name in archive.namelist()}
            index = _nearest(sorted(names), t, frame_count)
            return index, archive.read(names[index])
    except FileNotFoundError:
        raise SceneError("This scene keeps no recorded frames: its masks were given, or it has none.") from None
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise SceneError(f"The recorded frames of this scene cannot be read ({type(error).__name__}).") from error


def _nearest(frames: Sequence[int], t: float, frame_count: int) -> int:
    wanted = min(t, 1.0) * frame_count
    return min(frames, key=lambda index: abs(index - wanted))


def _marked(clip: DepthClip, index: int) -> bytes:
    """A frame as JPEG, at most MAX_WIDTH wide."""
    rgb, tool = clip.rgb[index], (~clip.tissue[index]).view(np.uint8)
    height, width = tool.shape
    if width > MAX_WIDTH:
        size = MAX_WIDTH, max(1, round(height * MAX_WIDTH / width))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        tool = np.asarray(cv2.resize(tool, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    else:
        rgb = rgb.copy()
    let_go(clip.rgb[index])
    let_go(clip.tissue[index])
    mark: NDArray[np.float32] = np.array(MARK, np.float32)
    masked, outline = tool > 0, cv2.morphologyEx(tool, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    rgb[masked] = (1 - MARK_SHARE) * rgb[masked] + MARK_SHARE * mark
    rgb[outline] = mark
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
