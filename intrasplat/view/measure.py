"""Measure points under pixels of a view in mm, with their standard uncertainty, and the distance of two at every frame.

Symbols: N Gaussians, M of them that contribute to a pixel, T frames, w blending weights of the Gaussians at a pixel.

A place is the point on the pixel's ray at the rendered depth. It moves with the Gaussians that contribute to the pixel:
by the mean of their motion, weighted by w. docs/conventions.md ("Measuring") defines the uncertainties;
lab/benchmarks/bm_measure.py finds and checks them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import erfinv

from intrasplat.camera import Intrinsics, to_camera
from intrasplat.errors import InputError
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.metrics import COVERED_ALPHA
from intrasplat.train.targets import solid_depth_mm
from intrasplat.view.camera import as_recorded, endoscope_pose
from intrasplat.view.confidence import confidence, evidence, followed
from intrasplat.view.renderer import renderer_of
from intrasplat.view.unseen import missing_pixels, unseen_pixels

WINDOW_PX = 64
"""Side of the window that is rendered around a pixel. Gaussians whose centres lie outside it change the depth in its
middle by less than 0.01 mm."""
LEAST_SHARE = 1e-3
"""Gaussians with a smaller share in the pixel are skipped."""
MIN_CONFIDENCE = 0.5
"""Nothing is measured at a pixel of less confidence: it is more likely wrong than right."""
MAX_CONFIDENCE = 0.995
"""Confidence is clamped to this value."""
DISPARITY_PX = 0.15
"""With the probability that confidence states, the depth error is below this disparity of the eyes and the spread of
the blended depths together. `python -m lab.benchmarks.bm_measure --fit` finds it."""
UNKNOWN_BASELINE_MM = 4.0
"""Baseline of a clip whose eyes are not known: that of usual stereo endoscopes."""
MOTION_FACTOR = 2.0
"""Standard uncertainty of a displacement, in any direction, over the spread of its Gaussians' displacements."""
MIN_REMAINING_TRUST = 0.5
"""A place is not measured at a frame where less than this share of its trust is left: after 0.7 s out of view."""


@dataclass(frozen=True, eq=False)
class MeasuredPlace:
    """The point that one pixel shows.

    point_mm        [3] in the world
    ray             [3] in the world: by how much point_mm moves when depth_mm grows by 1
    depth_mm        along the camera's z, as in the depth layer; 0: nothing solid is there
    own_depth_mm    depth before the endoscope
    uncertainty_mm  standard uncertainty of depth_mm
    confidence      as in the confidence layer
    unseen          whether no training frame saw what is shown
    gaussians       [M] indices of the Gaussians that contribute to the pixel
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
    scene: TrainedScene,
    t: float,
    world_from_camera: NDArray[np.float64] | None,
    camera: Intrinsics,
    points: Sequence[tuple[float, float]],
    device: Device = CPU,
) -> list[MeasuredPlace]:
    """The places that a view shows at points (x, y), in pixels, at model time t; pose None: the endoscope's.

    Raises:
        InputError: a point lies outside the picture, or the scene has no trust.
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
    sampled = as_recorded(camera, scene.intrinsics)  # so that nothing depends on the size of the picture
    across, down = sampled.width / camera.width, sampled.height / camera.height
    view = _View(scene, t, pose, sampled, own_pose, device)
    return [view.place(x * across, y * down) for x, y in points]


