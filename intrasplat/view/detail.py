"""What a model misses of the recorded frames, carried to a view.

The residual of a training frame is its recorded picture less the model's view of it, in the model's steady light. A
pixel of a view shows a point of the tissue. The model's own motion tells where this point was at the two training
frames nearest in time, and depth whether an eye saw it there. Their residuals are blended by nearness in time.

What both eyes miss alike belongs to the tissue and is added from every side. What one of them misses alone, such as a
highlight that the model blurs, is added near that eye only.

Symbols: H W pixels of the view, h w of a recorded picture, N Gaussians.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.machine.parts import Parts
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.training_pictures import TrainingPictures
from intrasplat.splat.cpu.threads import run
from intrasplat.train.targets import solid_depth_mm
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.confidence import followed
from intrasplat.view.recorded_light import EndoscopeLight
from intrasplat.view.smoky import smoke_share
from intrasplat.view.transfer import ONE, carry, gather

if TYPE_CHECKING:
    from intrasplat.view.renderer import SceneRenderer

Floats = NDArray[np.float32]
Pose = NDArray[np.float64]

CELL_PX = 8
"""Motion is smooth: it is averaged in cells of so many pixels along each side."""
NEAR_CELLS, FAR_CELLS, LITTLE = 0.7, 6.0, np.float32(0.02)
"""Standard deviations of the mean of neighbouring cells, and of the one that fills in where no Gaussian's centre lies,
with this weight."""
SHOWN = 0.05
"""Largest relative difference of depth of a Gaussian that the view shows, from the view's depth."""
MAX_DEPTH_ERROR = 0.06
"""Relative difference of depth at which an eye saw another point: nearer tissue hid this one."""
SHARED_DEG, LONE_DEG, OWN = 12.0, 6.0, 0.5
"""Standard deviations of the weights over the angle between the view's ray and the eye's: of what both eyes miss; of
what an eye without another misses; and of what one of two eyes misses alone, as a share of the angle between them."""
AGREEMENT_PX = 9
"""Side of the square in which the eyes' residuals are compared."""
ANGLE_STEP_PX = 8
"""Angles are computed in one of so many pixels along each side."""
NEGLIGIBLE = 0.02
"""A smaller weight is 0."""
CACHED = 6
"""Residuals in memory for a scene: of three moments with two eyes."""
EDGE_PX = 5
"""Residuals fade over half as many pixels towards what is masked, so that none appears at once where its edge moves."""
NOISE = 1.75 / 255
"""A residual of this root mean square or less is noise of the camera and loss of the coding, and fades: a model that
misses nothing leaves 1.5 to 1.75 levels of 255, others 2.6 and more."""
MIN_TRANSMISSION, MIN_LIGHT = 0.3, 0.2
"""Residuals behind smoke, or in a dark border, are noise where less of the light is left."""


@dataclass(frozen=True, eq=False)
class _Residual:
    """A training frame's residual for one eye.

    planes    [h + 2, w + 2, 4] int16, with a border of zeros: R G B times validity, and validity, times ONE; it is 1
              where the recorded picture shows tissue, and falls to 0 towards what it does not
    depth_mm  [h + 2, w + 2] of the model in that eye
    lens, world_from_eye   its camera; [4, 4] mm
    means_mm  [3, N] the Gaussians' centres at that frame, world
    """

    planes: NDArray[np.int16]
    depth_mm: Floats
    lens: Intrinsics
    world_from_eye: Pose
    means_mm: Floats


@dataclass(frozen=True, eq=False)
class Added:
    """What a view gets from the recorded frames.

    rgb    [H, W, 3] to be added to its colours, in the model's steady light
    share  of the view's solid pixels that get something
    """

    rgb: Floats
    share: float

    @classmethod
    def nothing(cls, size: tuple[int, ...]) -> Added:
        """For a view of size [H, W]."""
        return cls(np.zeros((*size, 3), np.float32), 0.0)


