"""How far a view lies aside from what the endoscope recorded.

Symbols: F trained frames, K rays of a view, C centre of the view's camera, E centre of a recording eye (mm).

The surface is taken as the plane at the median depth before each trained frame. A ray of the view meets it in S. The
angle at S between the directions to C and to E says how far the view looks from aside; straight nearer or farther it
stays small. |S - E| / |S - C| is the enlargement against that frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS

RAYS_A_SIDE = 5
BEHIND = 1e-6
"""A ray whose direction has less than this share along a frame's axis meets no surface ahead."""

WIDEST = 1e6
"""Largest tangent of the angle between a ray and the axis: more is 90 degrees."""


class Aside(NamedTuple):
    """Medians over a view's rays, each against the frame and eye that is nearest in angle.

    angle_deg    180 where the rays meet no surface
    enlargement  recorded distance over the view's; 1 where the rays meet no surface
    """

    angle_deg: float
    enlargement: float


def aside(scene: TrainedScene, pose: NDArray[np.float64], lens: Intrinsics) -> Aside:
    """How far a view from a pose [4, 4] (world_from_camera, mm) through a lens lies aside from the trained frames."""
    depth_mm = MEDIAN_DEPTH_UNITS / scene.units_per_mm
    frames = scene.world_from_camera[scene.trained_frames]
    from_world = np.linalg.inv(frames)
    centre = from_world[:, :3, :3] @ pose[:3, 3] + from_world[:, :3, 3]  # [F, 3] C in each frame's axes
    rays = np.einsum("fij,kj->fki", from_world[:, :3, :3] @ pose[:3, :3], _rays(lens))  # [F, K, 3]
    along = np.where(rays[..., 2] > BEHIND, rays[..., 2], np.nan)
    reach = (depth_mm - centre[:, None, 2]) / along
    reach = np.where(reach > 0, reach, np.nan)
    to_view = -reach[..., None] * rays
    surface = centre[:, None] - to_view
    cosines, enlargements = [], []
    for eye in ((0.0, 0.0, 0.0), *([scene.right_eye_mm] if scene.right_eye_mm else [])):
        to_eye = np.asarray(eye) - surface
        length = np.linalg.norm(to_eye, axis=-1)
        cosines.append((to_view * to_eye).sum(-1) / (reach * length))
        enlargements.append(length / reach)
    cosine, enlargement = (np.concatenate(each) for each in (cosines, enlargements))  # [F or 2 F, K]
    missed = np.isnan(cosine)
    nearest = np.where(missed, -1.0, cosine).argmax(0)
    places = nearest, np.arange(len(nearest))
    angle = np.degrees(np.arccos(np.clip(np.where(missed, -1.0, cosine)[places], -1, 1)))
    return Aside(float(np.median(angle)), float(np.median(np.where(missed, 1.0, enlargement)[places])))


def _rays(lens: Intrinsics) -> NDArray[np.float64]:
    """[K, 3] unit directions of a grid of rays in a camera's axes."""
    share = (np.arange(RAYS_A_SIDE) + 0.5) / RAYS_A_SIDE
    with np.errstate(over="ignore"):
        across, down = (share * lens.width - lens.cx) / lens.fx, (share * lens.height - lens.cy) / lens.fy
    x, y = np.meshgrid(np.clip(across, -WIDEST, WIDEST), np.clip(down, -WIDEST, WIDEST))
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))