@dataclass(frozen=True, eq=False)
class _View:
    scene: TrainedScene
    t: float
    pose: NDArray[np.float64]
    camera: Intrinsics
    own_pose: NDArray[np.float64]
    device: Device

    def place(self, x: float, y: float) -> MeasuredPlace:
        """The place that the pixel at (x, y) shows."""
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
            likely = float(confidence(evidence(trust, image[:3], known))[i, j]) * followed(scene, self.t)
        gaussians, shares, spread_mm = self._gaussians(window, i, j)
        own_depth_mm = float(to_camera(point_mm, self.own_pose)[2])
        if own_depth_mm <= 0:
            own_depth_mm = depth_mm
        sigma_mm = uncertainty_mm(scene, own_depth_mm, spread_mm, likely)
        unseen = bool(unseen_pixels(missing_pixels(solid, blended), camera.width)[i, j])
        return MeasuredPlace(point_mm, ray, depth_mm, own_depth_mm, sigma_mm, likely, unseen, gaussians, shares)

    def _ray(self, x: float, y: float) -> NDArray[np.float64]:
        """[3] in the world, of length 1 along the camera's z."""
        k = self.camera
        return np.asarray(self.pose[:3, :3] @ [(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0])

    def _gaussians(self, window: Intrinsics, i: int, j: int) -> tuple[NDArray[np.intp], NDArray[np.float64], float]:
        """Indices and shares [M] of a pixel's Gaussians, and the standard deviation of their depths in mm."""
        renderer = renderer_of(self.scene, self.device)
        weights = renderer.blending_weights(self.t, self.pose, window, i, j).astype(np.float64)
        chosen = np.flatnonzero(weights > LEAST_SHARE * weights.sum())
        shares = weights[chosen] / max(weights[chosen].sum(), 1e-9)
        z_mm = to_camera(renderer.means_mm(self.t)[chosen], self.pose)[:, 2]
        return chosen, shares, float(np.sqrt(shares @ (z_mm - shares @ z_mm) ** 2))

    def _known_rgb(
        self, rgb: NDArray[np.float32], pixel: tuple[int, int], point_mm: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """[3, h, w] a window whose measured pixel has the colour of the same point in the endoscope's view."""
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


def uncertainty_mm(scene: TrainedScene, depth_mm: float, spread_mm: float, likely: float) -> float:
    """Standard uncertainty in mm of a depth: that of the normal distribution of which the share `likely` lies within
    DISPARITY_PX of disparity and the spread of the blended depths together.

    Args:
        depth_mm: depth before the endoscope.
        spread_mm: standard deviation of the depths of the pixel's Gaussians.
        likely: confidence in [0, 1].
    """
    baseline_mm = UNKNOWN_BASELINE_MM if scene.right_eye_mm is None else float(np.linalg.norm(scene.right_eye_mm))
    px_mm = depth_mm**2 / (scene.intrinsics.fx * baseline_mm)
    clamped = min(max(likely, 1 - MAX_CONFIDENCE), MAX_CONFIDENCE)
    return float(np.hypot(DISPARITY_PX * px_mm, spread_mm) / (np.sqrt(2) * erfinv(clamped)))


def _window(camera: Intrinsics, x: float, y: float) -> tuple[Intrinsics, int, int]:
    """The window of a picture around the pixel at (x, y), and that pixel's row and column in it."""
    width, height = min(WINDOW_PX, camera.width), min(WINDOW_PX, camera.height)
    left = min(max(int(x) - width // 2, 0), camera.width - width)
    top = min(max(int(y) - height // 2, 0), camera.height - height)
    return camera.cut(left, top, width, height), int(y) - top, int(x) - left


@dataclass(frozen=True, eq=False)
class Distances:
    """The distance of two places over time.

    now_mm, now_uncertainty_mm      at the time at which they were chosen, with its standard uncertainty
    distances_mm, uncertainties_mm  [T] the same at every frame
    known                           [T] whether both places are trusted at that frame
    paths_mm                        [2, T, 3] positions of both places in the world
    """

    now_mm: float
    now_uncertainty_mm: float
    distances_mm: NDArray[np.float64]
    uncertainties_mm: NDArray[np.float64]
    known: NDArray[np.bool_]
    paths_mm: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Paths:
    """Where P places go.

    places_mm  [P, T, 3] positions in the world at every frame
    spread_mm  [P, T] standard uncertainty of each displacement since the time of choice, in any direction
    left       [P, T] share of the trust in each place that is left
    """

    places_mm: NDArray[np.float64]
    spread_mm: NDArray[np.float64]
    left: NDArray[np.float64]

    @property
    def known(self) -> NDArray[np.bool_]:
        """[T] whether all places are trusted at each frame."""
        return np.asarray((self.left >= MIN_REMAINING_TRUST).all(axis=0))


def paths(scene: TrainedScene, t: float, places: Sequence[MeasuredPlace], device: Device = CPU) -> Paths:
    """The paths of places that were chosen at model time t."""
    displacements, apart_mm = zip(*(_displacements(scene, t, each) for each in places), strict=True)
    places_mm = np.stack([each.point_mm + moved for each, moved in zip(places, displacements, strict=True)])
    left = np.stack([_remaining_trust(scene, each, device) for each in places])
    return Paths(places_mm, MOTION_FACTOR * np.stack(apart_mm), left)


def distances(
    scene: TrainedScene, t: float, first: MeasuredPlace, second: MeasuredPlace, device: Device = CPU
) -> Distances:
    """The distance of two places that were chosen at model time t, at that time and at every frame."""
    both = (first, second)
    followed = paths(scene, t, both, device)
    covariance = sum((each.uncertainty_mm**2 * np.outer(each.ray, each.ray) for each in both), np.zeros((3, 3)))
    apart_mm2 = np.sum(np.square(followed.spread_mm), axis=0)
    paths_mm = followed.places_mm
    now = _apart((second.point_mm - first.point_mm)[None], covariance[None])
    over_time = _apart(paths_mm[1] - paths_mm[0], covariance + apart_mm2[:, None, None] * np.eye(3))
    return Distances(float(now[0][0]), float(now[1][0]), *over_time, followed.known, paths_mm)


def _apart(
    between_mm: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[F] lengths of vectors [F, 3] with covariance [F, 3, 3] mm^2, and their standard uncertainties.

    An error along the vector changes the length by as much; a small error across it, by its square over the length.
    The uncertainty of the length never exceeds that of the vector.
    """
    length_mm = np.linalg.norm(between_mm, axis=1)
    safe_mm = np.maximum(length_mm, 1e-6)
    along = np.einsum("fi,fij,fj->f", between_mm, covariance, between_mm) / safe_mm**2
    every = np.trace(covariance, axis1=1, axis2=2)
    across = 0.75 * ((every - along) / safe_mm) ** 2
    return length_mm, np.sqrt(np.minimum(along + across, every))


def _displacements(
    scene: TrainedScene, t: float, place: MeasuredPlace
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[T, 3] displacement of a place at every frame since time t, in mm, and [T] the spread of its Gaussians'
    displacements: their RMS distance from it.
    """
    rows = torch.from_numpy(place.gaussians)
    gaussians = Gaussians(**{name: each[rows] for name, each in scene.gaussians.tensors().items()})
    motion = scene.deformation.select(rows)

    def means_mm(at: float) -> NDArray[np.float64]:
        return np.asarray(motion.deform(gaussians, at).mean.double().numpy() / scene.units_per_mm)

    with torch.no_grad():
        start = means_mm(t)
        displacements = np.stack([means_mm(frame / scene.frame_count) - start for frame in range(scene.frame_count)])
    displacement = np.einsum("m,tmc->tc", place.shares, displacements)
    return displacement, np.sqrt(np.einsum("m,tmc->t", place.shares, (displacements - displacement[:, None]) ** 2))


def _remaining_trust(scene: TrainedScene, place: MeasuredPlace, device: Device) -> NDArray[np.float64]:
    """[T] share of the trust in a place that is left at every frame; 1 where the endoscope has it in view."""
    renderer, seen = renderer_of(scene, device), scene.seen.numpy()[place.gaussians]
    whole = max(float(place.shares @ seen), 1e-9)
    values = (renderer.values(frame / scene.frame_count) for frame in range(scene.frame_count))
    left = [place.shares @ np.maximum(each[place.gaussians], 0) for each in values if each is not None]
    return np.array(left) / whole