class Detail:
    """The residuals of a scene's training frames. Several threads may use it."""

    def __init__(self, scene: TrainedScene, pictures: TrainingPictures) -> None:
        self._scene, self._pictures = scene, pictures
        trained = set(scene.trained_frames)
        self._frames = [frame for frame in pictures.frames if frame in trained]
        self._opacity = torch.sigmoid(scene.gaussians.opacity_logit).numpy()
        self._residuals: OrderedDict[tuple[int, int], _Residual] = OrderedDict()
        self._lock = Lock()

    def added(
        self, renderer: SceneRenderer, t: float, world_from_camera: Pose, lens: Intrinsics, depth_mm: Floats
    ) -> Parts[Added]:
        """What a view at model time t gets.

        Args:
            depth_mm: [H, W] camera z of the view; 0 where nothing is solid.

        Raises:
            SceneError: the recorded pictures are missing or damaged.
        """
        view = _View(world_from_camera, lens, depth_mm)
        poses = [self._eye_pose(eye, t) for eye in range(len(self._pictures.eyes))]
        angles = [view.squared_angle(pose) for pose in poses]
        lone = np.float32(np.deg2rad(LONE_DEG) ** 2)
        between = lone if len(poses) == 1 else np.float32(OWN**2) * view.squared_angle(poses[0], poses[1])
        own = [np.exp(each / (-2 * np.maximum(between, np.float32(1e-7)))) for each in angles]
        shared = np.exp(np.minimum.reduce(angles) / np.float32(-2 * np.deg2rad(SHARED_DEG) ** 2))
        nearest = int(np.argmax([float(each.mean()) for each in own]))
        is_own = float(own[nearest].min()) > 1 - NEGLIGIBLE
        used = [nearest] if is_own else range(len(own)) if float(shared.max()) > NEGLIGIBLE else ()
        totals = {eye: np.zeros((*depth_mm.shape, 4), np.float32) for eye in used}
        neighbours = self._neighbours(t) if used else []
        residuals = {}
        for eye, (frame, _) in itertools.product(used, neighbours):
            residuals[eye, frame] = yield from self._residual(renderer, eye, frame)
        means_mm = [residuals[nearest, frame].means_mm for frame, _ in neighbours]
        moved_mm = view.motion_mm(_centres_mm(renderer, t), means_mm, self._opacity) if neighbours else ()
        yield
        for (frame, weight), way_mm in zip(neighbours, moved_mm, strict=True):
            for eye, total in totals.items():
                view.carry(residuals[eye, frame], way_mm, weight, total)
                yield
        if not used:
            return Added.nothing(depth_mm.shape)
        found = {eye: (total[..., :3], total[..., 3]) for eye, total in totals.items()}
        rgb, seen = found[nearest] if is_own else _together(found, list(map(view.finer, own)), view.finer(shared))
        return Added(rgb, float(seen.sum()) / max(int(np.count_nonzero(depth_mm)), 1))

    def _eye_pose(self, eye: int, t: float) -> Pose:
        return endoscope_pose(self._scene, t) @ self._pictures.eyes[eye].left_from_eye

    def _neighbours(self, t: float) -> list[tuple[int, float]]:
        """The training frames before and after model time t, and their weights: together 1 if motion is followed."""
        frames, place = self._frames, t * self._scene.frame_count
        after = bisect_right(frames, place + 1e-6)
        if after == 0 or after == len(frames):
            return [(frames[min(after, len(frames) - 1)], 1.0)] if frames else []
        before, behind = frames[after - 1], frames[after]
        share, known = min(max((place - before) / (behind - before), 0.0), 1.0), followed(self._scene, t)
        weights = (before, known * (1 - share)), (behind, known * share)
        return [(frame, weight) for frame, weight in weights if weight > 1e-6]

    def _residual(self, renderer: SceneRenderer, eye: int, frame: int) -> Parts[_Residual]:
        with self._lock:
            found = self._residuals.get((eye, frame))
            if found is not None:
                self._residuals.move_to_end((eye, frame))
                return found
        found = yield from self._measured(renderer, eye, frame)
        with self._lock:
            self._residuals[eye, frame] = found
            while len(self._residuals) > CACHED:
                self._residuals.popitem(last=False)
        return found

    def _measured(self, renderer: SceneRenderer, eye: int, frame: int) -> Parts[_Residual]:
        scene, lens, t = self._scene, self._pictures.eyes[eye].lens, frame / self._scene.frame_count
        pose = self._eye_pose(eye, t)
        recorded, tissue = self._pictures.picture(eye, frame)
        height, width = tissue.shape
        yield
        image, _ = renderer.layers(t, pose, lens)
        yield
        depth_mm = solid_depth_mm(image[3], image[4], scene.units_per_mm)
        steady, is_lit = recorded * np.float32(1 / 255), np.ones_like(tissue)
        if scene.veil is not None:
            arrives = 1 - smoke_share(scene, t, depth_mm, (lens, pose))
            is_lit &= arrives > MIN_TRANSMISSION
            airlight = scene.veil.airlight
            steady = (steady - airlight) / np.maximum(arrives, np.float32(MIN_TRANSMISSION))[..., None] + airlight
        factors = EndoscopeLight(scene, t, pose, lens).factors(depth_mm)
        if factors is not None:
            is_lit &= np.broadcast_to(factors, steady.shape).min(-1) > MIN_LIGHT
            steady = steady / np.maximum(factors, np.float32(MIN_LIGHT))
        valid = _faded(tissue & is_lit & (depth_mm > 0))
        missed = np.clip(steady - image[:3].transpose(1, 2, 0), -1, 1) * valid[..., None]
        power = float(np.vdot(missed, missed)) / max(3 * float(np.vdot(valid, valid)), 1.0)
        shown = min(max(power / NOISE**2 - 1, 0.0), 1.0)
        planes = np.zeros((height + 2, width + 2, 4), np.int16)
        planes[1:-1, 1:-1, :3] = np.rint(missed * np.float32(shown * ONE))
        planes[1:-1, 1:-1, 3] = valid * np.float32(ONE)
        depth_mm = np.asarray(cv2.copyMakeBorder(depth_mm, 1, 1, 1, 1, cv2.BORDER_REPLICATE), np.float32)
        return _Residual(planes, depth_mm, lens, pose, _centres_mm(renderer, t))


