"""Places under pixels of a view, in mm, with their standard uncertainty; how far two of them are apart at every frame.

Symbols: N Gaussians, M of them that make a pixel, T frames, w blending weights of the Gaussians at a pixel.

A place is the pixel's ray up to the rendered depth. It belongs to the Gaussians that make the pixel: at another time it
has gone as far as they have, in the mean weighted by w. docs/conventions.md ("Measuring") has what the uncertainties
mean, benchmarks/bm_measure.py how they were found and how well they hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import erfinv

from contract.wire.errors import InputError
from worker.input.camera import Intrinsics, to_camera
from worker.model.gaussians import Gaussians
from worker.model.metrics import COVERED_ALPHA
from worker.raster.backend import CPU, Device
from worker.render.camera import as_recorded, endoscope_pose
from worker.render.confidence import confidence, evidence
from worker.render.unseen import missing_pixels, unseen_pixels
from worker.render.view import renderer_of
from worker.scene.scene import Scene
from worker.train.targets import solid_depth_mm

WINDOW_PX = 64
"""Side of the part of the picture that is drawn about a pixel. Gaussians whose centres lie outside it change its middle
by less than 0.01 mm."""
LEAST_SHARE = 1e-3
"""Gaussians of a smaller share in the pixel are left out."""
MIN_CONFIDENCE = 0.5
"""Where a pixel is rather wrong than right, nothing is measured."""
MAX_CONFIDENCE = 0.995
"""Held at it: nothing is surer."""
DISPARITY_PX = 0.15
"""With the probability that confidence states, depth errs by less than so much disparity of the eyes and the
spread of the blended depths together. `python -m benchmarks.bm_measure --fit` finds it."""
UNKNOWN_BASELINE_MM = 4.0
"""Of a clip whose eyes are not known: that of usual stereo endoscopes."""
MOTION_FACTOR = 2.0
"""Standard uncertainty of a way, in any direction, over the difference of the ways of its Gaussians."""
LEAST_KEPT_TRUST = 0.5
"""A place that has lost more of its trust, because it was out of view for 0.7 s, is not measured at that frame."""


@dataclass(frozen=True, eq=False)
class Place:
    """What one pixel shows.

    point_mm        [3] in the world
    ray             [3] in the world: by how much point_mm moves where depth_mm grows by 1
    depth_mm        along the camera's z, as the layer depth has it; 0: nothing solid is there
    own_depth_mm    before the endoscope
    uncertainty_mm  standard uncertainty of depth_mm
    confidence      as the layer has it
    unseen          whether no training frame saw what is shown
    gaussians       [M] indices of those that make the pixel
    shares          [M] their weights, which add up to 1
    """

    point_mm: NDArray[np.float64]
    ray: NDArray[np.float64]
    depth_mm: float
    own_depth_mm: float
    uncertainty_mm: float
    confidence: float
    unseen: bool
    gaussians: NDArray[np.intp]
    shares: NDArray[np.float64]


def places_at(
    scene: Scene,
    t: float,
    world_from_camera: NDArray[np.float64] | None,
    camera: Intrinsics,
    points: Sequence[tuple[float, float]],
    device: Device = CPU,
) -> list[Place]:
    """What the pixels that cover the points (x, y) of a view show at model time t; pose None: the endoscope's.

    Raises:
        InputError: a point lies outside the picture, or the scene does not know how far to trust it.
    """
    if not bool(scene.seen.any()):
        problem = "Nothing is known of how far to trust this scene, so nothing can be measured in it."
        raise InputError("scene", problem, "Measure in a scene whose training has ended.")
    for number, (x, y) in enumerate(points):
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            problem = f"({x:g}, {y:g}) lies outside the picture of {camera.width} x {camera.height} pixels."
            raise InputError(f"points[{number}]", problem, "Give x and y in pixels from the picture's upper left.")
    own_pose = endoscope_pose(scene, t)
    pose = own_pose if world_from_camera is None else world_from_camera
    sampled = as_recorded(camera, scene.intrinsics)  # so nothing depends on how large the picture is
    across, down = sampled.width / camera.width, sampled.height / camera.height
    view = _View(scene, t, pose, sampled, own_pose, device)
    return [view.place(x * across, y * down) for x, y in points]


@dataclass(frozen=True, eq=False)
class _View:
    scene: Scene
    t: float
    pose: NDArray[np.float64]
    camera: Intrinsics
    own_pose: NDArray[np.float64]
    device: Device

    def place(self, x: float, y: float) -> Place:
        """What the pixel shows that covers (x, y)."""
        camera, scene = self.camera, self.scene
        window, i, j = _window(camera, x, y)
        image, blended = renderer_of(scene, self.device).layers(self.t, self.pose, window)
        assert blended is not None  # the scene's `seen` is known
        alpha = image[4]
        solid = alpha >= COVERED_ALPHA
        depth_mm = float(solid_depth_mm(image[3], alpha, scene.units_per_mm)[i, j])
        trust = np.clip(blended / np.where(solid, alpha, 1), 0, 1) * solid
        ray, middle_ray = self._ray(x, y), self._ray(int(x) + 0.5, int(y) + 0.5)
        point_mm = self.pose[:3, 3] + depth_mm * ray
        likely = 0.0
        if trust[i, j] > 0:
            known = self._known_rgb(image[:3], (i, j), self.pose[:3, 3] + depth_mm * middle_ray)
            likely = float(confidence(evidence(trust, image[:3], known))[i, j])
        gaussians, shares, spread_mm = self._gaussians(window, i, j)
        own_depth_mm = float(to_camera(point_mm, self.own_pose)[2])
        if own_depth_mm <= 0:
            own_depth_mm = depth_mm
        sigma_mm = uncertainty_mm(scene, own_depth_mm, spread_mm, likely)
        unseen = bool(unseen_pixels(missing_pixels(solid, blended), camera.width)[i, j])
        return Place(point_mm, ray, depth_mm, own_depth_mm, sigma_mm, likely, unseen, gaussians, shares)

    def _ray(self, x: float, y: float) -> NDArray[np.float64]:
        """[3] in the world, of length 1 along the camera's z."""
        k = self.camera
        return np.asarray(self.pose[:3, :3] @ [(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0])

    def _gaussians(self, window: Intrinsics, i: int, j: int) -> tuple[NDArray[np.intp], NDArray[np.float64], float]:
        """Indices and shares [M] of the Gaussians that make a pixel, and the standard deviation of their depths, mm."""
        renderer = renderer_of(self.scene, self.device)
        weights = renderer.weights(self.t, self.pose, window, i, j).astype(np.float64)
        chosen = np.flatnonzero(weights > LEAST_SHARE * weights.sum())
        shares = weights[chosen] / max(weights[chosen].sum(), 1e-9)
        z_mm = to_camera(renderer.means_mm(self.t)[chosen], self.pose)[:, 2]
        return chosen, shares, float(np.sqrt(shares @ (z_mm - shares @ z_mm) ** 2))

    def _known_rgb(
        self, rgb: NDArray[np.float32], pixel: tuple[int, int], point_mm: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """[3, h, w] a window, and in its pixel what the endoscope's view shows of the same place."""
        known, own = rgb.copy(), self.scene.intrinsics
        if np.array_equal(self.pose, self.own_pose) and self.camera == own:
            return known
        x, y, z = to_camera(point_mm, self.own_pose)
        z = max(z, 1e-3)
        column = float(np.clip(own.fx * x / z + own.cx, 0, own.width - 0.01))
        row = float(np.clip(own.fy * y / z + own.cy, 0, own.height - 0.01))
        window, i, j = _window(own, column, row)
        image, _ = renderer_of(self.scene, self.device).layers(self.t, self.own_pose, window)
        picture = np.ascontiguousarray(image[:3].transpose(1, 2, 0))
        x_map, y_map = (np.array([[at]], np.float32) for at in (j + column % 1 - 0.5, i + row % 1 - 0.5))
        known[:, *pixel] = cv2.remap(picture, x_map, y_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0, 0]
        return known


def uncertainty_mm(scene: Scene, depth_mm: float, spread_mm: float, likely: float) -> float:
    """Standard uncertainty of a depth of this confidence: of the normal distribution of which so much lies within
    DISPARITY_PX of disparity and the spread of the blended depths together.

    Args:
        depth_mm: before the endoscope.
    """
    baseline_mm = UNKNOWN_BASELINE_MM if scene.right_eye_mm is None else float(np.linalg.norm(scene.right_eye_mm))
    px_mm = depth_mm**2 / (scene.intrinsics.fx * baseline_mm)
    held = min(max(likely, 1 - MAX_CONFIDENCE), MAX_CONFIDENCE)
    return float(np.hypot(DISPARITY_PX * px_mm, spread_mm) / (np.sqrt(2) * erfinv(held)))


def _window(camera: Intrinsics, x: float, y: float) -> tuple[Intrinsics, int, int]:
    """The part of a picture about the pixel that covers (x, y), and that pixel's row and column in it."""
    width, height = min(WINDOW_PX, camera.width), min(WINDOW_PX, camera.height)
    left = min(max(int(x) - width // 2, 0), camera.width - width)
    top = min(max(int(y) - height // 2, 0), camera.height - height)
    return camera.cut(left, top, width, height), int(y) - top, int(x) - left


@dataclass(frozen=True, eq=False)
class Distances:
    """How far two places are apart.

    now_mm, now_uncertainty_mm      at the moment at which they were chosen, with the standard uncertainty
    distances_mm, uncertainties_mm  [T] at every frame, likewise
    known                           [T] whether both are trusted then
    paths_mm                        [2, T, 3] where they are in the world
    """

    now_mm: float
    now_uncertainty_mm: float
    distances_mm: NDArray[np.float64]
    uncertainties_mm: NDArray[np.float64]
    known: NDArray[np.bool_]
    paths_mm: NDArray[np.float64]


def distances(scene: Scene, t: float, first: Place, second: Place, device: Device = CPU) -> Distances:
    """How far two places are apart, chosen at model time t, at that time and at every frame."""
    both = (first, second)
    ways, apart_mm = zip(*(_ways(scene, t, each) for each in both), strict=True)
    paths_mm = np.stack([each.point_mm + way for each, way in zip(both, ways, strict=True)])
    covariance = sum((each.uncertainty_mm**2 * np.outer(each.ray, each.ray) for each in both), np.zeros((3, 3)))
    apart_mm2 = MOTION_FACTOR**2 * np.sum(np.square(apart_mm), axis=0)
    now = _apart((second.point_mm - first.point_mm)[None], covariance[None])
    over_time = _apart(paths_mm[1] - paths_mm[0], covariance + apart_mm2[:, None, None] * np.eye(3))
    known = np.all([_kept_trust(scene, each, device) >= LEAST_KEPT_TRUST for each in both], axis=0)
    return Distances(float(now[0][0]), float(now[1][0]), *over_time, known, paths_mm)


def _apart(
    between_mm: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[F] lengths of vectors [F, 3] of this covariance [F, 3, 3] mm^2, and their standard uncertainties.

    Errors along the vector count as they are, those across it by their square over the length, as far as they are
    small beside it; no length errs by more than the vector does.
    """
    length_mm = np.linalg.norm(between_mm, axis=1)
    safe_mm = np.maximum(length_mm, 1e-6)
    along = np.einsum("fi,fij,fj->f", between_mm, covariance, between_mm) / safe_mm**2
    every = np.trace(covariance, axis1=1, axis2=2)
    across = 0.75 * ((every - along) / safe_mm) ** 2
    return length_mm, np.sqrt(np.minimum(along + across, every))


def _ways(scene: Scene, t: float, place: Place) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[T, 3] how far a place has gone at every frame, in mm, and [T] by how much the ways of its Gaussians differ: the
    root of their mean squared distance from that.
    """
    rows = torch.from_numpy(place.gaussians)
    gaussians = Gaussians(**{name: each[rows] for name, each in scene.gaussians.tensors().items()})
    motion = scene.deformation.select(rows)

    def means_mm(at: float) -> NDArray[np.float64]:
        return np.asarray(motion.deform(gaussians, at).mean.double().numpy() / scene.units_per_mm)

    with torch.no_grad():
        start = means_mm(t)
        ways = np.stack([means_mm(frame / scene.frame_count) - start for frame in range(scene.frame_count)])
    way = np.einsum("m,tmc->tc", place.shares, ways)
    return way, np.sqrt(np.einsum("m,tmc->t", place.shares, (ways - way[:, None]) ** 2))


def _kept_trust(scene: Scene, place: Place, device: Device) -> NDArray[np.float64]:
    """[T] how much of the trust in a place is left at every frame, of 1 where the endoscope has it in view."""
    renderer, seen = renderer_of(scene, device), scene.seen.numpy()[place.gaussians]
    whole = max(float(place.shares @ seen), 1e-9)
    values = (renderer.values(frame / scene.frame_count) for frame in range(scene.frame_count))
    left = [place.shares @ np.maximum(each[place.gaussians], 0) for each in values if each is not None]
    return np.array(left) / whole
