"""Which frames of a phantom's clip show which of its tissue, under an endoscope that may move.

Symbols: F frames, M material points: the vertices of the tissue's mesh, about three pixels apart. T frames of the clip.

A point is shown by an eye where nothing of the tissue lies in front of it and the eye's mask says tissue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.phantom import Phantom

BEHIND = 0.005
"""A point is hidden if it lies behind the nearest surface within a pixel by more than this share of its depth."""


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """frames [F], and shown [F, M] bool: whether an eye shows the point at that frame. A point has the same number in
    phantom.surface.vertices_mm(frame) of every frame.
    """

    frames: tuple[int, ...]
    shown: NDArray[np.bool_]

    @property
    def by_any(self) -> NDArray[np.bool_]:
        """[M] whether some frame shows the point."""
        return np.asarray(self.shown.any(axis=0))

    @property
    def first(self) -> NDArray[np.int64]:
        """[M] the first of the frames that shows the point; -1 where none does."""
        return np.where(self.by_any, np.array(self.frames)[self.shown.argmax(axis=0)], -1)


def seen_points(
    phantom: Phantom,
    frames: Sequence[int],
    tissue: NDArray[np.bool_],
    tissue_right: NDArray[np.bool_] | None = None,
) -> SeenPoints:
    """What the frames show; tissue [T, H, W] bool of the left eye and of the right, or None if that eye is not used."""
    shown = []
    for frame in frames:
        row, column, visible = _places(phantom, frame, phantom.world_from_camera(frame))
        now = visible & tissue[frame][row, column]
        if tissue_right is not None:
            row, column, visible = _places(phantom, frame, phantom.world_from_right(frame))
            now |= visible & tissue_right[frame][row, column]
        shown.append(now)
    return SeenPoints(tuple(frames), np.stack(shown))


def share_covered(phantom: Phantom, seen: SeenPoints, solid: NDArray[np.bool_]) -> float:
    """Share of the points that lie in the left eye's view at some frame, and which any frame shows as tissue, that a
    model draws.

    Args:
        solid: [F, H, W] whether it draws something solid, in the left eye's view at seen.frames.
    """
    asked, drawn = (np.zeros(seen.shown.shape[1], np.bool_) for _ in range(2))
    for frame, picture in zip(seen.frames, solid, strict=True):
        row, column, visible = _places(phantom, frame, phantom.world_from_camera(frame))
        now = visible & seen.by_any
        asked |= now
        drawn |= now & picture[row, column]
    return float(drawn.sum() / asked.sum()) if asked.any() else float("nan")


def _places(
    phantom: Phantom, frame: int, world_from_camera: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Row and column [M] of the points' pixels (0 outside), and whether no tissue hides them there."""
    camera = phantom.settings.intrinsics
    local_mm = (phantom.surface.vertices_mm(frame) - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    z_mm = local_mm[:, 2]
    ahead = z_mm > 0
    safe_mm = np.where(ahead, z_mm, 1.0)
    x = np.floor(camera.fx * local_mm[:, 0] / safe_mm + camera.cx)
    y = np.floor(camera.fy * local_mm[:, 1] / safe_mm + camera.cy)
    inside = ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    row, column = (np.where(inside, place, 0).astype(np.intp) for place in (y, x))
    depth_mm = phantom.surface_pixels(frame, world_from_camera).depth_mm
    farthest_mm = cv2.dilate(depth_mm, np.ones((3, 3), np.uint8))[row, column]
    return row, column, inside & (z_mm <= farthest_mm * (1 + BEHIND))