def detail_bytes(scene: TrainedScene) -> int:
    """The most bytes that a scene's residuals take in memory."""
    k, per_pixel, per_gaussian = scene.intrinsics, 12, 12
    size = per_pixel * (k.width + 2) * (k.height + 2) + per_gaussian * len(scene.gaussians)
    return 0 if scene.pictures is None else CACHED * size


class _View:
    """The points that a view shows."""

    def __init__(self, world_from_camera: Pose, lens: Intrinsics, depth_mm: Floats) -> None:
        self._pose, self._lens, self.depth_mm = world_from_camera, lens, np.ascontiguousarray(depth_mm)
        some = np.s_[ANGLE_STEP_PX // 2 :: ANGLE_STEP_PX]
        coarse_mm = depth_mm[some, some]
        self._coarse_mm = np.where(coarse_mm > 0, coarse_mm, _median(coarse_mm[coarse_mm > 0]))
        down, across = (np.arange(size, dtype=np.float32)[some] + np.float32(0.5) for size in depth_mm.shape)
        self._x = ((across - np.float32(lens.cx)) / np.float32(lens.fx))[None]
        self._y = ((down - np.float32(lens.cy)) / np.float32(lens.fy))[:, None]

    def squared_angle(self, world_from_eye: Pose, world_from_other: Pose | None = None) -> Floats:
        """[h, w] squared angle, radians, at coarse points between the rays to an eye and the other, or the view."""
        eye_from_view = (np.linalg.inv(world_from_eye) @ self._pose).astype(np.float32)
        x, y, z = (self._coarse_mm * (a * self._x + b * self._y + c) + d for a, b, c, d in eye_from_view[:3])
        other = self._pose if world_from_other is None else world_from_other
        view_mm = (np.linalg.inv(world_from_eye) @ other)[:3, 3].astype(np.float32)
        eye_length = np.sqrt(x * x + y * y + z * z)
        a, b, c = x - view_mm[0], y - view_mm[1], z - view_mm[2]
        view_length = np.sqrt(a * a + b * b + c * c)
        cosine = (x * a + y * b + z * c) / np.maximum(eye_length * view_length, np.float32(1e-6))
        return np.asarray(np.maximum(2 - 2 * cosine, 0), np.float32)

    def finer(self, weights: Floats) -> Floats:
        """[H, W] of weights at coarse points."""
        return np.asarray(cv2.resize(weights, self.depth_mm.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)

    def motion_mm(self, means_mm: Floats, others_mm: Sequence[Floats], opacity: Floats) -> list[Floats]:
        """[h, w, 3] motion, world axes, in the view's cells, from its time to each of some others.

        Args:
            means_mm: [3, N] the Gaussians' centres at the view's time; others_mm: at the other times.
            opacity: [N] theirs.
        """
        height, width = self.depth_mm.shape
        sums = np.zeros((-(-height // CELL_PX), -(-width // CELL_PX), 3 * len(others_mm) + 1), np.float32)
        view_from_world = np.ascontiguousarray(np.linalg.inv(self._pose)[:3], np.float32)
        gather(
            means_mm, np.stack(others_mm), opacity, view_from_world, _numbers(self._lens), self.depth_mm,
            np.float32(SHOWN), sums,
        )  # fmt: skip
        planes = cv2.GaussianBlur(sums, (0, 0), NEAR_CELLS) + LITTLE * cv2.GaussianBlur(sums, (0, 0), FAR_CELLS)
        mean = planes[..., :-1] / np.maximum(planes[..., -1:], np.float32(1e-9))
        return [mean[..., 3 * place : 3 * place + 3] for place in range(len(others_mm))]

    def carry(self, residual: _Residual, moved_mm: Floats, weight: float, total: Floats) -> None:
        """Add a residual to total [H, W, 4]: R G B times weight, and weight, where the points were at its frame.

        moved_mm: [h, w, 3] motion from the view's time to the residual's, world axes, of the coarse view.
        """
        eye_from_world = np.linalg.inv(residual.world_from_eye)
        turned = np.ascontiguousarray(moved_mm @ eye_from_world[:3, :3].T.astype(np.float32))
        eye_from_view = np.ascontiguousarray((eye_from_world @ self._pose)[:3], np.float32)
        run(
            carry, self.depth_mm, _numbers(self._lens), eye_from_view, turned, residual.planes, residual.depth_mm,
            _numbers(residual.lens), np.float32(MAX_DEPTH_ERROR), np.float32(weight), total,
        )  # fmt: skip


def _faded(valid: NDArray[np.bool_]) -> Floats:
    """[h, w] 1 where pixels are valid, falling to 0 within EDGE_PX of those that are not."""
    inner = cv2.erode(valid.view(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    return np.asarray(np.maximum(2 * cv2.blur(inner, (EDGE_PX, EDGE_PX)) - 1, 0) * inner, np.float32)


def _centres_mm(renderer: SceneRenderer, t: float) -> Floats:
    """[3, N] the Gaussians' centres at model time t, world."""
    return np.ascontiguousarray(renderer.means_mm(t).T, np.float32)


def _numbers(lens: Intrinsics) -> Floats:
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy], np.float32)


def _median(values: Floats) -> np.float32:
    return np.float32(np.median(values)) if values.size else np.float32(1)


def _together(means: dict[int, tuple[Floats, Floats]], own: list[Floats], shared: Floats) -> tuple[Floats, Floats]:
    """R G B [H, W, 3], times weight, and weight [H, W] of all eyes together.

    Args:
        means: the same of each eye.
        own, shared: [H, W] weights of what each eye misses alone, and of what both miss.
    """
    if len(means) == 1:
        ((rgb, weight),) = means.values()
        return rgb * own[0][..., None], weight * own[0]
    (left, left_weight), (right, right_weight) = means.values()
    both = left_weight * right_weight
    alike = _agreement(left, right, both)
    common = (alike * both / 2)[..., None] * (left + right)
    near = own[0] + own[1]
    scale = 1 / np.maximum(near, 1)
    alone = [(each * scale)[..., None] * (rgb - common) for each, rgb in zip(own, (left, right), strict=True)]
    rgb = np.maximum(shared, np.minimum(near, 1))[..., None] * common + alone[0] + alone[1]
    weight = np.maximum(shared * alike * both, scale * (own[0] * left_weight + own[1] * right_weight))
    return rgb, weight


def _agreement(left: Floats, right: Floats, both: Floats) -> Floats:
    """[H, W] in [0, 1]: share of the eyes' mean residual that they have in common, around each pixel."""
    side = (AGREEMENT_PX, AGREEMENT_PX)
    product = cv2.blur(both * (left * right).sum(-1), side)
    power = cv2.blur(both * ((left * left).sum(-1) + (right * right).sum(-1)) / 2, side)
    correlation = np.clip(product / (power + np.float32(1e-7)), 0, 1)
    return np.asarray(2 * correlation / (1 + correlation), np.float32)
