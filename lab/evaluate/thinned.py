"""A clip of fewer pixels, for methods that render ray by ray, whose cost grows with the number of pixels.

thinned  every nth pixel of every nth row, to score on: pixels of the clip itself; their camera sends the same rays
shrunk   squares of n pixels become one, to train on, as a recording at a smaller size would be
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, Eye
from intrasplat.clip.types import PIXELS

SomeEye = TypeVar("SomeEye", bound=Eye)


def lattice(step_px: int) -> tuple[slice, slice]:
    """The rows and the columns of the lattice in a picture."""
    each = slice(step_px // 2, None, step_px)
    return each, each


def thinned_camera(camera: Intrinsics, step_px: int) -> Intrinsics:
    """The camera whose pixels are those of the lattice."""
    first = step_px // 2
    return Intrinsics(
        width=len(range(first, camera.width, step_px)),
        height=len(range(first, camera.height, step_px)),
        fx=camera.fx / step_px,
        fy=camera.fy / step_px,
        cx=(camera.cx - first - 0.5) / step_px + 0.5,
        cy=(camera.cy - first - 0.5) / step_px + 0.5,
    )


def dense_camera(thin: Intrinsics, step_px: int) -> Intrinsics:
    """The inverse of thinned_camera."""
    first = step_px // 2
    return Intrinsics(
        width=thin.width * step_px,
        height=thin.height * step_px,
        fx=thin.fx * step_px,
        fy=thin.fy * step_px,
        cx=(thin.cx - 0.5) * step_px + first + 0.5,
        cy=(thin.cy - 0.5) * step_px + first + 0.5,
    )


def thinned(clip: DepthClip, step_px: int) -> DepthClip:
    """The clip on the lattice of pixels, both eyes; unchanged for step_px = 1."""
    if step_px == 1:
        return clip
    right = None if clip.right is None else _thinned_eye(clip.right, step_px)
    return replace(_thinned_eye(clip, step_px), right=right)


def shrunk(clip: DepthClip, step_px: int) -> DepthClip:
    """The left eye at 1 / step_px of its width and height, which it divides. Colours are means; tissue is where all of
    a square is; depth is one of its middle pixels, not a mean over an edge."""
    frames, height, width, _ = clip.rgb.shape
    squares = (frames, height // step_px, step_px, width // step_px, step_px)
    size = clip.intrinsics.resized(width // step_px, height // step_px)
    rgb = np.rint(clip.rgb.reshape(*squares, 3).mean((2, 4), dtype=np.float32)).astype(np.uint8)
    depths = {name: _at_lattice(clip, name, step_px) for name in ("depth_mm", "depth_confidence")}
    tissue = np.asarray(clip.tissue.reshape(squares).all((2, 4)))
    return replace(clip, rgb=rgb, tissue=tissue, intrinsics=size, right=None, **depths)


def _at_lattice(eye: Eye, name: str, step_px: int) -> Any:
    return getattr(eye, name)[(slice(None), *lattice(step_px))]


def _thinned_eye(eye: SomeEye, step_px: int) -> SomeEye:
    arrays = {name: _at_lattice(eye, name, step_px) for name in PIXELS}
    return replace(eye, intrinsics=thinned_camera(eye.intrinsics, step_px), **arrays)
