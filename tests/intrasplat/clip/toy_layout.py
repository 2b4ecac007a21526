"""An input layout from outside: a folder with one clip.npz that holds rgb, depth_mm and the focal length."""

from __future__ import annotations

import io

import numpy as np

from intrasplat.camera import Intrinsics
from intrasplat.clip.layouts import ClipFiles, InputLayout
from intrasplat.clip.types import DepthClip

FILE = "clip.npz"


def _recognises(files: ClipFiles) -> bool:
    return files.tree is not None and FILE in files.tree.names


def _open(files: ClipFiles) -> DepthClip:
    with np.load(io.BytesIO(files.tree_for("toy").read(FILE, files.limits.decoded_bytes))) as arrays:
        rgb, depth_mm, focal_px = arrays["rgb"], arrays["depth_mm"], float(arrays["focal_px"])
    count, height, width = depth_mm.shape
    return DepthClip(
        rgb=rgb,
        tissue=np.ones(depth_mm.shape, np.bool_),
        depth_mm=depth_mm,
        depth_confidence=np.full(depth_mm.shape, 255, np.uint8),
        intrinsics=Intrinsics(width=width, height=height, fx=focal_px, fy=focal_px, cx=width / 2, cy=height / 2),
        world_from_camera=np.tile(np.eye(4), (count, 1, 1)),
        frame_times_s=np.arange(count) / 30,
    )


LAYOUT = InputLayout("toy", _recognises, _open)
