"""A small clip whose every value is known: a tilted textured plane, an instrument that moves across it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import ClipLimits, DepthClip, StereoClip, open_clip
from intrasplat.options import ClipOptions, parse_options

HEIGHT, WIDTH = 48, 64


def plane_clip(frames: int = 12, *, seed: int = 0, step_mm: float = 0.0) -> DepthClip:
    """A plane near 60 mm seen by a camera that moves step_mm to the right a frame; a tool 12 pixels wide wanders right.

    Without a step the tissue's brightness changes from left to right in time, so that there is motion to find.
    """
    random = np.random.default_rng(seed)
    intrinsics = Intrinsics(width=WIDTH, height=HEIGHT, fx=80.0, fy=80.0, cx=WIDTH / 2, cy=HEIGHT / 2)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = step_mm * np.arange(frames)
    depth_mm = np.stack([_plane_depth_mm(intrinsics, pose) for pose in poses])
    tissue = np.ones((frames, HEIGHT, WIDTH), dtype=np.bool_)
    for index in range(frames):
        left = 4 + 4 * index
        tissue[index, 10:30, left : left + 12] = False
    texture = random.integers(60, 200, (HEIGHT, WIDTH, 3))
    glow = np.linspace(0, 0.3, frames)[:, None, None, None] * (np.arange(WIDTH) > WIDTH // 2)[None, None, :, None]
    rgb = np.minimum(texture * (1 + glow), 255).astype(np.uint8)
    rgb[~tissue] = 230
    return DepthClip(
        rgb=rgb,
        tissue=tissue,
        depth_mm=depth_mm,
        depth_confidence=np.full(tissue.shape, 255, dtype=np.uint8),
        intrinsics=intrinsics,
        world_from_camera=poses,
        frame_times_s=np.arange(frames) / 30,
    )


def _plane_depth_mm(intrinsics: Intrinsics, world_from_camera: NDArray[np.float64]) -> NDArray[np.float32]:
    """z of the plane z = 60 + 0.2 x + 0.1 y (world, mm) along each pixel's ray; the cameras only shift."""
    x = (np.arange(intrinsics.width) + 0.5 - intrinsics.cx) / intrinsics.fx
    y = (np.arange(intrinsics.height) + 0.5 - intrinsics.cy) / intrinsics.fy
    shift = world_from_camera[:3, 3]
    above = 60 + 0.2 * shift[0] + 0.1 * shift[1] - shift[2]
    depth = above / (1 - 0.2 * x[None, :] - 0.1 * y[:, None])
    return np.asarray(depth, dtype=np.float32)


def open_with(
    path: Path | str, right: Path | None = None, *, masks: Path | None = None, limits: ClipLimits | None = None,
    **options: object,
) -> StereoClip | DepthClip:  # fmt: skip
    """open_clip, its options by their names."""
    return open_clip(path, right, masks=masks, options=parse_options(ClipOptions, options), limits=limits)
